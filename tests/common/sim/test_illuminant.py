"""Light of the simulation: chromaticities against published ones, gains as von Kries says, pictures accordingly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import PhalanxError
from common.geometry.srgb import gain_tables, to_linear, to_srgb
from common.sim.light import CALIBRATED_KELVIN, ROOM, Light, LightSchedule, planckian_xy, white
from common.sim.render import Renderer
from common.sim.scene import Scene
from common.sim.scenes import scene_by_name

ROOT = Path(__file__).resolve().parents[3]
RIG = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
CAMERAS = {name: load(ROOT / f"calib_json/cameras/{name}.json", CameraCalibration) for name in RIG.cameras}
HAND = load(ROOT / "calib_json/hands/default-right.json", HandProfile)

kelvins = st.floats(2000.0, 20000.0)


@pytest.mark.parametrize(
    ("kelvin", "xy"),
    [  # Wyszecki and Stiles, Color Science (1982), and CIE 15: Planckian radiators; 2856 K is CIE illuminant A
        (2000.0, (0.5267, 0.4133)),
        (2856.0, (0.4476, 0.4074)),
        (4000.0, (0.3805, 0.3768)),
        (5000.0, (0.3451, 0.3516)),
        (6500.0, (0.3135, 0.3237)),
        (10000.0, (0.2807, 0.2884)),
    ],
)
def test_published_chromaticities(kelvin: float, xy: tuple[float, float]) -> None:
    np.testing.assert_allclose(planckian_xy(kelvin), xy, atol=7e-4)


def test_the_white_of_6500_kelvin_is_nearly_that_of_srgb() -> None:
    # D65 lies 0.005 above the Planckian locus: white to a few percent, and luminance exactly 1.
    np.testing.assert_allclose(white(6504.0), 1.0, atol=0.05)
    assert white(6504.0) @ [0.2126729, 0.7151522, 0.0721750] == pytest.approx(1.0, abs=1e-4)


@given(kelvins, kelvins)
def test_warmer_light_has_more_red_and_less_blue(a: float, b: float) -> None:
    warm, cool = min(a, b), max(a, b)
    if cool - warm > 50.0:
        blue, green, red = Light(warm).gains_bgr(cool)
        assert red > green > blue


@given(kelvins, kelvins, kelvins, st.floats(0.5, 2.0))
def test_gains_chain_and_exposure_is_common(a: float, b: float, c: float, exposure: float) -> None:
    np.testing.assert_allclose(Light(a).gains_bgr(b) * Light(b).gains_bgr(c), Light(a).gains_bgr(c))
    np.testing.assert_allclose(Light(a, exposure).gains_bgr(b), exposure * Light(a).gains_bgr(b))


def test_the_range_that_is_followed_in_numbers() -> None:
    # By hand from Kang's splines: white(3000) = (1.767, 0.845, 0.273), white(6500) = (1.043, 0.984, 1.035).
    np.testing.assert_allclose(Light(3000.0).gains_bgr(6500.0), [0.263, 0.859, 1.694], atol=2e-3)


def test_a_course_goes_straight_jumps_and_stays() -> None:
    schedule = LightSchedule(((1.0, 3000.0, 1.0), (3.0, 5000.0, 0.5), (3.0, 6500.0, 1.5)))
    assert schedule.at(0.0) == Light(3000.0, 1.0)
    assert schedule.at(2.0) == Light(4000.0, 0.75)
    assert schedule.at(3.0) == schedule.at(99.0) == Light(6500.0, 1.5)
    assert schedule.at(2.999999).kelvin == pytest.approx(5000.0, abs=0.01)


def test_an_impossible_light_is_refused() -> None:
    with pytest.raises(PhalanxError, match="1000 K"):
        planckian_xy(1000.0)


def test_bytes_change_in_linear_light_and_clip() -> None:
    tables = gain_tables([1.0, 0.5, 2.0])
    np.testing.assert_array_equal(tables[0], np.arange(256))
    # sRGB 188 is half the light of 255 (IEC 61966-2-1: 0.5 -> 0.7354).
    assert tables[1][255] == 188
    assert tables[2][188] == 255
    assert tables[2][220] == 255
    assert to_linear(to_srgb(np.array(0.25))) == pytest.approx(0.25)


def test_a_picture_under_another_light() -> None:
    plain = Scene.standard(RIG, CAMERAS, HAND)
    lit = replace(plain, light=LightSchedule(((0.0, 3000.0, 0.8),)))
    before, after = Renderer(plain, "left").render(20.0), Renderer(lit, "left").render(20.0)
    quiet = (before > 60) & (before < 150)  # neither clipped, nor so dark that noise is most of it
    for channel, gain in enumerate(Light(3000.0, 0.8).gains_bgr()):
        chosen = quiet[..., channel]
        light = [to_linear(image[..., channel][chosen] / 255.0).mean() for image in (before, after)]
        assert light[1] / light[0] == pytest.approx(gain, rel=0.02)


def test_calibrated_light_changes_no_pixel() -> None:
    plain = Scene.standard(RIG, CAMERAS, HAND)
    lit = replace(plain, light=LightSchedule(((0.0, CALIBRATED_KELVIN, 1.0),)))
    np.testing.assert_array_equal(Renderer(plain, "left").render(20.0), Renderer(lit, "left").render(20.0))


def test_the_scene_of_changing_light_by_its_name() -> None:
    scene = scene_by_name("lights", RIG, CAMERAS, HAND, 7)
    assert scene.light == ROOM
    kelvin = [ROOM.at(t).kelvin for t in np.linspace(0.0, 60.0, 601)]
    exposure = [ROOM.at(t).exposure for t in np.linspace(0.0, 60.0, 601)]
    assert (min(kelvin), max(kelvin), min(exposure), max(exposure)) == pytest.approx(
        (3000.0, 6500.0, 0.7, 1.3)
    )
    assert ROOM.at(0.0) == ROOM.at(60.0)
    assert scene_by_name("standard", RIG, CAMERAS, HAND, 7).light is None
