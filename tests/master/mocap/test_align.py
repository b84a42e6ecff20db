"""A motion capture in another frame, on another clock, at another rate is brought to ours, or refused."""

import numpy as np
import pytest

from common.arrays import Float
from common.errors import FitError
from common.geometry.transforms import matrix_to_rotation_vector, rigid
from master.mocap.align import align
from master.mocap.bvh_file import Track
from tests.master.mocap.moved import ROTATION, SHIFT, hand_at, ns, track_of

OURS_S = np.arange(900) / 60.0
THEIRS_S = np.arange(2000) / 120.0 - 0.7
LATER_S = 17.2345  # how much later their clock says everything


def noisy(joints_m: Float, sigma_m: float, seed: int = 1) -> Float:
    return joints_m + np.random.default_rng(seed).normal(0.0, sigma_m, joints_m.shape)


def theirs(joints_m: Float | None = None) -> Track:
    exact = hand_at(THEIRS_S).position_m if joints_m is None else joints_m
    return Track(ns(THEIRS_S + LATER_S), exact @ ROTATION.T + SHIFT)


@pytest.mark.parametrize("seed", [1, 2])
def test_frame_and_clock_are_found_as_well_as_is_said(seed: int) -> None:
    found = align(track_of(noisy(hand_at(OURS_S).position_m, 3e-3, seed), OURS_S), theirs())
    left = found.T_rig_file @ rigid(ROTATION, SHIFT)
    off_s = 1e-9 * found.offset_ns + LATER_S
    rotation_deg = np.degrees(np.linalg.norm(matrix_to_rotation_vector(left[:3, :3])))
    middle = np.array([0.0, 0.0, 0.6])
    shift_m = np.linalg.norm(left[:3, :3] @ middle + left[:3, 3] - middle)
    assert abs(off_s) < min(4.0 * found.offset_sigma_s, 1e-3)
    assert rotation_deg < min(4.0 * found.rotation_sigma_deg, 0.1)
    assert shift_m < 3e-4
    assert found.correlation > 0.8
    assert not found.mirrored
    assert 3e-3 < found.residual_m < 6e-3


def test_points_that_are_sometimes_wrong_do_not_turn_it() -> None:
    joints = noisy(hand_at(OURS_S).position_m, 1e-3)
    joints[::3, 10] += [0.2, 0.0, 0.0]  # a marker that was swapped
    joints[200:300, 3:9] = np.nan
    found = align(track_of(joints, OURS_S), theirs())
    left = found.T_rig_file @ rigid(ROTATION, SHIFT)
    assert np.degrees(np.linalg.norm(matrix_to_rotation_vector(left[:3, :3]))) < 0.1
    assert abs(1e-9 * found.offset_ns + LATER_S) < 1e-3


def test_left_handed_axes_are_turned_over() -> None:
    flipped = hand_at(THEIRS_S).position_m * [1.0, 1.0, -1.0]
    found = align(track_of(hand_at(OURS_S).position_m, OURS_S), theirs(flipped))
    assert found.mirrored
    moved = found.moved(theirs(flipped))
    np.testing.assert_allclose(moved.position_m, hand_at(THEIRS_S).position_m, atol=2e-4)


def test_a_movement_that_repeats_is_said() -> None:
    def again(t_s: Float) -> Float:
        return hand_at(t_s % 2.0).position_m

    found = align(track_of(again(OURS_S), OURS_S), Track(ns(THEIRS_S), again(THEIRS_S + 0.7)))
    assert abs(found.alternative_s) % 2.0 == pytest.approx(0.0, abs=0.05)
    assert np.isnan(align(track_of(hand_at(OURS_S).position_m, OURS_S), theirs()).alternative_s)


def test_another_movement_is_refused() -> None:
    other = hand_at(THEIRS_S * 1.7 + 300.0).position_m
    with pytest.raises(FitError, match=r"agree nowhere .* --aligned"):
        align(track_of(hand_at(OURS_S).position_m, OURS_S), theirs(other))


def test_points_on_a_line_determine_no_rotation() -> None:
    one = hand_at(OURS_S).position_m[:, :1] * [1.0, 0.0, 0.0]
    other = hand_at(THEIRS_S).position_m[:, :1] * [1.0, 0.0, 0.0]
    with pytest.raises(FitError, match="on a line"):
        align(track_of(one, OURS_S), theirs(other))


def test_what_is_not_seen_is_refused() -> None:
    nothing = np.full((900, 26, 3), np.nan)
    with pytest.raises(FitError, match="no point is seen"):
        align(track_of(nothing, OURS_S), theirs())


def test_nothing_is_made_up_between_frames_that_are_far_apart() -> None:
    t_s = np.array([0.0, 0.01, 0.02, 0.2, 0.21])
    track = Track(ns(t_s), np.arange(5.0)[:, None, None] * np.ones((1, 1, 3)))
    track.position_m[1, 0, 0] = np.nan
    found = track.at(ns(np.array([-0.001, 0.0, 0.005, 0.015, 0.02, 0.1, 0.205, 0.21, 0.3])))
    np.testing.assert_allclose(found[:, 0, 1], [np.nan, 0.0, 0.5, 1.5, 2.0, np.nan, 3.5, 4.0, np.nan])
    np.testing.assert_allclose(found[:, 0, 0], [np.nan, 0.0, np.nan, np.nan, 2.0, np.nan, 3.5, 4.0, np.nan])
