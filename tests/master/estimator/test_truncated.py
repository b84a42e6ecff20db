"""Tests of the mean within limits, against numerical integration and against drawn numbers."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import truncnorm

from common.arrays import Float
from common.records import boxed, record
from master.estimator.parameters import Cut, HandTables
from master.estimator.sensors import NO_EXTRAS
from tests.hand_helpers import RIGHT
from tests.master.estimator.fitted import FREE, PARAMETERS
from tests.master.estimator.kernels import truncated_mean_at

seeds = st.integers(0, 2**32 - 1)
PALM = 6
SIZE = PALM + FREE + NO_EXTRAS  # as of a rig of markers, whose kernels are there
ANGLES = slice(PALM, PALM + FREE)


def truncated_mean(
    normal: Float, gradient: Float, x: Float, low: Float, high: Float, at_low_limit: bool = False
) -> Float:
    """The step (SIZE,) to the mean of a hand with those limits; `at_low_limit`: its fingers rest at their low ones."""
    tables, mean = HandTables.of(RIGHT, PARAMETERS), np.empty(SIZE)
    tables.low[:], tables.high[:], tables.at_low_limit[:] = low, high, at_low_limit
    truncated_mean_at(boxed(tables), normal, gradient, x, boxed(record(Cut, n=FREE, N=SIZE)), mean)
    return mean


def unknowns(angles: Float, others: float = 0.0) -> Float:
    """Numbers (SIZE,) of angles (n,) among unknowns without limits."""
    whole = np.full(SIZE, others)
    whole[ANGLES] = angles
    return whole


def problem(rng: np.random.Generator) -> Float:
    """A positive definite normal matrix (SIZE, SIZE)."""
    root = rng.normal(size=(SIZE, SIZE))
    return root @ root.T + 0.5 * np.eye(SIZE)


def test_angles_that_nothing_ties_have_the_mean_of_a_normal_distribution_that_is_cut() -> None:
    """The answer is known. A gradient pulls only where an angle stands at a limit, against it."""
    rng, sigma = np.random.default_rng(1), 0.25
    x = np.concatenate([np.zeros(4), rng.uniform(0.05, 0.95, FREE - 8), np.ones(4)])
    pull = np.concatenate([[0.0, 1.0, 3.0, 9.0], np.zeros(FREE - 8), [-9.0, -3.0, -1.0, 0.0]])
    normal = np.diag(unknowns(np.full(FREE, sigma**-2.0), 1.0))
    step = truncated_mean(normal, unknowns(pull), x, np.zeros(FREE), np.ones(FREE))
    middle = x - pull * sigma**2
    expected = truncnorm.mean(-middle / sigma, (1.0 - middle) / sigma, loc=middle, scale=sigma)
    np.testing.assert_allclose(x + step[ANGLES], expected, atol=1e-4)
    np.testing.assert_array_equal(step[:PALM], 0.0)


def test_nothing_piles_up_where_a_straight_finger_rests() -> None:
    """At the low limit of a finger that rests there: it does not move up, however poorly it is known."""
    normal, x = np.diag(unknowns(np.full(FREE, 16.0), 1.0)), np.zeros(FREE)
    zero, far = np.zeros(SIZE), np.full(FREE, 50.0)
    assert np.abs(truncated_mean(normal, zero, x, x, far, at_low_limit=True)).max() < 1e-9
    assert truncated_mean(normal, zero, x, x, far)[ANGLES].min() > 0.15


@given(seeds)
@settings(max_examples=10)
def test_angles_that_are_tied_have_the_mean_of_what_is_drawn_within_the_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tied = PALM + 3
    root = rng.normal(size=(tied, tied))
    normal = np.eye(SIZE)
    normal[:tied, :tied] = root @ root.T + 0.5 * np.eye(tied)
    cov = np.linalg.inv(normal[:tied, :tied])
    x = np.append([0.0, 0.4, 1.0], np.full(FREE - 3, 50.0))
    low, high = np.zeros(FREE), np.append(np.ones(3), np.full(FREE - 3, 100.0))
    drawn = rng.multivariate_normal(np.zeros(tied), cov, 400_000)
    angles = drawn[:, PALM:] + x[:3]
    inside = drawn[((angles >= 0.0) & (angles <= 1.0)).all(axis=1)]
    if len(inside) < 2000:
        return
    step = truncated_mean(normal, np.zeros(SIZE), x, low, high)
    error = (step[:tied] - inside.mean(axis=0)) / np.sqrt(np.diag(cov))
    assert np.abs(error).max() < 0.08
    assert np.abs(step[tied:]).max() < 1e-9


def test_far_from_its_limits_a_hand_stays_where_it_is() -> None:
    normal, x = problem(np.random.default_rng(1)), np.full(FREE, 0.5)
    step = truncated_mean(1e4 * normal, np.zeros(SIZE), x, np.full(FREE, -5.0), np.full(FREE, 6.0))
    np.testing.assert_allclose(step, 0.0, atol=1e-6)


@given(seeds)
@settings(max_examples=50)
def test_no_step_leaves_the_limits_and_what_cannot_move_does_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, scratch = rng.uniform(-1.0, 0.0, FREE), np.ones(FREE)
    scratch[2] = 0.0
    high = low + rng.uniform(0.0, 2.0, FREE) * scratch
    x = rng.uniform(low, high)
    x[0] = low[0]
    normal = problem(rng) * 10.0 ** rng.uniform(-3, 6)
    step = truncated_mean(normal, 1e3 * rng.normal(size=SIZE), x, low, high)
    assert np.isfinite(step).all()
    assert (x + step[ANGLES] >= low - 1e-12).all()
    assert (x + step[ANGLES] <= high + 1e-12).all()
    assert abs(step[PALM + 2]) < 1e-9
