from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration import CameraCalibration, load
from common.errors import FitError
from slave.commands.offline import calibrate_colours
from slave.markers.classify import HUES
from slave.markers.colours import calibrate, circular_median, grow, report
from tests.slave.painted import CENTRES, HUE, NAMES, Disc, hand, linear, marker_hsv, render

IMAGE = render(hand(), noise=2.0)
CLICKS = {n: (300.0 + x, 200.0 + y) for n, (x, y) in zip(NAMES, CENTRES.tolist(), strict=True)}


def test_ranges_hold_their_paint_and_nothing_else() -> None:
    rows = calibrate(IMAGE, CLICKS)
    assert [r.name for r in rows] == list(NAMES)
    for row in rows:
        assert row.own > 0.98
        assert row.others == {}
        assert row.skin < 0.001
        assert row.background < 1e-3


def test_ranges_do_not_overlap_and_are_as_broad_as_the_neighbours_allow() -> None:
    spans = []
    for row, hue in zip(calibrate(IMAGE, CLICKS), HUE, strict=True):
        low, high = row.range.hsv_low[0], row.range.hsv_high[0]
        spans.append([(low + k) % HUES for k in range((high - low) % HUES + 1)])
        assert hue in spans[-1]
        assert 15 <= len(spans[-1]) <= 29
    every = [h for span in spans for h in span]
    assert len(every) == len(set(every))


def test_a_hue_at_the_wrap_gives_a_range_that_wraps() -> None:
    image = render([Disc((172, 200, 150), 60.0, 50.0, 10.0)], 120, 100)
    (row,) = calibrate(image, {"magenta": (60.0, 50.0)})
    assert row.range.hsv_low[0] > row.range.hsv_high[0]
    assert row.own == 1.0


def test_clutter_of_a_markers_colour_is_reported() -> None:
    image = render([*hand(), Disc(marker_hsv(1), 560.0, 120.0, 60.0)])
    rows = {r.name: r for r in calibrate(image, CLICKS)}
    assert rows["index"].background > 0.02
    text = report(list(rows.values()))
    assert "collisions: index:" in text
    assert all(name in text for name in NAMES)
    assert "no collisions" in report(calibrate(IMAGE, CLICKS))


def test_the_darker_and_the_brighter_half_of_the_same_paint_are_inside() -> None:
    for row, hue in zip(calibrate(IMAGE, CLICKS), HUE, strict=True):
        low, high = row.range.hsv_low, row.range.hsv_high
        for value in (75, 255):
            assert low[2] <= value <= high[2]
        assert low[1] <= 110 <= high[1]
        assert (hue - low[0]) % HUES <= (high[0] - low[0]) % HUES


@pytest.mark.parametrize(
    ("click", "message"),
    [
        ((700.0, 10.0), "outside the 640x480 image"),
        ((20.0, 20.0), "not on a paint"),
        ((-3.0, 5.0), "outside"),
    ],
)
def test_a_click_that_hits_nothing_says_which(click: tuple[float, float], message: str) -> None:
    with pytest.raises(FitError, match=rf"clicks\.ring.*{message}"):
        calibrate(IMAGE, {**CLICKS, "ring": click})


def test_a_spot_of_five_pixels_is_no_paint() -> None:
    image = render([], 120, 100)
    image[[49, 50, 50, 50, 51], [60, 59, 60, 61, 60]] = np.asarray(
        cv2.cvtColor(np.array([[(66, 200, 150)]], np.uint8), cv2.COLOR_HSV2BGR)
    )[0, 0]
    with pytest.raises(FitError, match="spot of fewer than"):
        grow(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2HSV), dtype=np.uint8), "dot", (60.0, 50.0))


def test_two_paints_of_one_hue_are_refused() -> None:
    image = render([Disc((60, 200, 150), 40.0, 50.0, 8.0), Disc((65, 200, 150), 80.0, 50.0, 8.0)], 120, 100)
    with pytest.raises(FitError, match=r"a and b have nearly the same hue"):
        calibrate(image, {"a": (40.0, 50.0), "b": (80.0, 50.0)})


@given(st.lists(st.integers(0, 20), min_size=1, max_size=30), st.integers(0, 179))
def test_the_circular_median_turns_with_the_hues(values: list[int], rotation: int) -> None:
    hues = np.array(values, np.uint8)
    rotated = ((np.array(values) + rotation) % HUES).astype(np.uint8)
    difference = (circular_median(rotated) - circular_median(hues) - rotation) % HUES
    assert min(difference, HUES - difference) == pytest.approx(0.0, abs=1e-6)
    assert circular_median(hues) % HUES == pytest.approx(float(np.median(values)) % HUES, abs=1e-6)


def test_the_camera_file_is_the_recordings_with_markers(datasets: Path, tmp_path: Path) -> None:
    folder = datasets / "stereo/calib_colors"
    rows = calibrate_colours(folder, "left", tmp_path / "left.json")
    camera = load(tmp_path / "left.json", CameraCalibration)
    assert camera.markers == {r.name: r.range for r in rows}
    assert camera.width_px == 640
    assert all(r.own == 1.0 and not r.others and r.skin == 0.0 and r.background < 1e-4 for r in rows)


def test_a_recording_without_clicks_needs_a_moving_hand(datasets: Path, tmp_path: Path) -> None:
    hand = datasets / "hands/webxr-right.json"
    with pytest.raises(FitError, match=r"0 paints move with the hand .* the rig has 6 markers"):
        calibrate_colours(datasets / "stereo/sweep_paper", "left", tmp_path / "left.json", hand=hand)
    with pytest.raises(FitError, match="1 frames, at least 8 are needed"):
        calibrate_colours(datasets / "stereo/calib_colors", "left", tmp_path / "left.json", auto=True)


def test_the_reference_is_the_paints_colour_in_linear_light() -> None:
    for row, hue in zip(calibrate(IMAGE, CLICKS), HUE, strict=True):
        assert row.range.reference_bgr_linear is not None
        np.testing.assert_allclose(row.range.reference_bgr_linear, linear((hue, 180, 150)), rtol=0.15)


def test_background_that_may_look_like_a_marker_is_warned_of() -> None:
    pen = Disc(marker_hsv(2), 560.0, 120.0, 5.0)  # 80 px: too few for a collision in share
    text = report(calibrate(render([*hand(), pen]), CLICKS))
    assert "no collisions" in text
    assert "warning: middle: 8" in text or "warning: middle: 7" in text
    assert "warning" not in report(calibrate(IMAGE, CLICKS))
