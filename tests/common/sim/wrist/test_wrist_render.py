"""Simulated wrist frames: the line is drawn where the truth says, light falls off as light does, the sensor is one."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.arrays import Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError
from common.recording.frame_recording import Illumination
from common.sim.scenes import renderer_of
from common.sim.wrist.render import SURFACE_AT_M, Sensor, WristRenderer, led_levels
from common.sim.wrist.scene import WristScene

CALIB = Path(__file__).resolve().parents[4] / "calib_json"
CAMERAS = {"wrist": load(CALIB / "cameras/wrist.json", CameraCalibration)}
RIG = load(CALIB / "rigs/wrist.json", RigCalibration)
HAND = load(CALIB / "hands/default-right.json", HandProfile)
AMBIENT, LASER, LED = Illumination.AMBIENT, Illumination.LASER, Illumination.LED
COARSE = 4  # pixels a side that are looked at together, where the fine picture says no more


def scene(name: str, seed: int = 4) -> WristScene:
    return WristScene.by_name(name, RIG, CAMERAS, HAND, seed)


def of_light(shown: WristScene, renderer: WristRenderer, t_s: float, lit: Illumination) -> Image:
    return np.asarray(cv2.subtract(renderer.render(t_s, lit), renderer.render(t_s, AMBIENT)), dtype=np.uint8)


def centre_of_line(image: Image, uv: Float) -> float:
    """Row of the middle of a bright line near (u, v), in the column of u."""
    u, v = (round(float(x)) for x in uv)
    rows = np.arange(max(v - 9, 0), min(v + 10, image.shape[0]))
    light = image[rows, u].astype(np.float64)
    light = np.maximum(light - 0.1 * light.max(), 0.0)  # without the glow beside it
    return float((rows * light).sum() / light.sum())


@cache
def curl() -> tuple[WristScene, WristRenderer]:
    """A curl in a dark room, and what renders it."""
    shown = scene("curl@dark")
    return shown, WristRenderer(shown, "wrist")


@pytest.mark.parametrize("t_s", [0.8, 2.2, 3.0])
def test_the_line_is_drawn_where_the_truth_says_to_parts_of_a_pixel(t_s: float) -> None:
    shown, renderer = curl()
    dim = renderer.exposed(60.0, np.full(3, 0.03))  # so that it does not saturate
    image = dim.render(t_s, LASER)
    bodies = shown.capsules.bodies(shown.truth(t_s).joints)
    curve = shown.sheet.cross(bodies)
    uv = shown.optics.project(curve.points)
    off: list[float] = []
    for finger in range(2, 6):
        own = np.flatnonzero((curve.group == finger) & curve.seen)
        order = own[np.argsort(uv[own, 0])]
        # Columns lie at whole pixels: the exact line there, by its neighbours, where it runs across.
        for u in range(int(uv[own, 0].min()) + 6, int(uv[own, 0].max()) - 5, 2):
            sides = np.interp([u - 2.0, u, u + 2.0], uv[order, 0], uv[order, 1])
            if abs(sides[2] - sides[0]) < 1.0:
                off.append(centre_of_line(image, np.array([u, sides[1]])) - float(sides[1]))
    assert len(off) > 15
    assert abs(np.median(off)) < 0.1
    assert np.percentile(np.abs(off), 90) < 0.35


def test_of_one_instant_the_light_is_added_and_a_dark_room_shows_nothing_else() -> None:
    shown = scene("standard@dark")
    renderer = WristRenderer(shown, "wrist")
    frames = {lit: renderer.render(9.0, lit) for lit in (AMBIENT, LASER, LED)}
    for image in frames.values():
        assert image.shape == (400, 640)
        assert image.dtype == np.uint8
    assert abs(float(np.median(frames[AMBIENT])) - 2.0) <= 1.0  # the black level
    assert frames[AMBIENT].max() < 12
    assert frames[LASER].max() == 255
    assert (frames[LED] > 30).mean() > 0.1
    truth = shown.truth(9.0)
    for finger in range(1, 6):
        if truth.laser_len_vis[finger] > 0.01:
            u, v = np.round(truth.laser_uv[finger]).astype(int)
            assert frames[LASER][v - 6 : v + 7, u].max() > 200
            assert frames[LED][v - 6 : v + 7, u].max() < 255


def test_the_same_instant_is_the_same_picture_and_another_kind_has_other_noise() -> None:
    one, again = (WristRenderer(scene("poses"), "wrist", COARSE) for _ in range(2))
    np.testing.assert_array_equal(one.render(4.0, LED), again.render(4.0, LED))
    ambient, laser = one.render(4.0, AMBIENT), one.render(4.0, LASER)
    corner = np.s_[5:60, 5:60]
    assert 0.05 < (ambient[corner] != laser[corner]).mean()


@pytest.mark.parametrize(
    ("ambient", "least", "most"),
    [("dark", 0.0, 0.0), ("indoor", 0.04, 0.35), ("bright", 0.04, 0.35), ("sun", 0.04, 0.7)],
)
def test_a_window_saturates_in_every_room_that_has_one(ambient: str, least: float, most: float) -> None:
    shares = [
        float(
            (
                WristRenderer(scene(f"curl@{ambient}", seed), "wrist", COARSE).render(0.0, AMBIENT) == 255
            ).mean()
        )
        for seed in (1, 2, 3)
    ]
    assert least <= min(shares)
    assert max(shares) <= most


def test_leds_light_by_the_inverse_square_and_the_cosine() -> None:
    leds = np.array([[0.0, 0.0, 0.0]] * 4)
    points = np.array(
        [[0.0, 0.0, SURFACE_AT_M], [0.0, 0.0, 2 * SURFACE_AT_M], [0.0, 0.0, SURFACE_AT_M]], dtype=np.float32
    )
    normals = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [np.sqrt(0.75), 0.0, -0.5]], dtype=np.float32)
    near, far, aslant = led_levels(leds, points, normals).tolist()
    assert near == pytest.approx(4.0 * far, rel=1e-5)
    assert near == pytest.approx(2.0 * aslant, rel=1e-5)
    behind = led_levels(leds, points[:1], -normals[:1])
    assert behind[0] == 0.0


def test_noise_grows_with_light_and_light_is_cut_at_a_byte() -> None:
    sensor = Sensor(300, 300, 1)
    spread = [
        float(sensor.bytes_of(np.full((300, 300), level, dtype=np.float32), 5).std())
        for level in (12.0, 102.0)
    ]
    # Var = read + shot * level: 0.35 + 0.32 and 0.35 + 3.2, and 1/12 of rounding.
    assert spread[0] == pytest.approx(np.sqrt(0.35 + 0.32 + 1 / 12), rel=0.05)
    assert spread[1] == pytest.approx(np.sqrt(0.35 + 3.2 + 1 / 12), rel=0.05)
    assert (sensor.bytes_of(np.full((300, 300), 1e6, dtype=np.float32), 5) == 255).all()
    assert float(np.median(sensor.bytes_of(np.full((300, 300), -50.0, dtype=np.float32), 5))) == 0.0


def test_exposure_and_gain_brighten_and_what_was_prepared_is_shared() -> None:
    shown = scene("curl")
    renderer = WristRenderer(shown, "wrist", COARSE)
    brighter = renderer.exposed(4000.0, np.full(3, 2.0))
    before, after = (
        float(np.median(of_light(shown, r, 1.0, LED)[260:, 100:500])) for r in (renderer, brighter)
    )
    assert after == pytest.approx(2.0 * before, rel=0.1)


def test_the_coarse_grid_of_real_time_shows_what_the_fine_one_shows() -> None:
    shown = scene("poses@dark", 9)
    fine, coarse = (WristRenderer(shown, "wrist", step).render(6.0, LED).astype(float) for step in (1, 2))
    apart = np.abs(fine - coarse)
    assert np.median(apart[fine > 20]) < 4.0
    assert (apart > 40).mean() < 0.01  # edges


def test_live_pictures_show_what_exact_ones_show() -> None:
    shown = WristScene.by_name("grasp@dark", RIG, CAMERAS, HAND, 7)
    live, exact = renderer_of(shown, "wrist", live=True), renderer_of(shown, "wrist")
    for t_s in (6.0, 6.01):  # a bent wrist and a bar; the palm of the second is that of the first
        for lit in (LED, LASER):
            one, other = (renderer.render(t_s, lit).astype(float) for renderer in (live, exact))
            assert np.median(np.abs(one - other)[other > 20]) < 5.0
            assert (np.abs(one - other) > 40).mean() < 0.015  # edges


def test_another_camera_is_refused() -> None:
    with pytest.raises(CalibrationError, match="no camera 'left'"):
        WristRenderer(scene("curl"), "left")


def test_skin_that_gives_back_a_fifth_less_light_is_darker_by_that_and_lies_where_it_lay() -> None:
    typical, dull = scene("poses@dark"), replace(scene("poses@dark"), reflectance=0.8)
    bright = WristRenderer(typical, "wrist").render(2.0, LED).astype(np.float64)
    dark = WristRenderer(dull, "wrist").render(2.0, LED).astype(np.float64)
    surface = (bright > 40.0) & (bright < 250.0)
    assert surface.sum() > 10_000
    assert np.median((dark[surface] - 2.0) / (bright[surface] - 2.0)) == pytest.approx(0.8, abs=0.01)
    dim = [WristRenderer(one, "wrist").exposed(60.0, np.full(3, 0.01)) for one in (typical, dull)]
    line, duller = (one.render(2.0, LASER).astype(np.float64) - 2.0 for one in dim)
    lit = (line > 12.0) & (line < 250.0)
    assert np.median(duller[lit] / line[lit]) == pytest.approx(0.8, abs=0.05)
    np.testing.assert_array_equal(dull.truth(2.0).laser_uv, typical.truth(2.0).laser_uv)


@pytest.mark.parametrize("reflectance", [0.0, -1.0, np.nan, np.inf])
def test_skin_that_gives_back_no_light_is_refused(reflectance: float) -> None:
    with pytest.raises(CalibrationError, match="reflectance"):
        replace(scene("poses"), reflectance=reflectance)
