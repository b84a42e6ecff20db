"""A bent wrist turns the palm before the camera: how it lies is seen, and fingers keep their names."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from common.arrays import Float
from common.hand.wrist import STRAIGHT
from common.sim.motion import FIST, REST, HandMotion, HandState, angles_of
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from slave.sources import Frame
from slave.wrist.detector import find
from slave.wrist.laser import laser_lines, separate
from slave.wrist.led_image import shrink
from slave.wrist.palm_pose import find_palm_pose, prepare, rotated_view, wrist_angles_seen
from slave.wrist.strobe import StrobeCycle
from tests.slave.wrist.wrist_frames import VIEW, Seen, scene, seen_at

WRIST_ANGLES = ((22.0, -8.0), (-16.0, 8.0), (0.0, 12.0), (0.0, -12.0), (12.0, 8.0), (-15.0, -8.0))
FLEXION_DEG, DEVIATION_DEG = 8.0, 2.5  # of error; between two fingers there are about 12 degrees
NEAR_PX = 6.0


class Held:
    """A hand that holds still in one posture, its wrist bent."""

    period_s = 60.0

    def __init__(self, motion: HandMotion, angles_rad: Float, wrist_angles_rad: Float) -> None:
        self._state = replace(motion.at(0.0), angles_rad=angles_rad, wrist_angles_rad=wrist_angles_rad)

    def at(self, t_s: float) -> HandState:
        """The same at any time."""
        del t_s
        return self._state


@cache
def seen(wrist_deg: tuple[float, float], curled: float = 0.1, seed: int = 5) -> Seen:
    """A hand between rest (0) and fist (1)."""
    whole = scene("standard@indoor", seed)
    rest, fist = np.array(REST, dtype=np.float64), np.array(FIST, dtype=np.float64)
    angles = angles_of(whole.model, rest + curled * (fist - rest), np.zeros((5, 4)))
    held: WristScene = replace(whole, motion=Held(whole.motion, angles, np.radians(wrist_deg)))
    return seen_at(held, WristRenderer(held, "wrist", 2), 0.0)


@pytest.mark.parametrize("wrist_angles", WRIST_ANGLES)
def test_the_bend_of_a_wrist_is_seen(wrist_angles: tuple[float, float]) -> None:
    off = np.degrees(find_palm_pose(seen(wrist_angles).led, VIEW).wrist_angles_rad) - wrist_angles
    assert abs(off[0]) < FLEXION_DEG
    assert abs(off[1]) < DEVIATION_DEG


@pytest.mark.parametrize("curled", [0.0, 0.4, 0.8, 1.0])
def test_a_straight_wrist_changes_nothing(curled: float) -> None:
    rotation = find_palm_pose(seen((0.0, 0.0), curled).led, VIEW)
    assert rotation.straight
    assert rotation.view is VIEW


def test_neither_the_dark_nor_noise_is_a_bent_wrist() -> None:
    rng = np.random.default_rng(3)
    dark = np.zeros((VIEW.optics.height_px, VIEW.optics.width_px), np.uint8)
    for image in (dark, dark + 200, rng.integers(0, 12, dark.shape).astype(np.uint8)):
        assert find_palm_pose(image, VIEW).straight


def test_twice_the_light_is_the_same_bend() -> None:
    led = seen((12.0, 8.0)).led // 2
    once, twice = (wrist_angles_seen(np.sqrt(shrink(image)), VIEW) for image in (led, 2 * led))
    assert np.degrees(np.abs(once - twice)).max() < 2.0


@pytest.mark.parametrize("wrist_angles", WRIST_ANGLES)
def test_fingers_keep_their_names(wrist_angles: tuple[float, float]) -> None:
    one = seen(wrist_angles)
    found = laser_lines(one.laser, separate(one.led, VIEW), VIEW).uv[1:]
    known = np.isfinite(found[:, 0])
    off = np.linalg.norm(found - one.truth.laser_uv[2:6], axis=1)
    assert (off[known] < NEAR_PX).all()
    assert known[one.truth.laser_len_vis[2:6] > 2e-3].all()


def test_the_palm_that_comes_into_the_plane_is_no_finger() -> None:
    one = seen((24.0, 0.0))
    assert one.truth.laser_len_vis[0] > 0.02
    assert np.isnan(one.truth.laser_uv[1:6]).all()
    assert np.isnan(laser_lines(one.laser, separate(one.led, VIEW), VIEW).uv).all()


def test_no_tip_is_reported_of_a_bent_wrist() -> None:
    one = seen((0.0, -12.0))
    assert not separate(one.led, VIEW).palm_pose.straight
    dark = np.zeros_like(one.led)
    ambient, laser, led = (Frame(k, k, k, image) for k, image in enumerate((dark, one.laser, one.led)))
    assert np.isnan(find(StrobeCycle(ambient, laser, led), VIEW).tips.uv).all()


def test_a_view_is_ready_for_every_bend() -> None:
    ready = prepare(VIEW)
    assert VIEW in ready
    assert rotated_view(VIEW, STRAIGHT).T_camera_palm == pytest.approx(VIEW.T_camera_palm)
    assert all(find_palm_pose(seen(wrist_angles).led, VIEW).view in ready for wrist_angles in WRIST_ANGLES)
