"""The adjustment engine against the same problems written out as one dense least-squares problem."""

import numpy as np
import pytest

from common.arrays import Float
from master.calibrate.adjust import Loss, Normal, cauchy, geman_mcclure, huber, minimise, tukey

LOSSES = {
    "huber": huber(2.0),
    "cauchy": cauchy(2.0),
    "geman and mcclure": geman_mcclure(2.0),
    "tukey": tukey(3.0),
}


def dense(residual: Float, shared: Float, own: Float) -> tuple[Float, Float]:
    """Jacobian (E R, S + E L) and residuals (E R,) of rows of E epochs."""
    epochs, rows, size = shared.shape
    length = own.shape[2]
    J = np.zeros((epochs * rows, size + epochs * length))
    for e in range(epochs):
        at = slice(e * rows, (e + 1) * rows)
        J[at, :size] = shared[e]
        J[at, size + e * length : size + (e + 1) * length] = own[e]
    return J, residual.ravel()


def test_step_and_covariance_are_those_of_the_dense_problem() -> None:
    rng = np.random.default_rng(1)
    residual, shared, own = (rng.normal(size=(7, 6, *tail)) for tail in ((), (4,), (3,)))
    normal = Normal(4, 7, 3)
    normal.add(residual, shared, own)
    J, r = dense(residual, shared, own)
    expected = np.linalg.lstsq(J, -r, rcond=None)[0]
    step = normal.step(0.0)
    assert step is not None
    np.testing.assert_allclose(np.concatenate([step[0], step[1].ravel()]), expected, atol=1e-7)
    np.testing.assert_allclose(normal.covariance(), np.linalg.inv(J.T @ J)[:4, :4], rtol=1e-6)
    assert normal.cost == pytest.approx(r @ r)
    assert normal.cost - normal.predicted_gain(*step, 0.0) == pytest.approx(((J @ expected + r) ** 2).sum())


@pytest.mark.parametrize("held", [False, True])
def test_rows_of_a_curve_and_links_are_those_of_the_dense_problem(held: bool) -> None:
    """Rows touch four neighbouring knots, others the change from one knot to the next."""
    rng = np.random.default_rng(2)
    rows, knots, n, g, r = 70, 9, 3, 5, 2
    first, weights = rng.integers(0, knots - 3, rows), rng.normal(size=(rows, 4))
    residual, shared, own = (rng.normal(size=(rows, r, *tail)) for tail in ((), (g,), (n,)))
    off, by, change = (rng.normal(size=(knots - 1, r, *tail)) for tail in ((), (g,), (n,)))
    normal = Normal(g, knots, n, reach=4)
    normal.add(residual, shared, own, epochs=first, weights=weights)
    normal.add(off, by, change, epochs=slice(-1), weights=np.tile([-1.0, 1.0], (knots - 1, 1)))
    J = np.zeros((rows + knots - 1, r, knots, n))
    for i in range(rows):
        J[i, :, first[i] : first[i] + 4] = weights[i, :, None] * own[i, :, None]
    for k in range(knots - 1):
        J[rows + k, :, k], J[rows + k, :, k + 1] = -change[k], change[k]
    if held:
        J[:, :, 4, 1] = 0.0
        normal.hold(np.arange(knots)[:, None] * [0, 1, 0] == 4)
    J = np.concatenate([np.concatenate([shared, by]), J.reshape(-1, r, knots * n)], axis=2).reshape(
        -1, g + knots * n
    )
    expected = np.linalg.lstsq(J, -np.concatenate([residual, off]).ravel(), rcond=None)[0]
    step = normal.step(0.0)
    assert step is not None
    np.testing.assert_allclose(np.concatenate([step[0], step[1].ravel()]), expected, atol=1e-7)
    covariance = np.linalg.pinv(J.T @ J)[:g, :g]
    np.testing.assert_allclose(normal.covariance(), covariance, rtol=1e-6, atol=1e-9)


def test_rows_of_some_epochs_and_some_unknowns_are_added_where_they_belong() -> None:
    rng = np.random.default_rng(2)
    residual, shared, own = (rng.normal(size=(2, 3, *tail)) for tail in ((), (2,), (3,)))
    epochs, columns = np.array([4, 1]), np.array([3, 0])
    normal, whole = Normal(5, 6, 3), Normal(5, 6, 3)
    normal.add(residual, shared, own, epochs=epochs, columns=columns)
    every = np.zeros((6, 3, 5)), np.zeros((6, 3, 3)), np.zeros((6, 3))
    every[0][epochs[:, None, None], np.arange(3)[:, None], columns] = shared
    every[1][epochs], every[2][epochs] = own, residual
    whole.add(every[2], every[0], every[1])
    for name in ("cost", "shared", "gradient", "own", "mixed", "own_gradient"):
        np.testing.assert_allclose(getattr(normal, name), getattr(whole, name), err_msg=name)


def test_what_was_not_observed_adds_nothing() -> None:
    rng = np.random.default_rng(3)
    residual, shared, own = (rng.normal(size=(4, 5, *tail)) for tail in ((), (2,), (1,)))
    fewer, whole = Normal(2, 4, 1), Normal(2, 4, 1)
    fewer.add(residual[:, :3], shared[:, :3], own[:, :3])
    residual[:, 3:], shared[:, 3:] = np.nan, np.nan
    whole.add(residual, shared, own)
    assert whole.cost == fewer.cost
    np.testing.assert_array_equal(whole.shared, fewer.shared)
    np.testing.assert_array_equal(whole.own_gradient, fewer.own_gradient)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_a_weight_is_the_derivative_of_the_cost(loss: Loss) -> None:
    chi2, little = np.linspace(0.0, 30.0, 50), 1e-6
    slope = (loss(chi2 + little)[0] - loss(np.maximum(chi2 - little, 0.0))[0]) / (
        little + np.minimum(chi2, little)
    )
    np.testing.assert_allclose(slope, loss(chi2)[1], atol=1e-5)
    assert loss(np.zeros(1))[0] == 0.0
    assert loss(np.zeros(1))[1] == 1.0


def test_a_held_unknown_does_not_move_and_the_others_step_as_if_it_were_known() -> None:
    rng = np.random.default_rng(4)
    residual, shared, own = (rng.normal(size=(3, 6, *tail)) for tail in ((), (2,), (2,)))
    held = np.array([[False, True], [False, False], [False, False]])
    normal, without = Normal(2, 3, 2), Normal(2, 3, 2)
    normal.add(residual, shared, own)
    normal.hold(held)
    own[0, :, 1] = 0.0
    without.add(residual, shared, own)
    step, expected = normal.step(0.0), without.step(0.0)
    assert step is not None
    assert expected is not None
    assert step[1][0, 1] == 0.0
    np.testing.assert_allclose(step[0], expected[0], atol=1e-7)


def test_a_prior_pulls_and_what_nothing_determines_is_enormous_not_wrong() -> None:
    normal = Normal(2)
    normal.add(np.array([[3.0]]), np.array([[[1.0, 0.0]]]))
    assert normal.covariance()[1, 1] > 1e6
    normal.add_prior(np.array([1.0, -2.0]), np.array([np.inf, 0.5]))
    step = normal.step(0.0)
    assert step is not None
    np.testing.assert_allclose(step[0], [-3.0, 2.0])
    np.testing.assert_allclose(normal.covariance(), np.diag([1.0, 0.25]), atol=1e-9)


def test_a_free_frame_is_no_uncertainty() -> None:
    """Of two points only the distance is measured: their common shift is left out of the covariance."""
    normal = Normal(2)
    normal.add(np.array([[0.0]]), np.array([[[1.0, -1.0]]]))
    basis = np.array([[1.0], [-1.0]]) / np.sqrt(2.0)
    np.testing.assert_allclose(normal.covariance(basis), 0.25 * np.array([[1.0, -1.0], [-1.0, 1.0]]))


def test_a_curve_is_found_whatever_a_few_points_are() -> None:
    t = np.linspace(0.0, 3.0, 60)
    seen = 2.0 * np.exp(-1.3 * t)
    seen[::9] += 4.0

    def equations(x: Float) -> Normal:
        normal = Normal(2)
        by = np.stack([np.exp(-x[1] * t), -x[0] * t * np.exp(-x[1] * t)], axis=1)
        normal.add(
            ((x[0] * np.exp(-x[1] * t) - seen) / 0.05)[:, None], (by / 0.05)[:, None], loss=cauchy(3.0)
        )
        return normal

    found = minimise(equations, lambda x, shared, _own: x + shared, np.array([1.0, 0.3]))
    assert found.settled
    np.testing.assert_allclose(found.x, [2.0, 1.3], atol=0.01)


def test_steps_that_run_out_are_said() -> None:
    def equations(x: Float) -> Normal:
        normal = Normal(1)
        normal.add(np.array([[x[0] ** 2 + 1.0]]), np.array([[[2.0 * x[0]]]]))
        return normal

    assert not minimise(equations, lambda x, shared, _own: x + shared, np.array([5.0]), steps=1).settled


def test_a_step_into_what_has_no_value_is_taken_back() -> None:
    """The logarithm of a number below 0 is NaN: the step is damped until it stays above."""

    def equations(x: Float) -> Normal:
        normal = Normal(1)
        with np.errstate(invalid="ignore"):
            residual = np.log(x[0]) + 3.0
        if not np.isfinite(residual):
            normal.cost = np.nan
        normal.add(np.array([[residual]]), np.array([[[1.0 / x[0]]]]))
        return normal

    found = minimise(equations, lambda x, shared, _own: x + shared, np.array([1.0]))
    assert found.x[0] == pytest.approx(np.exp(-3.0), rel=1e-4)
