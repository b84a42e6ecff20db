"""Hands against their markers: slopes by differences, the shift of an exact fit, and markers that nobody saw."""

from dataclasses import replace

import numpy as np
import pytest

from common.arrays import Float
from common.geometry.transforms import rotation_vector_to_matrix
from master.calibrate.extrinsics.normal import HandProblem, Hands
from master.estimator.kinematics import BodyPoints
from master.estimator.parameters import HandParameters
from master.estimator.priors import PosturePrior, posture_prior_of
from tests.master.calibrate.extrinsics.moved import moved

COUNT, DIFFERENCE_STEP = 4, 1e-5


def problem(seed: int = 5) -> tuple[HandProblem, Hands]:
    """Four hands inside their limits whose markers were seen some millimetres away."""
    rng, seen = np.random.default_rng(seed), moved().both.markers
    parameters = HandParameters.of(seen.hand)
    share = rng.uniform(0.2, 0.8, (COUNT, len(parameters.free)))
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    T[:, :3, :3] = rotation_vector_to_matrix(rng.normal(size=(COUNT, 3)))
    T[:, :3, 3] = rng.normal(0.0, 0.2, (COUNT, 3))
    hands = Hands(T, parameters.low + share * (parameters.high - parameters.low))
    markers = BodyPoints.markers(seen.hand, parameters, seen.markers)
    shape = (COUNT, len(seen.markers), 3)
    free = posture_prior_of(seen.hand, parameters)
    whiten = 1e3 * np.eye(3) + rng.normal(0.0, 50.0, (*shape, 3))
    out = HandProblem(seen.hand, markers, PosturePrior(*(part[1:] for part in free)), np.zeros(shape), whiten)
    return replace(out, points_m=out.place(hands) + rng.normal(0.0, 3e-3, shape)), hands


def derivatives(at: HandProblem, hands: Hands) -> Float:
    """Of the cost (T, 6 + n) by turn, shift and angles, by central differences."""
    size = 6 + hands.x.shape[1]
    steps = DIFFERENCE_STEP * np.eye(size)[:, None] * np.ones((COUNT, 1))
    ways = [at.cost(hands.retracted(step)) - at.cost(hands.retracted(-step)) for step in steps]
    return np.array(ways).T / (2.0 * DIFFERENCE_STEP)


def test_the_gradient_is_the_derivative_of_the_cost() -> None:
    at, hands = problem()
    np.testing.assert_allclose(at.linearise(hands).gradient, derivatives(at, hands), rtol=1e-5, atol=1e-2)


def test_the_normal_matrix_is_the_curvature_where_markers_fit() -> None:
    at, hands = problem()
    at = replace(at, points_m=at.place(hands))
    rng = np.random.default_rng(6)
    step = 1e-5 * rng.normal(size=(COUNT, 6 + hands.x.shape[1]))
    here = at.linearise(hands)
    curved = np.einsum("ti,tij,tj->t", step, here.normal, step)
    found = at.cost(hands.retracted(step)) + at.cost(hands.retracted(-step)) - 2.0 * at.cost(hands)
    np.testing.assert_allclose(found, curved, rtol=1e-4)


def test_a_marker_that_nobody_saw_counts_nothing() -> None:
    at, hands = problem()
    whiten = at.whiten.copy()
    whiten[1, 0] = 0.0
    elsewhere = at.points_m.copy()
    elsewhere[1, 0] += 1.0
    one, other = (replace(at, whiten=whiten, points_m=points) for points in (at.points_m, elsewhere))
    np.testing.assert_array_equal(one.cost(hands), other.cost(hands))
    np.testing.assert_array_equal(one.linearise(hands).gradient, other.linearise(hands).gradient)
    assert one.cost(hands)[1] < at.cost(hands)[1]
    assert one.cost(hands)[0] == pytest.approx(at.cost(hands)[0])
