"""Colours from clicks on the picture of a running camera: as good as calibrated ones, and a poor click is told."""

import dataclasses
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration, HsvRange, load, save
from common.calibration.camera_settings import ColourPick
from common.errors import CameraError, FitError
from common.geometry.srgb import gain_tables
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.live import ColourSampler
from slave.markers.classify import hue_distance, in_range
from slave.markers.colours import SampledColours, calibrate, hsv_of
from slave.markers.detector import MarkerDetector
from slave.markers.illuminant import undone
from slave.markers.reloadable import (
    CalibratedDetector,
    LightAdaptiveDetector,
    ReloadableDetector,
    marker_changes,
)
from slave.markers.white_balance import Inline
from slave.sources import Frame
from slave.tuning import CameraTuning
from tests.slave import painted
from tests.slave.painted import HUE, NAMES
from tests.slave.test_tuning import CAMERAS, HAND, RIG, Knobs, tree

PICTURE = painted.render(painted.hand(), noise=2.0)
AT = {name: (300.0 + x, 200.0 + y) for name, (x, y) in zip(NAMES, painted.CENTRES.tolist(), strict=True)}
SAME = np.zeros(3)


def picked(
    image: Image, *names: str, ranges: dict[str, HsvRange] | None = None, log_gains: np.ndarray = SAME
) -> dict[str, HsvRange]:
    colours, found = SampledColours(), dict(ranges or {})
    for name in names:
        found, _ = colours.sample(image, log_gains, name, AT[name], found)
    return found


def test_six_clicks_detect_as_well_as_the_calibrated_ranges() -> None:
    scene = Scene.standard(RIG, CAMERAS, HAND)
    errors: list[list[np.ndarray]] = [[], []]  # calibrated, clicked
    for camera in RIG.cameras:
        renderer = Renderer(scene, camera)
        image, truth = renderer.render(0.3), renderer.markers(0.3)
        colours, ranges = SampledColours(), dict[str, HsvRange]()
        for name, uv in zip(RIG.markers, truth.uv, strict=True):
            ranges, row = colours.sample(image, SAME, name, (uv[0] + 2.0, uv[1] - 2.0), ranges)
            assert row.own > 0.95
            assert (row.skin, row.background_px) == (0.0, 0.0)
        files = CAMERAS[camera], replace(CAMERAS[camera], markers=ranges)
        detectors = [MarkerDetector(file, RIG.markers) for file in files]
        for k in range(20):
            t_s = 0.3 + k / 10
            image, truth = renderer.render(t_s), renderer.markers(t_s)
            for error, detector in zip(errors, detectors, strict=True):
                uv = detector.push(image, round(t_s * 1e9)).uv
                error.append(np.where(truth.visible > 0.5, np.linalg.norm(uv - truth.uv, axis=1), np.nan))
    calibrated, clicked = np.array(errors)
    assert np.isfinite(clicked).sum() >= 0.97 * np.isfinite(calibrated).sum() > 0.3 * clicked.size
    assert np.nanmedian(clicked) < np.nanmedian(calibrated) + 0.02  # px
    assert np.nanpercentile(clicked, 90) < 1.1 * np.nanpercentile(calibrated, 90)


def test_in_whatever_order_the_ranges_are_those_of_six_clicks_in_one_picture() -> None:
    want = {row.name: row.range for row in calibrate(PICTURE, AT)}
    for names in (NAMES, NAMES[::-1]):
        got = picked(PICTURE, *names)
        for name in NAMES:
            np.testing.assert_allclose(got[name].hsv_low, want[name].hsv_low, atol=2)
            np.testing.assert_allclose(got[name].hsv_high, want[name].hsv_high, atol=2)
            np.testing.assert_allclose(
                got[name].reference_bgr_linear or (), want[name].reference_bgr_linear or (), rtol=0.05
            )


def test_a_click_next_to_a_small_marker_is_meant_for_it() -> None:
    straight = picked(PICTURE, "index")["index"]
    u, v = AT["index"]
    for du, dv in ((7.0, -6.0), (0.0, -15.0), (-6.9, 0.0)):  # in the picture, beside it, on its rim
        off_centre, _ = SampledColours().sample(PICTURE, SAME, "index", (u + du, v + dv), {})
        np.testing.assert_allclose(off_centre["index"].hsv_low, straight.hsv_low, atol=2)


@pytest.mark.parametrize(
    ("marker", "uv", "expected"),
    [
        ("index", (700.0, 3.0), r"pick index: \(700, 3\) is outside the 640x480 image"),
        (
            "index",
            (40.0, 40.0),
            r"\(40, 40\) is not on a paint: saturation 2\d of 255, .*: click on the paint",
        ),
        ("index", (300.0, 232.0), r"is skin, or looks like it: click on the paint; paints that are red"),
        (
            "ring",
            AT["index"],
            r"nearly the hue of marker index \(66, 66\): if this is the paint of index, click on",
        ),
        ("back", (560.0, 400.0), r"covers 1\d% of the picture, which is no marker"),
        ("back", (100.0, 420.0), r"is not of one colour \(hues \d+ apart\): repaint it evenly"),
        (
            "back",
            (600.0, 30.0),
            r"is on a spot of fewer than 6 pixels of one colour: bring the marker nearer",
        ),
    ],
)
def test_a_click_that_makes_no_colour_says_what_to_do(
    marker: str, uv: tuple[float, float], expected: str
) -> None:
    image = PICTURE.copy()
    image[300:, 440:] = (20, 160, 20)  # a wall of paint
    across = np.array([[(100 + k * 17 // 60, 200, 150) for k in range(60)]], np.uint8)
    image[400:440, 70:130] = cv2.cvtColor(across, cv2.COLOR_HSV2BGR)
    image[29:31, 599:601] = (20, 160, 20)
    with pytest.raises(FitError, match=expected):
        SampledColours().sample(image, SAME, marker, uv, picked(PICTURE, "index"))


def patch(hsv: tuple[int, int, int], *, on_skin: bool) -> Image:
    """A disc of paint of 24 px at (120, 100), on a desk or on a hand."""
    hand = [painted.Disc(painted.SKIN, 120.0, 100.0, 34.0)] if on_skin else []
    return painted.render([*hand, painted.Disc(hsv, 120.0, 100.0, 12.0)], 240, 200, noise=2.0)


NO_PAINT, LIKE_SKIN = (
    r"is not on a paint: saturation \d+ of 255, brightness",
    r"is skin, or looks like it.*red, orange",
)


@pytest.mark.parametrize("on_skin", [False, True])
@pytest.mark.parametrize(
    ("hsv", "expected"),
    [
        ((110, 204, 8), NO_PAINT),  # near black: the hue is noise
        ((110, 204, 20), NO_PAINT),
        ((60, 120, 12), NO_PAINT),
        ((175, 230, 150), LIKE_SKIN),  # red, on both sides of the wrap
        ((179, 230, 150), LIKE_SKIN),
        ((0, 230, 200), LIKE_SKIN),
        ((4, 230, 90), LIKE_SKIN),
        ((0, 150, 200), LIKE_SKIN),
        ((12, 200, 200), LIKE_SKIN),  # orange
        ((15, 240, 230), LIKE_SKIN),
        ((20, 230, 220), LIKE_SKIN),  # warm yellow
        ((12, 120, 60), LIKE_SKIN),  # dark skin
    ],
)
def test_black_red_and_orange_are_refused_by_both_kinds_of_click(
    hsv: tuple[int, int, int], expected: str, on_skin: bool
) -> None:
    image, at = patch(hsv, on_skin=on_skin), (120.0, 100.0)
    with pytest.raises(FitError, match=r"clicks.index: \(120, 100\) " + expected):
        calibrate(image, {"index": at})
    with pytest.raises(FitError, match=r"pick index: \(120, 100\) " + expected):
        SampledColours().sample(image, SAME, "index", at, {})


@pytest.mark.parametrize("on_skin", [False, True])
@pytest.mark.parametrize("hsv", [(27, 230, 220), (172, 220, 160), (110, 204, 40)])
def test_yellow_magenta_and_dark_blue_make_a_range_that_holds_them(
    hsv: tuple[int, int, int], on_skin: bool
) -> None:
    image, at = patch(hsv, on_skin=on_skin), (120.0, 100.0)
    [clicked] = calibrate(image, {"index": at})
    _, picked_one = SampledColours().sample(image, SAME, "index", at, {})
    for row in (clicked, picked_one):
        assert row.own > 0.95
        assert row.skin < 0.01
        span = (row.range.hsv_high[0] - row.range.hsv_low[0]) % 180
        assert (hsv[0] - row.range.hsv_low[0]) % 180 <= span < 30


def test_a_click_on_skin_in_shadow_beside_a_marker_is_meant_for_the_marker() -> None:
    shade = painted.Disc((12, 140, 66), 120.0, 100.0, 40.0)
    image = painted.render([shade, painted.Disc((66, 200, 150), 130.0, 100.0, 9.0)], 640, 200, noise=1.0)
    _, row = SampledColours().sample(image, SAME, "index", (114.0, 100.0), {})
    assert row.range.hsv_low[0] <= 66 <= row.range.hsv_high[0]


def test_a_range_of_the_file_gives_up_the_hues_that_a_picked_one_needs() -> None:
    wide = HsvRange(hsv_low=(HUE[1] - 20, 70, 50), hsv_high=(HUE[1] + 20, 255, 255))
    got = picked(PICTURE, "thumb", ranges={"index": wide, "little": painted.RANGES["little"]})
    assert got["little"] == painted.RANGES["little"], "it is far away"
    assert got["index"].hsv_low == wide.hsv_low
    assert got["index"].hsv_high[0] < got["thumb"].hsv_low[0]
    assert got["index"].hsv_low[0] <= HUE[1] <= got["index"].hsv_high[0]


def test_a_range_that_was_set_by_hand_since_is_not_made_again() -> None:
    colours = SampledColours()
    ranges, _ = colours.sample(PICTURE, SAME, "index", AT["index"], {})
    mine = replace(ranges["index"], hsv_low=(60, 111, 99))
    again, _ = colours.sample(PICTURE, SAME, "little", AT["little"], {"index": mine})
    assert again["index"] == mine


def test_under_another_light_a_colour_is_picked_as_under_that_of_calibration() -> None:
    gains = np.log([0.7, 1.0, 1.3])
    other = np.asarray(cv2.LUT(PICTURE, gain_tables(np.exp(gains)).T[None]), np.uint8)
    plain, back = (
        picked(image, "ring", log_gains=g)["ring"] for image, g in ((PICTURE, SAME), (other, gains))
    )
    np.testing.assert_allclose(back.hsv_low, plain.hsv_low, atol=2)
    astray = picked(other, "ring")["ring"]
    assert hue_distance(astray.hsv_low[0], plain.hsv_low[0]) > 3, "the light does matter"
    assert in_range(hsv_of(undone(other, gains)), plain)[int(AT["ring"][1]), int(AT["ring"][0])]


def test_from_no_colour_at_all_to_a_slave_that_follows_the_light(tmp_path: Path) -> None:
    """What the commands do: nothing is seen, each pick adds its marker, with the last all are followed; then saved."""
    rig = replace(RIG, markers=NAMES)
    bare = replace(painted.camera(), markers=None)
    detector = ReloadableDetector(CalibratedDetector(bare, NAMES))

    def make(camera: CameraCalibration, _rig: object) -> CalibratedDetector | LightAdaptiveDetector:
        whole = set(NAMES) <= set(camera.markers or {})
        return LightAdaptiveDetector(camera, NAMES, Inline()) if whole else CalibratedDetector(camera, NAMES)

    files = dataclasses.replace(tree(tmp_path), camera=bare, rig=rig)
    save(files.camera_path, bare)
    knobs = Knobs()
    shown: dict[int, Frame] = {}
    sampler = ColourSampler(detector, shown.get, NAMES)
    tuning = CameraTuning(files, knobs, marker_changes(detector, make), lambda: True, sampler.pick)
    commands = tuning.commands()

    def sample(name: str, t_ns: int | None = None) -> dict[str, float]:
        body = ColourPick(marker=name, uv=AT[name], t_ns=t_ns)
        return dict(commands["pick"](msgspec.json.encode(body).decode()))

    with pytest.raises(CameraError, match="no frame was read yet"):
        sample("thumb")
    moved = painted.render(painted.hand(340.0, 230.0))
    detector.push(moved, 0)
    for k, name in enumerate(NAMES):
        with pytest.raises(FitError):
            sample(name)  # the hand has moved on since the picture that was clicked on
        shown[7] = Frame(0, 7, 7, PICTURE)
        metrics = sample(name, 7)
        shown.clear()
        assert metrics["pick.pixels"] > 100
        assert metrics[f"marker.{name}.h_low"] < HUE[k] < metrics[f"marker.{name}.h_high"]
        detector.push(moved, (2 * k + 1) * 16_666_667)
        found = detector.push(moved, (2 * k + 2) * 16_666_667).uv
        assert np.isfinite(found[:, 0]).sum() == k + 1
    assert detector.adaptive is not None
    assert load(files.camera_path, CameraCalibration) == bare, "not asked to save"
    commands["save"]("")
    saved = load(files.camera_path, CameraCalibration)
    assert set(saved.markers or {}) >= set(NAMES)
    assert saved.provenance["markers"].tool == "phalanx-slave pick"
    assert knobs.tuned == [], "the camera is as it was"
