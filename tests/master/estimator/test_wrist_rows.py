"""Rows of a wrist device and of its IMU: gradient and normal equations of each kind against finite differences."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.arrays import Float
from common.geometry.transforms import axis_rotation, matrix_to_rotation_vector, rotation_vector_to_matrix
from common.hand.wrist import forearm_palm
from master.estimator.sensors import HEADING, LED_SCALE, TILT, WRIST_ANGLES
from tests.hand_helpers import any_rotation
from tests.master.estimator.kernels import rotation_vector_jacobian_at
from tests.master.estimator.whole import Whole, silent
from tests.master.estimator.wrist_case import Seen, WristCase

seeds = st.integers(0, 2**32 - 1)
FLEXED = np.radians([-8.0, 4.0])


@pytest.fixture(scope="module")
def wrist_case(root: Path) -> WristCase:
    return WristCase.of(root)


def hand(wrist_case: WristCase, seed: int) -> tuple[Whole, Seen]:
    """One before the device, without priors, and what is seen of it."""
    whole = Whole(wrist_case.model, seed, wrist_case.device)
    silent(whole)
    whole.z[:5], whole.z[WRIST_ANGLES : WRIST_ANGLES + 2] = whole.rng.normal(0.0, 0.05, 5), FLEXED
    whole.z[LED_SCALE] = whole.rng.normal()
    angles = whole.parameters.angles(whole.x)
    return whole, wrist_case.looks(angles, FLEXED, whole.z[:5])


def spd(rng: np.random.Generator, n: int) -> Float:
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def laser(whole: Whole, seen: Seen, off: float) -> None:
    cycle_rows = whole.epoch_prior.cycle_rows
    cycle_rows.rows[0], cycle_rows.lit[:], cycle_rows.teaches[:] = 1.0, 1.0, 1.0
    cycle_rows.lack[:] = whole.rng.normal(0.0, 0.02, (5, 2))
    cycle_rows.laser[:] = seen.predicted_laser + cycle_rows.lack + off * whole.rng.normal(size=(5, 2))
    cycle_rows.laser_W[:] = [spd(whole.rng, 2) for _ in range(5)]


def tip(whole: Whole, seen: Seen, off: float) -> None:
    cycle_rows = whole.epoch_prior.cycle_rows
    cycle_rows.rows[0], cycle_rows.shown[:], cycle_rows.teaches[:] = 1.0, 1.0, 1.0
    cycle_rows.tip[:] = seen.tip + off * whole.rng.normal(size=(5, 2))
    cycle_rows.tip_W[:] = [spd(whole.rng, 2) for _ in range(5)]


def tip_depth(whole: Whole, seen: Seen, off: float) -> None:
    tip(whole, seen, off)
    cycle_rows = whole.epoch_prior.cycle_rows
    cycle_rows.depth[:] = np.log(seen.depth_m) + whole.z[LED_SCALE] + off * whole.rng.normal(size=5)
    cycle_rows.depth_w2[:] = whole.rng.uniform(1.0, 9.0, 5)


def orientation(whole: Whole, seen: Seen, off: float) -> None:
    """Of a forearm that is turned `off` from where it would put the palm; tilt and heading are as they were."""
    epoch_prior, rng = whole.epoch_prior, whole.rng
    palm = rotation_vector_to_matrix(off * rng.normal(size=3)) @ whole.T[:3, :3]
    epoch_prior.forearm[:3, :3] = palm @ forearm_palm(FLEXED).T
    epoch_prior.orientation_info[:], epoch_prior.oriented[0], epoch_prior.on_forearm[0] = (
        spd(rng, 3),
        1.0,
        1.0,
    )
    epoch_prior.axes[:] = any_rotation(rng)
    whole.z[TILT : HEADING + 1] = epoch_prior.z[TILT : HEADING + 1] = rng.normal(0.0, 0.2, 3)


def largest(whole: Whole, numeric: Float) -> Float:
    """The largest of turn, shift, angles, and extras, each with a unit of its own."""
    size = np.array([3, 3, whole.n, len(whole.z)])
    parts = np.split(np.abs(numeric).reshape(len(numeric), -1), np.cumsum(size)[:-1])
    return np.repeat([max(float(part.max()), 1e-3) for part in parts], size)


KINDS = [(laser, 0.35), (tip, 1e-5), (tip_depth, 1e-5), (orientation, 1e-5)]


@pytest.mark.parametrize(("kind", "share"), KINDS[1:])
def test_the_gradient_of_each_kind_of_row_is_the_derivative_of_its_cost(
    wrist_case: WristCase, kind: Callable[[Whole, Seen, float], None], share: float
) -> None:
    for seed in range(6):
        whole, seen = hand(wrist_case, seed)
        kind(whole, seen, 0.3)
        _, gradient, normal = whole.cost()
        numeric = whole.numeric_gradient()
        assert np.abs(numeric).max() > 0.01
        np.testing.assert_array_less(np.abs(gradient - numeric), share * largest(whole, numeric))
        np.testing.assert_allclose(normal, normal.T, atol=1e-9 * np.abs(normal).max())
        assert np.linalg.eigvalsh(normal).min() > -1e-9 * np.abs(normal).max()


def test_the_laser_row_is_that_of_closed_form_and_lack(wrist_case: WristCase) -> None:
    """Of what `look` says of angles, twist and bend, by plain algebra."""
    for seed in range(4):
        whole, seen = hand(wrist_case, seed)
        laser(whole, seen, 0.3)
        cycle_rows, n = whole.epoch_prior.cycle_rows, whole.n
        by_free = whole.parameters.by_parameters(whole.parameters.complete[:, None].copy(), whole.x).reshape(
            5, 4, n
        )
        expected, cost = np.zeros(6 + n + len(whole.z)), 0.0
        for f in range(5):
            r = seen.predicted_laser[f] + cycle_rows.lack[f] - cycle_rows.laser[f]
            pull = seen.by[f, :2].T @ cycle_rows.laser_W[f] @ r
            expected[6 : 6 + n] += by_free[f].T @ pull[:4]
            expected[6 + n + f] += pull[4]
            expected[6 + n + WRIST_ANGLES : 6 + n + WRIST_ANGLES + 2] += pull[5:]
            cost += 0.5 * r @ cycle_rows.laser_W[f] @ r
        found, gradient, _ = whole.cost()
        assert found == pytest.approx(cost, rel=1e-9)
        np.testing.assert_allclose(gradient, expected, atol=1e-9)


@pytest.mark.parametrize(("kind", "share"), KINDS)
def test_the_normal_matrix_is_the_bend_of_the_cost_where_nothing_is_off(
    wrist_case: WristCase, kind: Callable[[Whole, Seen, float], None], share: float
) -> None:
    for seed in range(3):
        whole, seen = hand(wrist_case, seed)
        kind(whole, seen, 0.0)
        cost, gradient, normal = whole.cost()
        assert abs(cost) < 1e-12
        np.testing.assert_allclose(gradient, 0.0, atol=1e-6)
        numeric = whole.hessian_of_cost()
        np.testing.assert_allclose(normal, numeric, atol=share * np.abs(numeric).max())


def test_rows_that_are_not_seen_say_nothing(wrist_case: WristCase) -> None:
    whole, seen = hand(wrist_case, 1)
    tip_depth(whole, seen, 0.3)
    laser(whole, seen, 0.3)
    whole.epoch_prior.cycle_rows.lit[:] = whole.epoch_prior.cycle_rows.shown[:] = 0.0
    cost, gradient, normal = whole.cost()
    assert cost == 0.0
    assert not gradient.any()
    assert not normal.any()


@pytest.mark.parametrize("teaches", [True, False])
def test_a_finger_constrains_its_own_angles_and_twist_and_the_wrist_angles(
    wrist_case: WristCase, teaches: bool
) -> None:
    """One that is ambiguous teaches nothing of its hinges."""
    whole, seen = hand(wrist_case, 2)
    tip_depth(whole, seen, 0.3)
    laser(whole, seen, 0.3)
    cycle_rows = whole.epoch_prior.cycle_rows
    cycle_rows.lit[:] = cycle_rows.shown[:] = np.arange(5) == 2
    cycle_rows.teaches[:] = teaches
    _, gradient, _ = whole.cost()
    own, extras = np.flatnonzero(whole.parameters.free // 4 == 2), 6 + whole.n
    moved = set(np.flatnonzero(gradient).tolist())
    allowed = {*(6 + own).tolist(), extras + WRIST_ANGLES, extras + WRIST_ANGLES + 1, extras + LED_SCALE}
    assert moved <= (allowed | {extras + 2})
    assert {extras + WRIST_ANGLES, extras + WRIST_ANGLES + 1, extras + LED_SCALE} <= moved
    assert (extras + 2 in moved) == teaches


def test_tilt_and_heading_away_from_the_prior_rotate_the_palm(wrist_case: WristCase) -> None:
    """To second order: of a few degrees the cost's slope is right to a few percent."""
    for seed in range(4):
        whole, seen = hand(wrist_case, seed)
        orientation(whole, seen, 0.1)
        whole.z[TILT : HEADING + 1] += whole.rng.normal(0.0, 0.05, 3)
        _, gradient, _ = whole.cost()
        numeric = whole.numeric_gradient()
        np.testing.assert_array_less(np.abs(gradient - numeric), 0.1 * largest(whole, numeric))


@given(seeds, st.sampled_from([0.0, 1e-6, 0.1, 1.0, 3.0]))
def test_a_small_turn_changes_the_rotation_vector_as_its_derivative_says(seed: int, angle_rad: float) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    vector = angle_rad * axis / np.linalg.norm(axis)
    by, rotation = np.empty((3, 3)), rotation_vector_to_matrix(vector)
    rotation_vector_jacobian_at(vector, by)
    for k in range(3):
        ends = [
            matrix_to_rotation_vector(axis_rotation(k, way * 1e-5) @ rotation) / 2e-5 for way in (1.0, -1.0)
        ]
        np.testing.assert_allclose(ends[0] - ends[1], by[:, k], atol=1e-4)
