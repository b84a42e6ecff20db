"""Whose a part of the laser line is, where the palm is not quite where calibration found it, or the seams are wrong."""

from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace

from bench.both.scene import Both
from common.geometry.transforms import rotation_vector_to_matrix
from common.sim.wrist.render import WristRenderer
from slave.wrist.laser import finger_labels, laser_lines, separate
from slave.wrist.led_image import WristView
from slave.wrist.runs import NONE, lines
from slave.wrist.workspace import workspace_of
from tests.slave.wrist.wrist_frames import CAMERA, HAND, RIG, VIEW, Seen, scene, seen_at

VISIBLE_M = 2e-3
NEAR_PX = 10.0


@cache
def seen(name: str) -> list[Seen]:
    """A scene at nine times."""
    one = scene(name, 61)
    device = WristRenderer(one, "wrist", 2)
    return [seen_at(one, device, t) for t in np.linspace(1.0, 58.0, 9).tolist()]


@cache
def rotated_view(degrees: tuple[float, float, float]) -> WristView:
    """The view of a device whose palm is believed to be turned against where it is."""
    palm = VIEW.T_camera_palm.copy()
    palm[:3, :3] = rotation_vector_to_matrix(np.radians(degrees)) @ palm[:3, :3]
    rows = tuple(tuple(row) for row in palm.tolist())
    return WristView.of(replace(RIG, T_camera_palm=rows), CAMERA, HAND)


@pytest.mark.parametrize("degrees", [(0.0, 2.0, 0.0), (0.0, -2.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, -3.0)])
@pytest.mark.parametrize("name", ["spread@indoor", "poses@indoor"])
def test_fingers_are_distinguished_though_the_palm_is_not_quite_where_it_should_be(
    name: str, degrees: tuple[float, float, float]
) -> None:
    view = rotated_view(degrees)
    right: list[bool] = []
    for laser, led, truth in seen(name):
        found = laser_lines(laser, separate(led, view), view)
        near = np.linalg.norm(found.uv - truth.laser_uv[1:6], axis=1) < NEAR_PX
        right += near[1:][truth.laser_len_vis[2:6] >= VISIBLE_M].tolist()
    assert len(right) >= 30
    assert np.mean(right) >= 0.85


def test_seams_that_lie_one_finger_aside_do_not_move_the_line() -> None:
    laser, led, _ = seen("spread@indoor")[0]
    workspace = workspace_of(VIEW)
    runs, _ = lines(laser, workspace.first_row)
    points = np.stack([runs.column, runs.row], axis=-1, dtype=np.float64)
    finger = separate(led, VIEW).finger_of(points)
    palm_points = workspace.before_palm(points, VIEW.T_camera_palm)
    at = workspace.palm.beyond_m(palm_points), workspace.palm.place(palm_points)
    whose = finger_labels(finger, runs, *at, flexed=False)
    assert np.unique(whose[whose > 0]).tolist() == [1, 2, 3, 4]
    aside = np.where(finger > 0, finger + 1, finger)
    aside[finger == 4] = NONE
    assert (aside != whose)[whose > 0].mean() > 0.9
    kept = (whose > 0) & (finger != 4)
    assert (finger_labels(aside, runs, *at, flexed=False) == whose)[kept].mean() > 0.9


def test_lines_of_a_palm_that_deviates_and_holds_something_are_counted_from_the_outside() -> None:
    """What is held hides the webs, so that nobody sees how the palm lies."""
    both = Both.of("grasp", 7, rigs=("desk-back3", "wrist-back3"))
    name = both.wrist.rig.cameras[0]
    view = WristView.of(both.wrist.rig, both.wrist.cameras[name], both.wrist.hand.profile)
    device = WristRenderer(both.wrist_scene, name, 2)
    for t in (4.9, 5.1, 17.0):
        laser, led, truth = seen_at(both.wrist_scene, device, t)
        fingers = separate(led, view)
        assert abs(np.degrees(truth.wrist_angles_rad[1])) > 5.0
        assert fingers.palm_pose.straight
        found = laser_lines(laser, fingers, view).uv[1:]
        assert (np.linalg.norm(found - truth.laser_uv[2:6], axis=1) < NEAR_PX).all()
