"""Changes of the light seen on what stands still: exact on a still picture, unmoved by what moves before it."""

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float, Image
from common.geometry.srgb import gain_tables
from common.sim.light import Light
from slave.markers.white_balance import AGREE, EVERY_NS, Change, LightMeter

SIZE = (320, 240)
FRAME_NS = 16_666_667
STILL = np.zeros(3)


@cache
def desk(seed: int = 0) -> Image:
    """A worn grey desk with a few things on it."""
    rng = np.random.default_rng(seed)
    image = np.clip(rng.normal(110.0, 9.0, (240, 320, 3)), 0, 255).astype(np.uint8)
    cv2.rectangle(image, (20, 20), (110, 60), (60, 140, 70), -1)
    cv2.rectangle(image, (200, 170), (300, 230), (40, 50, 60), -1)
    return image


@cache
def noise(k: int) -> npt.NDArray[np.int16]:
    return np.random.default_rng([k, 9]).normal(0.0, 2.0, (240, 320, 3)).round().astype(np.int16)


def seen(image: Image, gains: Float, k: int) -> Image:
    """One frame under a light, with other noise than the 31 before it."""
    lit = np.asarray(cv2.LUT(image, gain_tables(gains).T[None]), dtype=np.int16)
    return np.clip(lit + noise(k % 32), 0, 255).astype(np.uint8)


@cache
def desk_under(share: float) -> Image:
    return covered(desk(), share)


def covered(image: Image, share: float) -> Image:
    """Skin over so much of the picture, from the left."""
    image = image.copy()
    rng = np.random.default_rng(4)
    width = round(share * image.shape[1])
    image[:, :width] = np.clip(rng.normal((150, 180, 220), 8.0, (240, width, 3)), 0, 255).astype(np.uint8)
    return image


def measured(meter: LightMeter, image: Image, t_ns: int) -> Float:
    """The change, 0 where none was measured."""
    change = meter.push(image, t_ns)
    return STILL if change is None else change.log_gains


def forced(meter: LightMeter, image: Image, t_ns: int) -> Change:
    change = meter.push(image, t_ns)
    assert change is not None
    return change


@given(st.floats(3000.0, 6500.0), st.floats(0.7, 1.3))
@settings(max_examples=20, deadline=None)
def test_any_change_is_measured(kelvin: float, exposure: float) -> None:
    gains = Light(kelvin, exposure).gains_bgr()
    meter = LightMeter(*SIZE)
    meter.push(seen(desk(), np.ones(3), 0), 0)
    change = meter.push(seen(desk(), gains, 1), EVERY_NS)
    assert change is not None
    assert change.sure
    np.testing.assert_allclose(change.log_gains, np.log(gains), atol=0.03)


@pytest.mark.parametrize(
    ("kelvin", "exposure"), [(3000.0, 1.0), (3400.0, 1.0), (6500.0, 1.0), (4300.0, 0.7), (4300.0, 1.3)]
)
def test_a_switched_lamp_is_seen_in_the_next_frame(kelvin: float, exposure: float) -> None:
    gains = Light(kelvin, exposure).gains_bgr()
    meter = LightMeter(*SIZE)
    assert meter.push(seen(desk(), np.ones(3), 0), 0) is None
    assert meter.push(seen(desk(), np.ones(3), 1), FRAME_NS) is None  # noise alone is no reason to measure
    change = meter.push(seen(desk(), gains, 2), 2 * FRAME_NS)
    assert change is not None
    np.testing.assert_allclose(change.log_gains, np.log(gains), atol=0.03)


def test_the_sum_of_all_changes_is_the_light_after_a_slow_day() -> None:
    meter, total = LightMeter(*SIZE), np.zeros(3)
    kelvin = np.r_[np.linspace(4300.0, 3000.0, 200), np.linspace(3000.0, 6500.0, 400)]
    for k, t in enumerate(kelvin):
        total += measured(meter, seen(desk(), Light(float(t)).gains_bgr(), k), 2 * k * FRAME_NS)
    np.testing.assert_allclose(total, np.log(Light(6500.0).gains_bgr()), atol=0.03)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.4])
def test_a_hand_over_part_of_the_picture_changes_no_light(share: float) -> None:
    meter, total = LightMeter(*SIZE), np.zeros(3)
    for k in range(60):
        image = desk_under(share) if 10 <= k < 50 else desk()
        total += measured(meter, seen(image, np.ones(3), k), k * FRAME_NS)
        np.testing.assert_allclose(total, 0.0, atol=0.08)
    np.testing.assert_allclose(total, 0.0, atol=0.03)


def test_where_too_much_is_covered_there_is_no_answer() -> None:
    meter = LightMeter(*SIZE)
    meter.push(seen(desk(), np.ones(3), 0), 0)
    half = forced(meter, seen(covered(desk(), 0.5), np.ones(3), 1), FRAME_NS)
    assert half.agreeing < AGREE
    assert not half.sure
    np.testing.assert_array_equal(half.log_gains, 0.0)
    again = forced(meter, seen(desk(), np.ones(3), 2), 2 * FRAME_NS)
    assert again.sure
    np.testing.assert_allclose(again.log_gains, 0.0, atol=0.03)


def test_a_change_during_cover_is_caught_up_when_the_cover_goes() -> None:
    gains = Light(5200.0, 0.9).gains_bgr()
    meter, total = LightMeter(*SIZE), np.zeros(3)
    for k in range(90):
        image = desk_under(0.6) if 20 <= k < 60 else desk()
        total += measured(meter, seen(image, gains if k >= 40 else np.ones(3), k), k * FRAME_NS)
    np.testing.assert_allclose(total, np.log(gains), atol=0.1)


def test_what_is_put_down_becomes_what_stands_still() -> None:
    moved = desk(1).copy()
    cv2.rectangle(moved, (0, 0), (150, 239), (40, 60, 120), -1)  # a board over 47 % of the desk
    meter = LightMeter(*SIZE)
    meter.push(seen(desk(), np.ones(3), 0), 0)
    agreeing = [forced(meter, seen(moved, np.ones(3), k), k * 10 * FRAME_NS).agreeing for k in range(1, 300)]
    assert agreeing[0] < 0.6
    assert agreeing[-1] > 0.95


@pytest.mark.parametrize("level", [0, 255])
def test_a_black_or_white_picture_determines_nothing(level: int) -> None:
    meter = LightMeter(*SIZE)
    meter.push(seen(desk(), np.ones(3), 0), 0)
    change = forced(meter, np.full((240, 320, 3), level, np.uint8), FRAME_NS)
    assert (change.sure, change.agreeing) == (False, 0.0)
    np.testing.assert_array_equal(change.log_gains, STILL)
