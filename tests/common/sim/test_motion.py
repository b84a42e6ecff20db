"""The simulated hand moves as asked: smooth, within its limits, the same every time."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import HandProfile, load
from common.errors import RecordingError
from common.geometry.transforms import quaternion_to_matrix, rigid
from common.hand.model import CHAINS, HandModel
from common.sim.motion import PERIOD_S, POSES, ScriptedMotion, smooth_step
from common.sim.people import joint_angles, load_leap, palm_rotation

ROOT = Path(__file__).resolve().parents[3]
MODEL = HandModel.of(load(ROOT / "calib_json/hands/default-right.json", HandProfile))
CENTRE = np.array([0.04, 0.0, 0.47])
MOTION = ScriptedMotion(MODEL, CENTRE, 7)
GOLDEN_PLACE_M = (0.040664227359, 0.093490401196, 0.487798220165)
GOLDEN_PIP_RAD = (0.600277989055, 0.137754318454, 1.565711617873, 1.642142338313, 1.617035995564)
GRID = np.arange(0.0, PERIOD_S, 1 / 200)


def states(motion: ScriptedMotion, times: Float) -> tuple[Float, Float]:
    found = [motion.at(float(t)) for t in times]
    return np.array([s.T_rig_palm for s in found]), np.array([s.angles_rad for s in found])


@cache
def grid() -> tuple[Float, Float]:
    """Palm poses and angles of the whole period, 200 a second."""
    return states(MOTION, GRID)


def test_angles_stay_within_the_limits_and_the_clip_never_works() -> None:
    _, angles = grid()
    assert MODEL.within_limits(angles).all()
    at_limit = (angles == MODEL.limits_rad[..., 0]) | (angles == MODEL.limits_rad[..., 1])
    at_limit[:, 2, 0] = False  # preset K allows the middle finger no abduction
    assert not at_limit.any()


def test_motion_is_smooth_also_over_the_seam_of_its_period() -> None:
    poses, angles = grid()
    tail = [MOTION.at(PERIOD_S + t) for t in (-1e-4, 0.0, 1e-4)]
    np.testing.assert_allclose(tail[1].angles_rad, MOTION.at(0.0).angles_rad, atol=1e-9)
    step = np.diff(np.array([s.angles_rad for s in tail]), axis=0)
    np.testing.assert_allclose(step[0], step[1], atol=2e-6)
    # A jump of the velocity would show as an acceleration that grows with the rate of sampling.
    acceleration = np.abs(np.diff(poses[:, :3, 3], n=2, axis=0)).max() * 200**2
    assert acceleration < 40.0
    assert np.abs(np.diff(angles, n=2, axis=0)).max() * 200**2 < 250.0


def test_travel_reaches_one_metre_per_second_and_not_more() -> None:
    speed = np.linalg.norm(np.diff(grid()[0][:, :3, 3], axis=0), axis=1) * 200
    for half in (0, 1):
        peak = speed[half * 6000 : half * 6000 + 5999].max()
        assert 0.9 <= peak <= 1.0


def test_palm_turns_twenty_degrees_about_every_axis_in_each_half() -> None:
    poses, _ = grid()
    still = poses[0, :3, :3]
    for half in (0, 30):
        acts = [act for act in MOTION.acts if act.name == "turns" and half <= act.start_s < half + 30]
        rows = (acts[0].start_s < GRID) & (acts[0].stop_s > GRID)
        rotation = poses[rows, :3, :3] @ still.T
        vector = np.stack(
            [
                rotation[:, 2, 1] - rotation[:, 1, 2],
                rotation[:, 0, 2] - rotation[:, 2, 0],
                rotation[:, 1, 0] - rotation[:, 0, 1],
            ],
            axis=1,
        )
        degrees = np.degrees(np.arcsin(np.clip(vector / 2.0, -1.0, 1.0)))
        for axis in range(3):
            assert 16.0 < degrees[:, axis].max() < 26.0
            assert -26.0 < degrees[:, axis].min() < -16.0


def test_each_half_shows_every_act_and_the_six_poses() -> None:
    names = [[act.name for act in MOTION.acts if lo <= act.start_s < lo + 30.0] for lo in (0.0, 30.0)]
    assert names[0] == names[1]
    assert {f"pose_{pose}" for pose in POSES} < set(names[0])
    assert {"open_close", "one_by_one", "wave", "travel", "turns"} < set(names[0])
    for act in MOTION.acts:
        assert 0.0 < act.start_s < act.stop_s < PERIOD_S


@pytest.mark.parametrize(
    ("pose", "straight", "bent"),
    [("counting_two", (1, 2), (3, 4)), ("pointing", (1,), (2, 3, 4)), ("small_grasp", (), (1, 2, 3, 4))],
)
def test_poses_bend_the_right_fingers(pose: str, straight: tuple[int, ...], bent: tuple[int, ...]) -> None:
    act = next(act for act in MOTION.acts if act.name == f"pose_{pose}")
    pip = np.degrees(MOTION.at((act.start_s + act.stop_s) / 2).angles_rad[:, 2])
    assert all(pip[f] < 15.0 for f in straight)
    assert all(pip[f] > 75.0 for f in bent)


def test_dip_follows_the_coupling_only_nearly() -> None:
    _, angles = grid()
    pip, dip = angles[:, 1:, 2], angles[:, 1:, 3]
    ratio = dip / np.maximum(pip, 1e-3)
    assert abs(float(np.median(ratio)) - 2 / 3) < 0.03
    assert 0.02 < float(ratio.std()) < 0.1


def test_same_seed_same_motion_everywhere_and_another_seed_another() -> None:
    again = ScriptedMotion(MODEL, CENTRE, 7)
    other = ScriptedMotion(MODEL, CENTRE, 8)
    assert np.array_equal(again.at(12.34).angles_rad, MOTION.at(12.34).angles_rad)
    assert not np.allclose(other.at(12.34).angles_rad, MOTION.at(12.34).angles_rad, atol=1e-4)
    # Own golden values: another standard scene is a decision, and every machine must play the same one.
    state = MOTION.at(12.34)
    np.testing.assert_allclose(state.T_rig_palm[:3, 3], GOLDEN_PLACE_M, atol=1e-9)
    np.testing.assert_allclose(state.angles_rad[:, 2], GOLDEN_PIP_RAD, atol=1e-9)


@given(st.floats(-5.0, 0.0))
def test_before_the_start_holds_the_first_pose(t: float) -> None:
    assert np.array_equal(MOTION.at(t).angles_rad, MOTION.at(0.0).angles_rad)


@given(st.floats(-2.0, 3.0))
def test_smooth_step_is_monotone_and_bounded(x: float) -> None:
    assert 0.0 <= smooth_step(x) <= smooth_step(x + 0.01) <= 1.0


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_joint_angles_invert_forward_kinematics(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, high = MODEL.limits_rad[..., 0], MODEL.limits_rad[..., 1]
    angles = low + (high - low) * rng.uniform(0.1, 0.9, (5, 4))
    angles[:, 1] = np.minimum(
        angles[:, 1], np.radians(45.0)
    )  # the azimuth of a finger that points down is damped
    angles[:, 2:] = np.abs(angles[:, 2:])  # the angle between two bones has no sign
    quaternion = rng.normal(size=4)
    rotation = quaternion_to_matrix(quaternion)
    joints = MODEL.forward(rigid(rotation, rng.normal(size=3)), angles)
    slots = np.full((1, 21, 3), np.nan)
    slots[0, 1:] = joints.position_m[CHAINS.ravel()]
    found = joint_angles(MODEL, slots, rotation[None])[0]
    np.testing.assert_allclose(np.degrees(found), np.degrees(angles), atol=1e-3)  # the file is rounded


def test_palm_rotation_is_a_rotation_with_the_back_up() -> None:
    normal, direction = np.array([[0.0, 0.3, 1.0]]), np.array([[0.1, -1.0, 0.2]])
    R = palm_rotation(normal, direction)[0]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    assert R[:, 1] @ normal[0] < 0 < R[:, 2] @ direction[0]


def test_missing_recording_says_where_to_look(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="PHALANX_DATASETS"):
        load_leap(tmp_path / "grab.npz", MODEL, CENTRE)
    (tmp_path / "grab.npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(RecordingError, match="not a Leap recording"):
        load_leap(tmp_path / "grab.npz", MODEL, CENTRE)
    np.savez(tmp_path / "few.npz", t=np.arange(3.0))
    with pytest.raises(RecordingError, match="hand0_joints"):
        load_leap(tmp_path / "few.npz", MODEL, CENTRE)


@pytest.mark.parametrize("name", ["grab", "three-claps"])
def test_real_motions_play_smoothly_within_the_limits(name: str, datasets: Path) -> None:
    motion = load_leap(datasets / "leapjs" / f"{name}.npz", MODEL, CENTRE)
    times = np.arange(0.0, motion.period_s + 0.5, 1 / 200)
    found = [motion.at(float(t)) for t in times]
    angles = np.array([s.angles_rad for s in found])
    assert MODEL.within_limits(angles).all()
    assert np.abs(np.diff(angles, axis=0)).max() < np.radians(8.0)  # 1600 deg/s
    middle = np.array([0.0, 0.0, 0.5 * MODEL.rest_position_m[:, 2].max(), 1.0])
    place = np.array([s.T_rig_palm @ middle for s in found])[:, :3] - CENTRE
    assert np.abs(place).max() < 0.14
    if name == "grab":
        assert np.degrees(angles[:, 1:, 2]).max() > 70.0
