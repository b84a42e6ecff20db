"""The steps of a mounting: pulls are the slopes of the cost by all unknowns, at a place that is not the truth."""

from dataclasses import replace

import numpy as np
import pytest

from common.arrays import Float
from common.geometry.transforms import quaternion_to_matrix, rotation_vector_to_matrix
from common.hand.wrist import forearm_palm
from master.calibrate.extrinsics.extrinsics import _cycles
from master.calibrate.extrinsics.problem import Hands, Problem, bends_by_rotation, wrist_rotation_angles
from master.calibrate.extrinsics.tracks import HandTrack, ImuTrack, LinesOfSight
from master.calibrate.extrinsics.unknown import UNKNOWN, Unknown, prior_sigma
from master.rig.setup import WristSetup
from tests.master.calibrate.extrinsics.moved import CAMERA_LATE_NS, IMU_LATE_NS, ZERO_NS, moved

EYE = np.eye(3)


def problem() -> tuple[Problem, Unknown, Hands]:
    """Twelve instants by tips alone (the laser's line jumps where a finger hides it), somewhat away from the truth."""
    seen, rng = moved(), np.random.default_rng(4)
    setup = WristSetup.of(seen.both.wrist.rig, seen.both.wrist.cameras["wrist"], seen.both.markers.hand)
    lines_of_sight, zero_ns = LinesOfSight(setup), seen.cycles[0].t_ns
    imu = seen.both.wrist.rig.imu
    assert imu is not None
    assert imu.q_palm_imu is not None
    R = quaternion_to_matrix(np.array(imu.q_palm_imu))
    chosen = _cycles(setup, lines_of_sight, seen.both.wrist.cameras["wrist"], seen.cycles[20:80:5], zero_ns)
    chosen = replace(chosen, laser_m=np.full_like(chosen.laser_m, np.nan))
    track = ImuTrack(seen.samples, zero_ns)
    middle = seen.samples[len(seen.samples) // 2]
    then = seen.both.scene.truth(1e-9 * (middle.t_ns + IMU_LATE_NS - ZERO_NS))
    forearm = then.T_rig_palm[:3, :3] @ forearm_palm(then.wrist_angles_rad).T
    first = Unknown(
        setup.T_camera_palm[:3, :3] @ R,
        setup.T_camera_palm[:3, 3] + 1e-3,
        R,
        forearm @ R @ quaternion_to_matrix(middle.orientation_wxyz).T,
        np.zeros(12),
        1e-9 * CAMERA_LATE_NS,
        1e-9 * IMU_LATE_NS,
        np.zeros(4),
        np.zeros(4),
    )
    hand = HandTrack.of(seen.poses, seen.both.markers.hand, zero_ns)
    out = Problem(
        lines_of_sight, seen.both.markers.hand, seen.both.markers.markers, hand, track, chosen, 3000.0, first
    )
    hands = out.guessed(first)
    out.update_observations(first, hands)
    return out, first.retracted(1e-3 * rng.normal(size=UNKNOWN)), hands


def cost_of(at: Problem, unknown: Unknown, hands: Hands) -> float:
    return at.equations((unknown, hands)).cost


def derivatives(at: Problem, unknown: Unknown, hands: Hands, steps: Float) -> Float:
    """Of half of the cost by each of these steps (N, UNKNOWN), by central differences."""
    out = [
        cost_of(at, unknown.retracted(step), hands) - cost_of(at, unknown.retracted(-step), hands)
        for step in steps
    ]
    return 0.25 * np.array(out)


def test_the_gradient_of_what_all_epochs_share_is_the_derivative_of_the_cost() -> None:
    at, unknown, hands = problem()
    pull, little = at.equations((unknown, hands)).gradient, 1e-4 * prior_sigma()
    derivative = derivatives(at, unknown, hands, np.diag(little)) / little
    scale = np.abs(pull * prior_sigma())
    most = float(scale.max())  # small pulls are differences of large ones
    np.testing.assert_allclose(derivative * prior_sigma(), pull * prior_sigma(), rtol=0.01, atol=2e-3 * most)
    assert np.count_nonzero(scale > 0.1) > UNKNOWN // 2  # most unknowns are told something


def test_the_gradient_of_each_hand_is_the_derivative_of_the_cost() -> None:
    at, unknown, hands = problem()
    pull, little = at.equations((unknown, hands)).own_gradient, 1e-4
    for k in range(6):
        step = np.zeros_like(pull)
        step[:, k] = little
        costs = [cost_of(at, unknown, hands.retracted(way * step)) for way in (1.0, -1.0)]
        assert 0.25 * (costs[0] - costs[1]) / little == pytest.approx(pull[:, k].sum(), rel=0.01)


def test_a_step_of_gauss_and_newton_lessens_the_cost() -> None:
    at, unknown, hands = problem()
    solved, after, taken = at.solved(unknown, hands, 3)
    assert taken == 3
    assert cost_of(at, solved, after) < 0.5 * cost_of(at, unknown, hands)


def test_a_turn_about_the_axes_of_the_forearm_bends_the_wrist() -> None:
    bent, little = rotation_vector_to_matrix(np.array([[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])), 1e-4
    by = bends_by_rotation(bent)
    for k in range(3):
        there, back = (
            wrist_rotation_angles(rotation_vector_to_matrix(way * little * EYE[k]) @ bent)
            for way in (1.0, -1.0)
        )
        np.testing.assert_allclose(by[..., k], (there - back) / (2.0 * little), atol=1e-4)
    np.testing.assert_allclose(
        np.abs(np.linalg.det(by[1])), 1.0, atol=1e-4
    )  # of three kinds, each by one axis
