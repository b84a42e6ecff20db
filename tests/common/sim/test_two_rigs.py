"""Motions before both kinds of rig: legal, smooth, closed, one and the same for both; the IMU feels their forearm."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import HandModel
from common.hand.wrist import forearm_palm
from common.imu.fusion import OrientationFilter
from common.sim.motion import HandMotion, HandState
from common.sim.scene import Scene, view_centre
from common.sim.scenes import scene_by_name
from common.sim.sensors import SimulatedImu
from common.sim.two_rigs import TWO_RIG_SCENES, two_rig_motion
from common.sim.wrist.scene import WristScene

ROOT = Path(__file__).resolve().parents[3]
DESK = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
WRIST = load(ROOT / "calib_json/rigs/wrist.json", RigCalibration)
CAMERAS = {
    name: load(ROOT / f"calib_json/cameras/{name}.json", CameraCalibration)
    for name in (*DESK.cameras, *WRIST.cameras)
}
HAND = load(ROOT / "calib_json/hands/default-right.json", HandProfile)
MODEL = HandModel.of(HAND)
CENTRE = view_centre(DESK)
MOST_WRIST_DEG = {"grasp": (10.0, 8.0), "both-moves": (25.0, 12.0), "gestures": (5.0, 3.0)}
RATE_HZ = 100


@cache
def motion_of(name: str, seed: int = 7) -> HandMotion:
    motion = two_rig_motion(name, MODEL, CENTRE, seed)
    assert motion is not None
    return motion


@cache
def states(name: str) -> list[HandState]:
    motion = motion_of(name)
    return [motion.at(k / RATE_HZ) for k in range(round(motion.period_s * RATE_HZ))]


@cache
def desk_scene(name: str) -> Scene:
    return scene_by_name(name, DESK, CAMERAS, HAND, 7)


@cache
def wrist_scene(name: str) -> WristScene:
    return WristScene.by_name(name, WRIST, CAMERAS, HAND, 7)


@pytest.mark.parametrize("name", TWO_RIG_SCENES)
def test_they_are_legal_smooth_and_closed_and_the_wrist_bends(name: str) -> None:
    found = states(name)
    angles, wrist_angles = (
        np.array([s.angles_rad for s in found]),
        np.array([s.wrist_angles_rad for s in found]),
    )
    place = np.array([s.T_rig_palm for s in found])
    assert MODEL.within_limits(angles).all()
    at_limit = (angles == MODEL.limits_rad[..., 0]) | (angles == MODEL.limits_rad[..., 1])
    at_limit[:, 2, 0] = False  # preset K allows the middle finger no abduction
    at_limit[:, 0] &= name != "gestures"  # whose thumb lies on keys as far as it reaches
    assert not at_limit.any()  # the clip, which is not smooth, never works
    for values, most in ((angles, 200.0), (wrist_angles, 60.0), (place, 200.0)):
        around = np.concatenate([values[-1:], values, values[:2]])  # over the seam, too
        # Of a jump in position or velocity the second difference would grow with the rate.
        assert np.abs(np.diff(around, n=2, axis=0)).max() * RATE_HZ**2 < most
    most = np.radians(MOST_WRIST_DEG.get(name, (8.0, 5.0)))
    assert (np.abs(wrist_angles).max(axis=0) <= most + 1e-9).all()
    assert (np.ptp(wrist_angles, axis=0) > most * 0.8).all()


@pytest.mark.parametrize("name", TWO_RIG_SCENES)
def test_both_kinds_of_rig_see_one_motion_of_a_seed(name: str) -> None:
    desk, wrist = desk_scene(name), wrist_scene(name)
    apart = desk.truth(0.0).T_rig_palm[:3, 3] - wrist.motion.at(0.0).T_rig_palm[:3, 3]
    for t in (0.4, 2.9, 5.7, 8.3):
        marked, device = desk.truth(t), wrist.motion.at(t)
        np.testing.assert_array_equal(marked.angles_rad, device.angles_rad)
        np.testing.assert_array_equal(marked.wrist_angles_rad, device.wrist_angles_rad)
        np.testing.assert_array_equal(marked.T_rig_palm[:3, :3], device.T_rig_palm[:3, :3])
        np.testing.assert_allclose(marked.T_rig_palm[:3, 3] - device.T_rig_palm[:3, 3], apart, atol=1e-12)
        assert len(marked.things) == len(device.things) == (name == "grasp")
        for one, other in zip(marked.things, device.things, strict=True):
            moved = one.T_rig_object[:3, 3] - other.T_rig_object[:3, 3]
            np.testing.assert_allclose(moved, apart, atol=1e-12)
    assert (motion_of(name, 8).at(1.0).angles_rad != motion_of(name).at(1.0).angles_rad).any()


@pytest.mark.parametrize("name", TWO_RIG_SCENES)
def test_the_hand_stays_in_the_picture(name: str) -> None:
    scene = desk_scene(name)
    for t in np.arange(0.0, scene.period_s, scene.period_s / 150):
        truth = scene.truth(float(t))
        assert 0.36 < truth.markers_m[:, 2].min()
        for camera in DESK.cameras:
            uv = scene.optics[camera].project(truth.markers_m)
            assert ((uv > 8.0) & (uv < np.array([632.0, 472.0]))).all(), (t, camera)


def test_travel_reaches_one_metre_per_second_and_moves_show_every_turn() -> None:
    travelled = np.array([s.T_rig_palm[:3, 3] for s in states("both-travel")])
    speed = np.linalg.norm(np.diff(travelled, axis=0), axis=1) * RATE_HZ
    assert 0.9 < speed.max() < 1.05
    moved = states("both-moves")
    angles = np.degrees([s.angles_rad for s in moved])
    assert (np.ptp(angles[:, 1:, 2], axis=0) > 45.0).all()
    rotated = np.array([s.T_rig_palm[:3, :3] for s in moved])
    rates = np.einsum("tji,tjk->tik", rotated[:-1], rotated[1:]) * RATE_HZ
    about = np.stack([rates[:, 2, 1], rates[:, 0, 2], rates[:, 1, 0]])  # palm axes, rad/s
    assert (np.abs(about).max(axis=1) > 0.5).all()


def test_an_unknown_name_is_none_of_them() -> None:
    assert two_rig_motion("standard", MODEL, CENTRE, 7) is None


def test_what_the_imu_of_a_wrist_device_says_is_the_forearms_turn() -> None:
    """Its filter's vertical, after ten seconds of bending, is that of the forearm; the palm's is elsewhere."""
    scene = wrist_scene("both-moves")
    imu = scene.rig.imu
    assert imu is not None
    assert imu.q_palm_imu is not None
    assert imu.q_rig_world is not None
    up = quaternion_to_matrix(np.array(imu.q_rig_world))[:, 2]
    forearm_imu = quaternion_to_matrix(np.array(imu.q_palm_imu))
    fusion = OrientationFilter(imu.rate_hz)
    off: list[tuple[float, float]] = []
    for sample in (fusion.push(one) for one in SimulatedImu.of(scene).around(2.0, 9.0)):
        t = sample.t_ns * 1e-9
        if t < 4.0:
            continue
        state, found = scene.motion.at(t), quaternion_to_matrix(sample.orientation_wxyz)[2]
        palm = state.T_rig_palm[:3, :3]
        ups = [R @ forearm_imu @ found for R in (palm @ forearm_palm(state.wrist_angles_rad).T, palm)]
        off.append((float(np.linalg.norm(ups[0] - up)), float(np.linalg.norm(ups[1] - up))))
    of_forearm, of_palm = np.degrees(np.sqrt((np.array(off) ** 2).mean(axis=0)))
    assert of_forearm < 4.0  # its zeros are those of the part
    assert of_palm > 3.0 * of_forearm
