"""Tests of the last step: a finger left off its cap by more than noise is brought onto it, no other is touched."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from master.ik.fingers import FingerRefiner
from master.ik.hand import HandSolution, HandSolver
from tests.hand_helpers import FACING, LEFT, MARKERS, RIGHT, natural_angles, palm, small_cov, within

REFINE = FingerRefiner(RIGHT, MARKERS)
seeds = st.integers(0, 2**32 - 1)


def solved(angles: Float) -> tuple[HandSolution, Float]:
    """A solution with exactly these angles, and its own markers."""
    joints = RIGHT.forward(palm(), angles)
    points = RIGHT.marker_points(joints, MARKERS)
    sure = np.zeros((26, 3, 3)), np.zeros((5, 3, 3)), np.zeros((5, 3, 3))
    told = np.eye(22), np.zeros((26, 3, 22))
    return HandSolution(palm(), angles, joints, *sure, np.zeros(6), 0.0, 1, 1.0, *told), points


@given(seeds)
def test_an_explained_finger_is_left_as_it_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hand, points = solved(natural_angles(rng))
    out = REFINE(hand, points + rng.normal(0.0, 3e-4, (6, 3)), small_cov())
    np.testing.assert_array_equal(out.angles_rad, hand.angles_rad)
    np.testing.assert_array_equal(out.T_rig_palm, hand.T_rig_palm)


@given(seeds, st.integers(1, 4))
@settings(max_examples=40)
def test_a_finger_off_its_cap_is_brought_onto_it_and_only_it(seed: int, finger: int) -> None:
    rng = np.random.default_rng(seed)
    truth = natural_angles(rng)
    other = truth.copy()
    other[finger, 1:3] += np.radians([12.0, 20.0])
    other[finger, 3] = other[finger, 2] * 2 / 3
    other = np.clip(other, RIGHT.limits_rad[..., 0], RIGHT.limits_rad[..., 1])
    hand, _ = solved(other)
    _, points = solved(truth)
    out = REFINE(hand, points, small_cov())
    rest = np.delete(np.arange(5), finger)
    np.testing.assert_array_equal(out.angles_rad[rest], other[rest])
    assert out.residual_m[finger] < 2e-4
    assert (
        out.residual_m[finger]
        < np.linalg.norm(RIGHT.marker_points(hand.joints, MARKERS) - points, axis=1)[finger]
    )
    assert within(RIGHT, out.angles_rad)
    np.testing.assert_allclose(out.joints.position_m, RIGHT.forward(palm(), out.angles_rad).position_m)


@given(seeds, st.floats(0.0, 1.0))
@settings(max_examples=40)
def test_a_cap_out_of_reach_breaks_no_limit(seed: int, far_m: float) -> None:
    rng = np.random.default_rng(seed)
    hand, points = solved(natural_angles(rng))
    out = REFINE(hand, points + rng.normal(0.0, far_m, (6, 3)), small_cov())
    # what is out of reach keeps the fit, bit for bit; what is not is reached
    moved = (out.angles_rad != hand.angles_rad).any(axis=1)
    assert (out.residual_m[:5][moved] < 2e-4).all()
    assert within(RIGHT, out.angles_rad)
    assert np.isfinite(out.joints.position_m).all()


def test_what_is_not_seen_is_not_touched() -> None:
    hand, _ = solved(natural_angles(np.random.default_rng(0)))
    _, points = solved(natural_angles(np.random.default_rng(1)))
    points[1] = np.nan
    cov = small_cov()
    cov[2] = np.nan
    out = REFINE(hand, points, cov)
    np.testing.assert_array_equal(out.angles_rad[[1, 2]], hand.angles_rad[[1, 2]])
    assert (out.angles_rad[[3, 4]] != hand.angles_rad[[3, 4]]).any(axis=1).all()
    assert np.isnan(out.residual_m[1])


def test_a_hand_with_a_back_marker_only_has_nothing_to_refine() -> None:
    hand, points = solved(natural_angles(np.random.default_rng(0)))
    out = FingerRefiner(RIGHT, ("back",))(hand, points[5:] + 0.05, small_cov(count=1))
    np.testing.assert_array_equal(out.angles_rad, hand.angles_rad)


def test_a_left_hand_is_refined_as_well() -> None:
    angles = natural_angles(np.random.default_rng(3))
    joints = LEFT.forward(palm(), angles)
    points = LEFT.marker_points(joints, MARKERS)
    found = HandSolver(LEFT, MARKERS).solve(points, small_cov(), None, 0.0, None, FACING)
    assert found is not None
    wrong = angles.copy()
    wrong[3, 1] += np.radians(20.0)
    start = replace(found, T_rig_palm=palm(), angles_rad=wrong, joints=LEFT.forward(palm(), wrong))
    out = FingerRefiner(LEFT, MARKERS)(start, points, small_cov())
    assert out.residual_m[3] < 2e-4
