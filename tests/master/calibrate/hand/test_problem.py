"""The equations of the hand's routine: their gradient is that of the cost, and no length is favoured by them."""

from dataclasses import replace

import numpy as np
import pytest

from bench.hands.routines import routine, with_back
from common.arrays import Float
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from master.calibrate.hand.measure import problem_of
from master.calibrate.hand.observed import Observed, align
from master.calibrate.hand.problem import HandRoutineProblem, State
from master.calibrate.hand.shape import PER_FINGER, Priors


@pytest.fixture(scope="module")
def problem() -> HandRoutineProblem:
    run = routine(28, "right", back=3, rate_hz=20.0)
    model = HandModel.of(with_back(generated_profile("mine", "right"), 3))
    observed = Observed.of(run.t_ns, run.points_m, run.cov_m2, run.names, model)
    return problem_of(observed, model, align(observed, model), Priors())


def moved(state: State, shape: Float, coefficients: Float) -> State:
    return State(state.shape.stepped(shape), state.coefficients + coefficients)


def test_the_gradient_is_that_of_the_cost(problem: HandRoutineProblem) -> None:
    rng, state = np.random.default_rng(1), problem.guess()
    size, shape = state.coefficients.shape, 1e-3 * rng.normal(size=state.shape.size)
    shape[: 5 * PER_FINGER].reshape(5, PER_FINGER)[:, 6:9] = (
        0.0  # priors of rotations are linear about the prior
    )
    state = moved(state, shape, 0.02 * rng.normal(size=size))
    normal, small = problem.equations(state), 1e-6
    for _ in range(3):
        by_shape, by_curve = rng.normal(size=state.shape.size), rng.normal(size=size)
        ahead, behind = (
            problem.equations(moved(state, sign * small * by_shape, sign * small * by_curve)).cost
            for sign in (1.0, -1.0)
        )
        slope = 2.0 * float(normal.gradient @ by_shape + (normal.own_gradient * by_curve).sum())
        assert (ahead - behind) / (2.0 * small) == pytest.approx(slope, rel=1e-4)


def test_a_longer_finger_that_goes_the_same_way_by_smaller_angles_costs_the_same(
    problem: HandRoutineProblem,
) -> None:
    """Of changes: else the noise, which the angles follow, would lengthen all fingers."""
    free = replace(
        problem,
        points_m=np.full_like(problem.points_m, np.nan),
        priors=Priors(bone=1e6, level_rad=1e6, moving_level_rad=1e6, straight_rad=(0.0, 1e6)),
    )
    state = free.guess()
    state.coefficients[:, 6:] += 0.1 * np.random.default_rng(2).normal(size=(len(state.coefficients), 20))
    longer = replace(state.shape, length_m=1.1 * state.shape.length_m)
    smaller = state.coefficients / np.repeat([1.0, 1.1], [6, 20])
    cost = free.equations(state).cost
    assert free.equations(State(longer, smaller)).cost == pytest.approx(cost, rel=0.02)
    assert free.equations(State(longer, state.coefficients)).cost > 1.1 * cost
