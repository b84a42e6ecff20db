"""Curves of uniform cubic B-splines."""

import numpy as np

from master.calibrate.hand.problem import Knots


def test_curves_reproduce_a_straight_line() -> None:
    t = np.sort(np.random.default_rng(1).uniform(0.0, 3.0, 50))
    knots = Knots.over(t, 0.2)
    np.testing.assert_allclose(knots.weight.sum(axis=1), 1.0)
    np.testing.assert_allclose(knots.at(knots.time_s[:, None])[:, 0], t, atol=1e-12)
