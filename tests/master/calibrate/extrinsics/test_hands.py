"""Hands against their markers: slopes by differences, the shift of an exact fit, and markers that nobody saw."""

from dataclasses import replace

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rotation_vector_to_matrix
from master.calibrate.adjust import Normal
from master.calibrate.extrinsics.problem import HandProblem, Hands
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


def rows_of(at: HandProblem, hands: Hands) -> Normal:
    normal = Normal(1, COUNT, 6 + hands.x.shape[1])
    at.add_to(normal, hands, np.zeros_like(at.points_m), 0)
    return normal


def derivatives(at: HandProblem, hands: Hands) -> Float:
    """Of half of the cost (T, 6 + n) by turn, shift and angles of each epoch, by central differences."""
    out = np.zeros((COUNT, 6 + hands.x.shape[1]))
    for where in np.ndindex(out.shape):
        step = np.zeros_like(out)
        step[where] = DIFFERENCE_STEP
        there, back = (rows_of(at, hands.retracted(way * step)).cost for way in (1.0, -1.0))
        out[where] = 0.25 * (there - back) / DIFFERENCE_STEP
    return out


def test_the_gradient_is_the_derivative_of_the_cost() -> None:
    at, hands = problem()
    found = rows_of(at, hands).own_gradient
    np.testing.assert_allclose(found, derivatives(at, hands), rtol=1e-5, atol=1e-2)


def test_the_normal_matrix_is_the_curvature_where_markers_fit() -> None:
    at, hands = problem()
    at = replace(at, points_m=at.place(hands))
    rng = np.random.default_rng(6)
    step = 1e-5 * rng.normal(size=(COUNT, 6 + hands.x.shape[1]))
    here = rows_of(at, hands)
    curved = np.einsum("ti,tij,tj->", step, here.own[0], step)
    there, back = (rows_of(at, hands.retracted(way * step)).cost for way in (1.0, -1.0))
    np.testing.assert_allclose(0.5 * (there + back - 2.0 * here.cost), curved, rtol=1e-4)


def test_a_marker_that_nobody_saw_counts_nothing() -> None:
    at, hands = problem()
    whiten = at.whiten.copy()
    whiten[1, 0] = 0.0
    elsewhere = at.points_m.copy()
    elsewhere[1, 0] += 1.0
    one, other = (rows_of(replace(at, whiten=whiten, points_m=p), hands) for p in (at.points_m, elsewhere))
    assert one.cost == other.cost
    np.testing.assert_array_equal(one.own_gradient, other.own_gradient)
    assert one.cost < rows_of(at, hands).cost
    np.testing.assert_allclose(one.own_gradient[0], rows_of(at, hands).own_gradient[0])
