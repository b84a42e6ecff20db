"""The cubic that the paper prints: its numbers, its ends, and along what of a device it runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.calibration.rig import FingerLine
from common.hand.model import FINGERS
from master.estimator.priors import CubicLaw, cubic_pip, on_line, simulated_lines
from master.estimator.settings import LAWS
from tests.master.estimator.wrist_case import WristCase, natural


@pytest.fixture(scope="module")
def wrist_case(root: Path) -> WristCase:
    return WristCase.of(root)


def test_the_printed_cubic() -> None:
    # Digits, UIST 2012: 119.75 degrees at 0; its root is at 102.06 mm.
    np.testing.assert_allclose(np.degrees(cubic_pip(np.array([0.0, 0.05]))), [119.75, 26.25], atol=0.01)
    assert np.degrees(cubic_pip(np.array([1e-3 * LAWS.cubic_mm]))) == pytest.approx(0.0, abs=0.05)


def test_the_cubic_is_clamped_and_falls() -> None:
    pip = cubic_pip(np.array([-0.05, 0.0, 0.02, 0.06, 0.1, 0.10206, 0.2, np.nan]))
    assert pip[0] == pip[1]
    assert (np.diff(pip[1:6]) < 0.0).all()
    assert pip[6] == pytest.approx(pip[5], abs=1e-12)
    assert np.isnan(pip[7])


def test_the_lines_of_a_device_run_from_its_straight_fingers_to_its_bent_ones(wrist_case: WristCase) -> None:
    lines = simulated_lines(wrist_case.setup)
    for pip, end in ((0.0, 0.0), (85.0, 1.0)):
        ray = np.column_stack([wrist_case.looks(natural(pip)).laser, np.ones(5)])
        points = ray * (wrist_case.setup.offset_m / (ray @ wrist_case.setup.normal))[:, None]
        for f in range(1, 5):
            along, aside = on_line(points[f : f + 1], lines[f])
            assert along[0] == pytest.approx(end, abs=0.06)
            assert np.abs(aside).max() < 2e-3
    for line in lines[1:]:
        assert 0.03 < line.range_m[1] - line.range_m[0] < 0.08


def test_a_line_that_was_measured_counts_before_the_simulated_one(wrist_case: WristCase) -> None:
    simulated = CubicLaw(wrist_case.setup).lines
    index = FingerLine(
        origin_m=(0.02, 0.05, 0.2), direction=(0.0, 0.0, -1.0), range_m=(0.0, 0.06), residual_m=1e-4
    )
    law = CubicLaw(replace(wrist_case.setup, lines={"index": index}))
    assert law.lines[1] == index
    assert law.lines[2:] == simulated[2:]
    points = np.tile([0.02, 0.05, 0.14], (5, 1))  # at its bent end
    points[FINGERS.index("ring")] = np.nan
    pip = law(points)
    assert np.isnan(pip[[0, 3]]).all()  # a thumb has no PIP
    assert np.degrees(pip[1]) == pytest.approx(119.75)
