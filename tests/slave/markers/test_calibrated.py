"""A slave that lacks colours runs: it sees the markers whose colours it knows, and goes on as it learns the others."""

import logging
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from common.calibration import CameraCalibration
from common.messages import MarkerDetections
from slave import live
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.engine import NUMPY
from slave.markers.reloadable import CalibratedDetector, LightAdaptiveDetector, ReloadableDetector
from tests.slave import painted
from tests.slave.test_tuning import FILE, RIG, tree

PICTURE = painted.render(painted.hand())
FRAME_NS = 16_666_667


def knowing(*names: str) -> CameraCalibration:
    return painted.camera(ranges={name: painted.RANGES[name] for name in names})


def test_those_that_are_known_are_seen_as_ever_and_the_others_never() -> None:
    every = MarkerDetector(painted.camera(), painted.NAMES)
    some = CalibratedDetector(knowing("index", "back", "ring", "middle"), painted.NAMES)
    assert some.missing == ("thumb", "little")
    for k in range(3):
        of_all, found = every.push(PICTURE, k * FRAME_NS), some.push(PICTURE, k * FRAME_NS)
        np.testing.assert_allclose(found.uv[[1, 2, 3, 5]], of_all.uv[[1, 2, 3, 5]], atol=0.01)
        for rows in (found.uv, found.area, found.quality, found.sigma_px, found.alt_uv, found.colour):
            assert np.isnan(rows[[0, 4]]).all()


def test_without_any_colour_nothing_is_seen_and_with_the_last_one_all_are() -> None:
    detector = ReloadableDetector(CalibratedDetector(replace(painted.camera(), markers=None), painted.NAMES))
    assert np.isnan(detector.push(PICTURE, 0).uv).all()
    assert (detector.missing, detector.plain, detector.adaptive) == (painted.NAMES, None, None)
    some = CalibratedDetector(knowing("thumb", "index", "middle"), painted.NAMES)
    detector.replace(some)
    assert np.isfinite(detector.push(PICTURE, FRAME_NS).uv[:, 0]).tolist() == 3 * [True] + 3 * [False]
    assert some.plain is not None
    tracks = some.plain._tracks
    whole = MarkerDetector(painted.camera(), painted.NAMES)
    detector.replace(whole)
    assert np.isfinite(detector.push(PICTURE, 2 * FRAME_NS).uv).all()
    assert detector.missing == ()
    assert whole._tracks[0] is not None
    assert tracks[0] is not None
    assert whole._tracks[0].t_ns == 2 * FRAME_NS
    assert whole._tracks[0].whole == pytest.approx(tracks[0].whole, rel=0.01), "its track goes on"
    uv = detector.found(2 * FRAME_NS)
    assert uv is not None
    np.testing.assert_allclose(uv, painted.CENTRES + np.array([300.0, 200.0]), atol=0.1)
    assert detector.found(3 * FRAME_NS) is None


def test_what_is_made_of_a_file_says_what_is_missing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files = tree(tmp_path)
    make = live._maker(files, "follow", NUMPY, None)  # type: ignore[arg-type]
    with caplog.at_level(logging.WARNING):
        made = make(replace(FILE, markers=None), RIG)
    assert isinstance(made, CalibratedDetector)
    assert f"{files.camera_path}: markers: no colour for thumb, index, " in caplog.text
    assert isinstance(make(FILE, RIG), LightAdaptiveDetector)


def test_a_frame_without_markers_is_a_message_in_which_nothing_is_seen() -> None:
    found = Detections.none(6)
    seen = found.uv, found.area, found.quality, found.sigma_px, found.alt_uv
    assert np.isnan(MarkerDetections("left", 1, 2, 0, 0, *seen).uv).all()
    assert found.colour.shape == (6, 3)
