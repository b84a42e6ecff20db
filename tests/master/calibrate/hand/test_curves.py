"""Bordered normal equations against the same least squares written out."""

import numpy as np
import pytest

from master.calibrate.hand.curves import BorderedNormal, Knots


def test_curves_reproduce_a_straight_line() -> None:
    t = np.sort(np.random.default_rng(1).uniform(0.0, 3.0, 50))
    knots = Knots.over(t, 0.2)
    np.testing.assert_allclose(knots.weight.sum(axis=1), 1.0)
    np.testing.assert_allclose(knots.at(knots.time_s[:, None])[:, 0], t, atol=1e-12)


@pytest.mark.parametrize("seconds", [2.0, 3.1, 3.6])  # counts of knots that are no multiples of three, too
def test_the_step_and_the_information_are_those_of_the_dense_problem(seconds: float) -> None:
    rng = np.random.default_rng(2)
    epochs, n, g, r = 70, 3, 2, 5
    knots = Knots.over(np.sort(rng.uniform(0.0, seconds, epochs)), 0.25)
    count = len(knots.time_s)
    normal = BorderedNormal(count, n, g)
    J, B, off = (rng.normal(size=(epochs, r, *tail)) for tail in ((n,), (g,), ()))
    links, by, rest = (rng.normal(size=(count - 1, *tail)) for tail in ((2, 2, n), (2, g), (2,)))
    normal.add_epochs(knots, J, B, off)
    normal.add_links(links, by, rest)
    dense = np.zeros((epochs * r + 2 * (count - 1), count * n + g))
    for i in range(epochs):
        for w in range(4):
            c = (int(knots.first[i]) + w) * n
            dense[i * r : (i + 1) * r, c : c + n] = knots.weight[i, w] * J[i]
        dense[i * r : (i + 1) * r, count * n :] = B[i]
    for k in range(count - 1):
        row = epochs * r + 2 * k
        dense[row : row + 2, k * n : (k + 2) * n] = links[k].reshape(2, -1)
        dense[row : row + 2, count * n :] = by[k]
    expected = np.linalg.lstsq(dense, np.concatenate([off.ravel(), rest.ravel()]), rcond=None)[0]
    curves, constants, information = normal.solve(0.0)
    np.testing.assert_allclose(curves.ravel(), expected[:-g], atol=1e-5)
    np.testing.assert_allclose(constants, expected[-g:], atol=1e-7)
    covariance = np.linalg.inv(dense.T @ dense)[-g:, -g:]
    np.testing.assert_allclose(np.linalg.inv(information), covariance, rtol=1e-6, atol=1e-9)
