"""Tests of the mean within limits, against numerical integration and against drawn numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import truncnorm

from common.arrays import Float
from master.ik.within import mean_within

seeds = st.integers(0, 2**32 - 1)
PALM = 6


def problem(rng: np.random.Generator, angles: int) -> tuple[Float, Float]:
    """A positive definite normal matrix (6 + n, 6 + n), and its inverse."""
    root = rng.normal(size=(PALM + angles, PALM + angles))
    normal = root @ root.T + 0.5 * np.eye(PALM + angles)
    return normal, np.asarray(np.linalg.inv(normal), np.float64)


@pytest.mark.parametrize(("x", "pull"), [(0.0, 3.0), (0.3, 0.0), (1.0, -2.0)])
def test_one_angle_is_the_mean_of_a_normal_distribution_that_is_cut(x: float, pull: float) -> None:
    """With nothing else tied to it the answer is known. `pull` is the gradient: at a limit, pushed against it."""
    normal, sigma = np.diag([1.0] * PALM + [16.0]), 0.25
    gradient = np.append(np.zeros(PALM), pull)
    step = mean_within(normal, gradient, np.array([x]), np.zeros(1), np.ones(1))
    middle = x - pull * sigma**2
    expected = truncnorm.mean(-middle / sigma, (1.0 - middle) / sigma, loc=middle, scale=sigma)
    np.testing.assert_allclose(x + step[PALM], expected, atol=1e-4)
    np.testing.assert_array_equal(step[:PALM], 0.0)


@given(seeds)
@settings(max_examples=10)
def test_many_angles_have_the_mean_of_what_is_drawn_within_the_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal, cov = problem(rng, 3)
    x = np.array([0.0, 0.4, 1.0])
    low, high = np.zeros(3), np.ones(3)
    drawn = rng.multivariate_normal(np.zeros(PALM + 3), cov, 400_000)
    inside = drawn[((drawn[:, PALM:] + x >= low) & (drawn[:, PALM:] + x <= high)).all(axis=1)]
    if len(inside) < 2000:
        return
    step = mean_within(normal, np.zeros(PALM + 3), x, low, high)
    error = (step - inside.mean(axis=0)) / np.sqrt(np.diag(cov))
    assert np.abs(error).max() < 0.08


def test_far_from_its_limits_a_hand_stays_where_it_is() -> None:
    normal, _ = problem(np.random.default_rng(1), 4)
    step = mean_within(1e4 * normal, np.zeros(PALM + 4), np.full(4, 0.5), np.full(4, -5.0), np.full(4, 6.0))
    np.testing.assert_allclose(step, 0.0, atol=1e-6)


@given(seeds)
@settings(max_examples=50)
def test_no_step_leaves_the_limits_and_what_cannot_move_does_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal, _ = problem(rng, 5)
    low = rng.uniform(-1.0, 0.0, 5)
    high = low + rng.uniform(0.0, 2.0, 5) * np.array([1.0, 1.0, 0.0, 1.0, 1.0])
    x = rng.uniform(low, high)
    x[0] = low[0]
    step = mean_within(normal * 10.0 ** rng.uniform(-3, 6), 1e3 * rng.normal(size=PALM + 5), x, low, high)
    assert np.isfinite(step).all()
    assert (x + step[PALM:] >= low - 1e-12).all()
    assert (x + step[PALM:] <= high + 1e-12).all()
    assert abs(step[PALM + 2]) < 1e-9
