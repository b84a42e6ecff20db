from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.errors import RecordingError
from common.hand.model import TIPS, WRIST
from master.recording.export.motion import (
    FRAMES_OF_POSE,
    FREE_FRAMES,
    ORDER,
    PARENT,
    Motion,
    complete,
    local,
    resample,
    slerp,
    world,
)
from tests.master.recording.export.made import BEGIN_NS, REST, STEP_NS, poses_of, positions, stacked


def bones_m(motion: Motion) -> Float:
    """Lengths of the bones (T, 25) [m]."""
    return np.stack(
        [
            np.linalg.norm(motion.position_m[:, a] - motion.position_m[:, b], axis=1)
            for a, b in PARENT.items()
        ],
        axis=1,
    )


def test_the_tree_has_every_joint_once_and_parents_before_children() -> None:
    assert sorted(ORDER) == list(range(26))
    assert all(ORDER.index(parent) < ORDER.index(joint) for joint, parent in PARENT.items())


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_local_and_world_undo_each_other(seed: int) -> None:
    motion = complete(stacked(poses_of(seed, 4, loose_m=0.003)), REST)
    again = world(local(motion))
    np.testing.assert_allclose(again.position_m, motion.position_m, atol=1e-12)
    same = np.abs(np.vecdot(again.orientation_wxyz, motion.orientation_wxyz))
    np.testing.assert_allclose(same, 1.0, atol=1e-12)


def test_resampled_at_its_own_rate_a_motion_is_what_it_was_and_bones_keep_their_length_between() -> None:
    poses = poses_of(3, 9)
    motion = complete(stacked(poses), REST)
    assert motion.rate_hz == 60
    own = resample(motion, 1e9 / STEP_NS)
    np.testing.assert_allclose(own.position_m, positions(poses), atol=1e-7)  # frame times are whole ns
    finer = resample(motion, 500.0)
    assert len(finer) == 67
    np.testing.assert_allclose(bones_m(finer), np.broadcast_to(bones_m(motion)[:1], (67, 25)), atol=1e-9)
    assert not finer.held.any()


def test_what_is_missing_stays_as_it_was_to_its_parent_and_is_counted() -> None:
    valid = np.ones((6, 26), np.bool_)
    valid[2:4, TIPS] = False  # tips are lost for two poses
    valid[5] = False  # and at the end all
    poses = poses_of(5, 6, valid=valid)
    motion = complete(stacked(poses), REST)
    seen = np.where(valid[..., None], positions(poses), motion.position_m)
    np.testing.assert_array_equal(motion.position_m, seen)
    assert motion.held_frames == 3
    own = local(motion).position_m[:, TIPS]
    np.testing.assert_allclose(own[2:4], np.broadcast_to(own[1], (2, 5, 3)), atol=1e-12)
    np.testing.assert_allclose(motion.position_m[5], motion.position_m[4], atol=1e-12)


def test_a_joint_that_was_never_seen_is_at_rest_and_one_seen_later_begins_as_it_then_is() -> None:
    valid = np.ones((4, 26), np.bool_)
    valid[:, 10], valid[:2, 25] = False, False
    motion = complete(stacked(poses_of(6, 4, valid=valid)), REST)
    np.testing.assert_allclose(bones_m(motion), np.broadcast_to(bones_m(motion)[2:3], (4, 25)), atol=1e-9)
    length = np.linalg.norm(REST.position_m[10] - REST.position_m[9])
    np.testing.assert_allclose(
        np.linalg.norm(motion.position_m[:, 10] - motion.position_m[:, 9], axis=1), length, atol=1e-9
    )
    assert motion.held[:, 10].all()
    assert motion.held[:, 25].tolist() == [True, True, False, False]


def test_an_orientation_that_is_nan_is_not_observed() -> None:
    poses = stacked(poses_of(7, 3))
    broken = poses[1].orientation_wxyz.copy()
    broken[0, WRIST] = np.nan
    motion = complete([poses[0], replace(poses[1], orientation_wxyz=broken)], REST)
    assert np.isfinite(motion.orientation_wxyz).all()
    assert motion.held[:, WRIST].tolist() == [False, True, False]


def test_over_a_gap_the_hand_stands_still() -> None:
    (one, two) = stacked(poses_of(8, 2))
    two = replace(two, t_ns=two.t_ns + 1_000_000_000)
    motion = complete([one, two], REST)
    frames = resample(replace(motion, gap_ns=250_000_000), 10.0)
    assert len(frames) == 11
    np.testing.assert_allclose(frames.position_m[1:], np.broadcast_to(one.position_m, (10, 26, 3)), atol=1e-9)
    assert frames.held.all(axis=1).tolist() == [False] + [True] * 10


def late(seconds: int, poses: int = 30) -> Motion:
    """Poses of which the last comes so much later."""
    *first, last = stacked(poses_of(8, poses))
    return complete([*first, replace(last, t_ns=last.t_ns + seconds * 1_000_000_000)], REST)


def test_a_late_pose_costs_no_more_frames_than_its_poses_and_a_break_of_ten_minutes() -> None:
    most = FREE_FRAMES + 30 * FRAMES_OF_POSE
    with pytest.raises(
        RecordingError, match=rf"\d+ frames at 1000 Hz, at most {most} of 30 poses: .*--until"
    ):
        resample(late(99), 1000.0)
    assert FREE_FRAMES < len(resample(late(600), 60.0)) <= most


def test_poses_out_of_order_are_put_in_order_and_of_two_at_once_the_later_stays() -> None:
    poses = poses_of(9, 4)
    mixed = [poses[2], poses[0], poses[3], poses[1]]
    again = poses_of(10, 4)[1]
    motion = complete(stacked([*mixed, again]), REST)
    assert motion.t_ns.tolist() == [BEGIN_NS + i * STEP_NS for i in range(4)]
    np.testing.assert_array_equal(motion.position_m[[0, 1, 3]], positions([poses[0], again, poses[3]]))


def test_nothing_valid_makes_no_motion() -> None:
    with pytest.raises(RecordingError, match="none of its 2 poses is valid"):
        complete(stacked(poses_of(1, 2, valid=np.zeros((2, 26), np.bool_))), REST)
    with pytest.raises(RecordingError, match="none of its 0 poses"):
        complete([], REST)


def test_slerp_goes_the_shorter_way_at_even_speed() -> None:
    # A quarter turn about z, by hand: half of it is cos, sin of 22.5 degrees.
    quarter = np.array([np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)])
    half = np.array([np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8)])
    one = np.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(slerp(one, quarter, np.array(0.5)), half, atol=1e-12)
    np.testing.assert_allclose(slerp(one, -quarter, np.array(0.5)), half, atol=1e-12)
    np.testing.assert_allclose(slerp(one, one, np.array(0.3)), one, atol=1e-12)
