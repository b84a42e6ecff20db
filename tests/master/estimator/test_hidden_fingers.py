"""Tests of fingers that nobody sees: they go on a little, follow the others, and the uncertainty of them grows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from common.arrays import Float
from common.records import boxed, record
from master.estimator.parameters import HandTables
from master.estimator.sensors import NO_EXTRAS
from master.estimator.settings import DEFAULT
from master.estimator.state import NEVER_NS, Hidden, unknown_hand
from tests.hand_helpers import RIGHT, within
from tests.master.estimator.fitted import FREE, PARAMETERS, STEP_NS
from tests.master.estimator.kernels import hide_at

ALL = frozenset({0, 1, 2, 3, 4})
RING = 3
TABLES, SETTINGS = HandTables.of(RIGHT, PARAMETERS), DEFAULT.record()


@dataclass(frozen=True)
class HiddenFingers:
    """Prediction of fingers that nobody sees: (5, 4) [rad], their (5, 4) [rad], (5,) [s]."""

    angles_rad: Float
    sigma_rad: Float
    gone_s: Float


class Memory:
    """The state of a hand, of which only the angles are set."""

    def __init__(self, natural: float = 1.0) -> None:
        self.state = unknown_hand(n=FREE, K=NO_EXTRAS, N=6 + FREE + NO_EXTRAS)
        self.state.natural_weight[0] = natural

    def moved(self, before_rad: Float, after_rad: Float, dt_s: float) -> None:
        """Let the rates be those of a step, as the end of an epoch leaves them."""
        rate = (after_rad - before_rad).reshape(20) / dt_s
        share = 1.0 - np.exp(-dt_s / DEFAULT.rate_memory_s)
        self.state.rates[:] += share * (rate - self.state.rates)

    def epoch_prior(self, t_ns: int, last_ns: int, last_rad: Float, shown: frozenset[int]) -> HiddenFingers:
        """Where fingers that are not shown are now, if the hand was like that a moment ago."""
        hidden = record(Hidden, n=FREE)
        self.state.angles[:], self.state.t_ns[0] = last_rad.reshape(20), last_ns
        seen = np.isin(np.arange(5), list(shown))
        boxes = boxed(TABLES), boxed(SETTINGS), boxed(self.state)
        hide_at(*boxes, t_ns, seen, boxed(hidden))
        self.state.hidden_ns[seen] = NEVER_NS  # as the end of an epoch leaves it
        return HiddenFingers(
            hidden.angles.reshape(5, 4), hidden.sigma.reshape(5, 4).copy(), hidden.gone_s.copy()
        )


def bent(degrees: Float | float) -> Float:
    """Fingers index ... little bent by so much at the PIP, half of it at the MCP; the thumb at rest."""
    angles = np.zeros((5, 4))
    pip = np.radians(degrees) * np.ones(4)
    angles[1:, 1], angles[1:, 2], angles[1:, 3] = 0.5 * pip, pip, pip * 2 / 3
    return angles


def after(
    gone: frozenset[int],
    history_deg: Sequence[Float | float],
    before_deg: tuple[float, float] = (40.0, 40.0),
    natural: float = 1.0,
) -> list[HiddenFingers]:
    """Beliefs while `gone` are hidden and the last pose is, frame by frame, that of `history_deg`."""
    memory = Memory(natural)
    for _ in range(10):
        memory.moved(bent(before_deg[0]), bent(before_deg[1]), STEP_NS * 1e-9)
    seen = ALL - gone
    return [
        memory.epoch_prior((k + 1) * STEP_NS, k * STEP_NS, bent(pip), seen)
        for k, pip in enumerate(history_deg)
    ]


def pip_deg(hidden: HiddenFingers, finger: int = RING) -> float:
    return float(np.degrees(hidden.angles_rad[finger, 2]))


def test_a_hidden_ring_finger_closes_with_its_neighbours() -> None:
    closing = [np.array([p, p, 40.0, p]) for p in np.linspace(40.0, 80.0, 30)]
    history = [pip_deg(hidden) for hidden in after(frozenset({RING}), closing)]
    assert np.all(np.diff(history) > 0.0)
    assert 70.0 < history[-1] < 82.0


def test_one_at_the_side_follows_less_and_the_thumb_not_at_all() -> None:
    closing = [np.array([p, p, p, 40.0]) for p in np.linspace(40.0, 80.0, 30)]
    last = after(frozenset({0, 4}), closing)[-1]
    assert 60.0 < pip_deg(last, 4) < 74.0
    np.testing.assert_array_equal(last.angles_rad[0], np.zeros(4))


def test_a_hand_against_the_posture_prior_moves_its_fingers_one_by_one() -> None:
    closing = [np.array([p, p, 40.0, p]) for p in np.linspace(40.0, 80.0, 30)]
    natural, free = (after(frozenset({RING}), closing, natural=p)[-1] for p in (1.0, 0.0))
    assert pip_deg(free) == pytest.approx(40.0)
    assert free.sigma_rad[RING, 2] > 1.5 * natural.sigma_rad[RING, 2]


@pytest.mark.parametrize("speed_deg_s", [90.0, 200.0, -200.0])
def test_with_all_hidden_a_finger_goes_on_for_a_moment(speed_deg_s: float) -> None:
    step = speed_deg_s * STEP_NS * 1e-9
    history = [pip_deg(h) for h in after(ALL, [40.0] * 60, (40.0 - step, 40.0))]
    assert abs(history[1] - 40.0) > 0.5 * 2 * abs(step)
    assert history[-1] - 40.0 == pytest.approx(DEFAULT.coast_s * speed_deg_s, rel=0.01)


def test_it_stops_where_the_others_stop() -> None:
    step = 200.0 * STEP_NS * 1e-9
    history = [pip_deg(h) for h in after(frozenset({RING}), [40.0] * 60, (40.0 - step, 40.0))]
    assert max(history) < 40.0 + 0.2 * DEFAULT.coast_s * 200.0


def test_uncertainty_grows_with_time_and_less_between_neighbours_that_show() -> None:
    alone = np.array([h.sigma_rad[RING, 2] for h in after(ALL, [40.0] * 200)])
    between = np.array([h.sigma_rad[RING, 2] for h in after(frozenset({RING}), [40.0] * 200)])
    assert (np.diff(alone) > 0.0).all()
    assert (np.diff(between) > 0.0).all()
    assert (between < alone).all()
    assert alone[-1] < 1.01 * DEFAULT.growth_rad
    # what is seen of the other three halves the variance, and more
    assert between[60] ** 2 < 0.5 * alone[60] ** 2


def test_a_marker_that_returns_begins_a_new_time() -> None:
    memory = Memory()
    seen = ALL - {RING}
    gone = [memory.epoch_prior((k + 1) * STEP_NS, k * STEP_NS, bent(40.0), seen) for k in range(20)]
    assert gone[-1].gone_s[RING] == pytest.approx(20 * STEP_NS * 1e-9)
    assert memory.epoch_prior(21 * STEP_NS, 20 * STEP_NS, bent(40.0), ALL).gone_s[RING] == 0.0
    hidden = memory.epoch_prior(22 * STEP_NS, 21 * STEP_NS, bent(40.0), seen)
    assert hidden.gone_s[RING] == pytest.approx(STEP_NS * 1e-9)


def test_an_epoch_that_is_fitted_twice_still_knows_when_a_finger_was_seen_last() -> None:
    memory = Memory()
    memory.epoch_prior(STEP_NS, 0, bent(40.0), ALL - {RING})
    assert memory.state.hidden_ns[RING] == 0
    hide_at(
        boxed(TABLES),
        boxed(SETTINGS),
        boxed(memory.state),
        2 * STEP_NS,
        np.ones(5, np.bool_),
        boxed(record(Hidden, n=FREE)),
    )
    assert memory.state.hidden_ns[RING] == 0


def test_no_estimate_leaves_the_limits() -> None:
    closing = [np.array([p, p, 40.0, p]) for p in np.linspace(40.0, 110.0, 40)]
    for hidden in after(frozenset({RING, 0}), closing, (30.0, 40.0)):
        assert within(RIGHT, hidden.angles_rad)


def test_a_step_of_a_millisecond_throws_no_finger() -> None:
    """Instants follow that soon where another camera takes the lead; a degree of noise is no 1000 degrees a second."""
    memory = Memory()
    for _ in range(10):
        memory.moved(bent(40.0), bent(40.0), STEP_NS * 1e-9)
    memory.moved(bent(40.0), bent(41.5), 1e-3)
    history = [memory.epoch_prior((k + 1) * STEP_NS, k * STEP_NS, bent(41.5), frozenset()) for k in range(60)]
    assert max(abs(pip_deg(hidden) - 41.5) for hidden in history) < 10.0
