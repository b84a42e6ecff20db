"""Fingers that nobody sees: where they are believed to be, and how far they may have strayed since.

When its marker goes, a finger moves on a little the way it was moving, and with its neighbours: fingers are moved by
muscles and nerves that they share, so a hidden ring finger between closing neighbours closes with them (Hager-Ross,
Schieber 2000, "Quantifying the independence of human finger movements"; Ingram, Kording, Howard, Wolpert 2008, "The
statistics of natural hand movements"). How far it strays from there is taken as a smooth stationary process, whose
steps in a time have the variance (the structure function of a Gaussian correlation)

    strayed(t) = STRAY^2 (1 - exp(-(t / STRAY_S)^2))

and the steps of two of the four fingers that are k apart correlate by ALIKE^k. So what the seen ones did since says
what the hidden ones did, as a conditional mean and variance. A hand that defied habits when the marker went
(`HandSolution.natural`) moves its fingers one by one, and so does every hand its thumb.

STRAY and STRAY_S are of the order of what hands do at work, in simulated scenes as in recorded motion: a flexion is 3
degrees from where it was heading after 0.1 s, 10 after 0.3 s, 20 after 0.6 s, 30 after 1.2 s.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.hand_model import HandModel

COAST_S = 0.12  # a lost finger's own motion fades with this time constant
_LEARN_S = 0.024  # of the speeds: half of a new one counts at 60 frames a second
STRAY_RAD, STRAY_S = np.radians(40.0), 1.2
ALIKE = 0.7
_APART = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
_HELD_RAD = np.radians(3.0)  # a finger that was just lost is held as firmly as this


def strayed_rad2(gone_s: Float) -> Float:
    """Variance [rad^2] of a finger's angle about where it was heading, a time after it was last seen."""
    return STRAY_RAD**2 * (1.0 - np.exp(-np.square(gone_s / STRAY_S)))


@dataclass(frozen=True, slots=True, eq=False)
class HiddenFingers:
    """What is believed of fingers without a marker.

    Attributes:
        angles_rad: (5, 4); those of fingers that are seen mean nothing.
        sigma_rad: (5,) standard deviation of that belief.
        gone_s: (5,) time since the marker was last seen; 0: seen now.
        own: (5,) share of the variance of a step that the fingers that are seen do not tell.
    """

    angles_rad: Float
    sigma_rad: Float
    gone_s: Float
    own: Float


class FingerMemory:
    """Push machine. Holds each finger's angular speed, and of each lost finger when that was and how all moved then."""

    def __init__(self, model: HandModel) -> None:
        self._model = model
        self._speed = np.zeros((5, 4))
        self._lost_ns: list[int | None] = [None] * 5
        self._then_rad, self._then_speed = np.zeros((5, 5, 4)), np.zeros((5, 5, 4))
        self._then_alike = np.empty((5, 4, 4))

    def moved(self, before_rad: Float, after_rad: Float, dt_s: float) -> None:
        """Learn from one step of the angles (5, 4)."""
        share = 1.0 - np.exp(-dt_s / _LEARN_S)  # a short step is mostly noise
        self._speed = self._speed + share * ((after_rad - before_rad) / dt_s - self._speed)

    def belief(
        self, t_ns: int, last_ns: int, last_rad: Float, natural: float, seen: frozenset[int]
    ) -> HiddenFingers:
        """Where lost fingers are believed to be.

        Args:
            t_ns: The instant, not before any earlier one.
            last_ns, last_rad, natural: When the last pose held, its angles (5, 4), and its probability to obey habits.
            seen: Fingers that have a marker now.
        """
        gone, own = np.zeros(5), np.ones(5)
        if seen.issuperset(range(5)):
            self._lost_ns = [None] * 5
            return HiddenFingers(last_rad, np.full(5, _HELD_RAD), gone, own)
        angles, others = last_rad.copy(), np.array(sorted(f for f in seen if f > 0), np.int64)
        for f in range(5):
            if f in seen:
                self._lost_ns[f] = None
                continue
            since = self._lost_ns[f]
            if since is None:
                since = self._lost_ns[f] = last_ns
                self._then_rad[f], self._then_speed[f] = last_rad, self._speed
                self._then_alike[f] = (ALIKE * natural) ** _APART
            gone[f] = (t_ns - since) * 1e-9
            ahead = self._then_rad[f] + self._then_speed[f] * COAST_S * (1.0 - np.exp(-gone[f] / COAST_S))
            angles[f] = ahead[f]
            if f and len(others):
                alike = self._then_alike[f]
                told = alike[f - 1, others - 1]
                weight = np.asarray(np.linalg.solve(alike[np.ix_(others - 1, others - 1)], told), np.float64)
                angles[f, 1:] += weight @ (last_rad - ahead)[others, 1:]
                own[f] -= weight @ told
        sigma = np.sqrt(_HELD_RAD**2 + own * strayed_rad2(gone))
        return HiddenFingers(self._model.clamp(angles), sigma, gone, own)
