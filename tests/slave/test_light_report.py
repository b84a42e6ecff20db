"""Warnings about the light: counted once each time they begin, logged with marker and fix, not every frame."""

import logging
from typing import cast

import numpy as np
import pytest

from common.arrays import Float
from slave.live import LightReport
from slave.markers.reloadable import ReloadableDetector
from slave.markers.white_balance import ColourWarning
from slave.sources import Frame

SECOND = 1_000_000_000
IMAGE = np.zeros((2, 2, 3), np.uint8)
THUMB = ColourWarning("thumb", "marker thumb: near the border: repaint it")
LIGHT = ColourWarning(None, "the light is not known: show 2 or more markers")


class Detector:
    def __init__(self) -> None:
        self.warnings: list[ColourWarning] = []
        self.log_gains: Float = np.log([0.5, 1.25, 2.5])
        self.refused = 3
        self.adaptive: Detector | None = self
        self.tables = 4


def frame(t_s: float) -> Frame:
    return Frame(0, round(t_s * SECOND), round(t_s * SECOND), IMAGE)


def report() -> tuple[Detector, LightReport]:
    detector = Detector()
    return detector, LightReport("left", cast(ReloadableDetector, detector), ("thumb", "index"))


def test_a_warning_is_counted_when_it_begins() -> None:
    detector, light = report()
    for k, warnings in enumerate(([], [THUMB], [THUMB], [THUMB, LIGHT], [], [THUMB])):
        detector.warnings = warnings
        light.offer(frame(0.1 * k))
    counts = light.counts()
    assert (counts["warnings.thumb"], counts["warnings.index"], counts["warnings.light"]) == (2, 0, 1)
    assert (counts["refused.light"], counts["colour_tables"]) == (3, 4)


def test_the_log_names_marker_and_fix_and_is_quiet_for_a_while(caplog: pytest.LogCaptureFixture) -> None:
    detector, light = report()
    detector.warnings = [THUMB, LIGHT]
    with caplog.at_level(logging.WARNING):
        for k in range(120):
            light.offer(frame(0.1 * k))
    assert [record.getMessage() for record in caplog.records] == 2 * [
        f"left: {THUMB.text}",
        f"left: {LIGHT.text}",
    ]


def test_the_gauges_are_the_light_against_calibration() -> None:
    metrics = report()[1].metrics()
    assert metrics == pytest.approx({"light_red": 2.0, "light_blue": 0.4, "light_exposure": 1.25})


def test_of_a_light_that_is_not_followed_nothing_is_said() -> None:
    detector, light = report()
    detector.adaptive = None
    assert light.metrics() == {}
