"""The palm's fit and the kernels under it, against numpy and finite differences."""

import numpy as np
import pytest

from common.arrays import Float
from common.geometry import rotation_vector_to_matrix
from common.hand_model import HandModel
from master.estimator.attached import Attached
from master.estimator.small_matrices import factor, inverse, inverse_3, substitute
from master.fabrik.kinematics import covariances
from master.fabrik.palm import Palm, PalmFitter
from master.fabrik.palm_kernel import PalmPrior, facing_of, linearise, rotate_by, targets_of
from tests.hand_helpers import FACING, LEFT, MARKERS, RIGHT, natural_angles, palm, small_cov

SEEN = np.ones(6, np.bool_)


def moved(T: Float, step: Float) -> Float:
    out = np.eye(4)
    rotate_by(step, T, out)
    return out


def test_a_step_turns_in_front_and_shifts() -> None:
    step = np.array([0.3, -0.2, 0.5, 0.01, 0.02, 0.03])
    out = moved(palm(), step)
    np.testing.assert_allclose(out[:3, :3], rotation_vector_to_matrix(step[:3]) @ palm()[:3, :3], atol=1e-12)
    np.testing.assert_allclose(out[:3, 3], palm()[:3, 3] + step[3:], atol=1e-12)


def cost_of(fitter: PalmFitter, prior: PalmPrior, points: Float, T: Float, x: Float) -> tuple[float, Float]:
    size = 6 + len(x)
    gradient, normal, surprise = np.empty(size), np.empty((size, size)), np.empty(6)
    information = np.tile(np.diag([1e6, 2e6, 3e5]), (6, 1, 1))
    cost = linearise(
        fitter.tables, fitter.mounts, prior, points, information, SEEN, T, x, gradient, normal, surprise
    )
    return cost, gradient


@pytest.mark.parametrize("model", [RIGHT, LEFT])
def test_the_gradient_is_that_of_the_cost(model: HandModel) -> None:
    rng, fitter = np.random.default_rng(1), PalmFitter(model, MARKERS)
    for _ in range(5):
        T, x = palm(rng.uniform(-20, 20, 3)), fitter.parameters.of_angles(natural_angles(rng))
        points = model.marker_points(model.forward(palm(), natural_angles(rng)), MARKERS)
        n = len(x)
        prior = PalmPrior(
            10.0 * np.eye(n), rng.normal(size=n), x + 0.1, np.full(n, 3.0), moved(T, np.full(6, 1e-3)),
            np.array([30.0, 30.0, 30.0, 1e3, 1e3, 1e3]), FACING, 2.0,
        )  # fmt: skip
        _, gradient = cost_of(fitter, prior, points, T, x)
        numeric = np.empty(6 + n)
        for k in range(6 + n):
            step, change = np.zeros(6), np.zeros(n)
            (step if k < 6 else change)[k if k < 6 else k - 6] = 1e-6
            ahead = cost_of(fitter, prior, points, moved(T, step), x + change)[0]
            numeric[k] = (ahead - cost_of(fitter, prior, points, moved(T, -step), x - change)[0]) / 2e-6
        np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max())


@pytest.mark.parametrize("model", [RIGHT, LEFT])
def test_a_natural_hand_is_found_from_its_markers_alone(model: HandModel) -> None:
    rng, fitter, off, turn = (
        np.random.default_rng(2),
        PalmFitter(model, MARKERS),
        list[float](),
        list[float](),
    )
    for _ in range(40):
        T = palm(rng.uniform(-25, 25, 3))
        points = model.marker_points(model.forward(T, natural_angles(rng)), MARKERS)
        found = fitter(points, small_cov(), FACING)
        assert found is not None
        off.append(float(np.linalg.norm(found.T[:3, 3] - T[:3, 3])))
        turn.append(
            float(np.degrees(np.arccos(np.clip((np.trace(found.T[:3, :3].T @ T[:3, :3]) - 1) / 2, -1, 1))))
        )
        assert (found.x >= fitter.tables.low - 1e-12).all()
        assert (found.x <= fitter.tables.high + 1e-12).all()
        assert found.surprise.max() < 16.3
    assert np.median(off) < 8e-3
    assert np.median(turn) < 6.0


def test_too_few_markers_and_none_are_no_palm_and_a_known_one_goes_on_by_one() -> None:
    fitter = PalmFitter(RIGHT, MARKERS)
    points = RIGHT.marker_points(RIGHT.forward(palm(), natural_angles(np.random.default_rng(3))), MARKERS)
    known = fitter(points, small_cov(), FACING)
    assert known is not None
    for kept, expected in ((0, False), (1, False), (2, False), (3, True)):
        few = points.copy()
        few[kept:] = np.nan
        assert (fitter(few, small_cov(), None) is not None) == expected
        assert (fitter(few, small_cov(), None, known, 0.02) is not None) == (kept > 0)
    vague = small_cov()
    vague[:] = np.nan
    assert fitter(points, vague, FACING, known, 0.02) is None


def test_a_leap_that_the_last_palm_does_not_explain_is_followed_from_afresh() -> None:
    fitter, angles = PalmFitter(RIGHT, MARKERS), natural_angles(np.random.default_rng(4))
    last = fitter(RIGHT.marker_points(RIGHT.forward(palm(), angles), MARKERS), small_cov(), FACING)
    there = palm(np.array([5.0, 5.0, 120.0]), np.array([0.1, 0.0, 0.65]))
    points = RIGHT.marker_points(RIGHT.forward(there, angles), MARKERS)
    found, afresh = fitter(points, small_cov(), FACING, last, 1 / 60), fitter(points, small_cov(), FACING)
    assert found is not None
    assert afresh is not None
    assert found.surprise.max() < 16.3
    assert np.linalg.norm(found.T[:3, 3] - there[:3, 3]) < 0.02


def test_the_covariance_of_joints_and_directions_is_that_of_numpy() -> None:
    rng, fitter = np.random.default_rng(5), PalmFitter(RIGHT, MARKERS)
    T, x = palm(np.array([10.0, -20.0, 5.0])), fitter.parameters.of_angles(natural_angles(rng))
    root = rng.normal(0.0, 1.0, (6 + len(x), 6 + len(x)))
    C = root @ root.T * 1e-4
    cov, tilt = np.empty((26, 3, 3)), np.empty((5, 3, 3))
    covariances(fitter.tables, T, x, C, cov, tilt)

    def joints(step: Float) -> Float:
        angles = fitter.parameters.angles(x + step[6:])
        return RIGHT.forward(moved(T, step[:6]), angles).position_m

    J = np.empty((26, 3, 6 + len(x)))
    for k in range(6 + len(x)):
        step = np.zeros(6 + len(x))
        step[k] = 1e-6
        J[..., k] = (joints(step) - joints(-step)) / 2e-6
    np.testing.assert_allclose(cov, J @ C @ J.swapaxes(1, 2), rtol=1e-5, atol=1e-9)
    ends, before = [5, 10, 15, 20, 25], [4, 9, 14, 19, 24]
    p = RIGHT.forward(T, fitter.parameters.angles(x)).position_m
    turn = (J[ends] - J[before]) / np.linalg.norm(p[ends] - p[before], axis=1)[:, None, None]
    np.testing.assert_allclose(tilt, turn @ C @ turn.swapaxes(1, 2), rtol=1e-4, atol=1e-8)


def test_the_pose_is_that_of_the_model_and_markers_are_where_it_mounts_them() -> None:
    for model in (RIGHT, LEFT):
        fitter, angles = PalmFitter(model, MARKERS), natural_angles(np.random.default_rng(6))
        joints, places = fitter.pose(palm(), angles)
        expected = model.forward(palm(), angles)
        np.testing.assert_allclose(joints.position_m, expected.position_m, atol=1e-12)
        np.testing.assert_allclose(joints.rotation, expected.rotation, atol=1e-12)
        attached = Attached.markers(model, fitter.parameters, MARKERS)
        np.testing.assert_allclose(places, attached.place(model.chains(angles)), atol=1e-12)


def test_targets_lie_between_fit_and_measurement_by_their_variances() -> None:
    T, places = palm(np.array([5.0, 10.0, 15.0])), np.tile([0.01, 0.02, -0.1], (3, 1))
    points = places @ T[:3, :3].T + T[:3, 3] + [0.0, 0.0, 0.01]
    points[2] = np.nan
    cov, out = np.stack([np.zeros((3, 3)), 1e-6 * np.eye(3), np.full((3, 3), np.nan)]), np.empty((3, 3))
    targets_of(points, cov, T, places, 1e-6, out)
    found = out @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(found[0], points[0], atol=1e-12)
    np.testing.assert_allclose(found[1] - points[1], [0.0, 0.0, -0.005], atol=1e-12)
    assert np.isnan(out[2]).all()


def test_the_back_faces_the_cameras_that_see_most_of_it() -> None:
    centres, out = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.zeros(3)
    points, focal = np.array([[0.0, 0.0, 1.0], [np.nan] * 3]), np.array([500.0, 500.0])
    for area, x in (
        ([[4.0], [4.0]], 0.0),
        ([[np.nan], [4.0]], 1.0),
        ([[4.0], [np.nan]], -1.0),
        ([[np.nan]] * 2, 0.0),
    ):
        assert facing_of(points, np.array(area), centres, focal, out)
        expected = np.array([x, 0.0, -1.0])
        np.testing.assert_allclose(out, expected / np.linalg.norm(expected), atol=1e-12)
    assert not facing_of(np.full((2, 3), np.nan), np.ones((2, 1)), centres, focal, out)


def test_small_matrices_are_solved_as_by_numpy() -> None:
    rng = np.random.default_rng(7)
    root = rng.normal(size=(8, 8))
    A, b = root @ root.T + 0.1 * np.eye(8), rng.normal(size=8)
    L, out, full = np.zeros((8, 8)), np.empty(8), np.empty((8, 8))
    held = np.zeros(8, np.bool_)
    held[[2, 5]] = True
    assert factor(A, held, L)
    substitute(L, b, held, out)
    np.testing.assert_allclose(out[~held], np.linalg.solve(A[np.ix_(~held, ~held)], b[~held]), rtol=1e-9)
    assert (out[held] == 0.0).all()
    assert inverse(A, 2.0, full)
    np.testing.assert_allclose(full, 2.0 * np.linalg.inv(A), rtol=1e-8)
    assert not inverse(-A, 1.0, full)
    small = np.empty((3, 3))
    inverse_3(A[:3, :3], 0.5, small)
    np.testing.assert_allclose(small, np.linalg.inv(A[:3, :3] + 0.5 * np.eye(3)), rtol=1e-9)


def test_the_covariance_of_a_fit_holds_the_palm() -> None:
    """Of noisy markers of natural hands, of this instant alone."""
    rng, fitter, inside = np.random.default_rng(8), PalmFitter(RIGHT, MARKERS), list[bool]()
    for _ in range(150):
        T, angles = palm(rng.uniform(-20, 20, 3)), natural_angles(rng)
        points = RIGHT.marker_points(RIGHT.forward(T, angles), MARKERS) + rng.normal(0.0, 5e-4, (6, 3))
        found = fitter(points, np.tile(25e-8 * np.eye(3), (6, 1, 1)), FACING)
        assert isinstance(found, Palm)
        cov, _ = fitter.covariances(found)
        off = found.T[:3, 3] - T[:3, 3]
        inside.append(bool(off @ np.linalg.solve(cov[1], off) < 7.81))
    assert np.mean(inside) > 0.9


def test_where_rounding_leaves_no_inverse_nothing_is_known_but_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def none(*_: object) -> bool:
        return False

    fitter = PalmFitter(RIGHT, MARKERS)
    points = RIGHT.marker_points(RIGHT.forward(palm(), natural_angles(np.random.default_rng(9))), MARKERS)
    monkeypatch.setattr("master.fabrik.palm.inverse", none)
    found = fitter(points, small_cov(), FACING)
    assert found is not None
    np.testing.assert_array_equal(found.cov, np.diag(1.0 / fitter.parameters.anywhere))
