"""Fingers by a wrist device between its triples: what it said last, led on to the instant of a pose.

A device says how fingers are bent some thirty times a second, marker cameras ask twice or three times as often, and a
little later than the last triple. Between two triples a finger is on the line between its angles; after the last one it
goes on at the speed between the last two, which is as doubtful as it is fast (and none where one of the two was told
from the laser alone and the other from laser and tip: that is no motion):

    sigma(ahead) = (WALK + SHARE |speed|) ahead

A doubt of the wrist's bend is a doubt of the angles: what a triple says changes with the bend by `by_bend`, for all
fingers alike, which each of them is told as if it were its own.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Code, Float
from common.messages import Level
from master.ik.finger_belief import FingerBelief
from master.wrist.fingers import SeenFingers

REACH_NS = 70_000_000  # two triples at 30 Hz: a finger that was told longer ago is not seen now
_WALK_RAD_S, _SHARE = 0.7, 0.5
_FASTEST_RAD_S = 10.0
_LEAST = 1e-2  # [1/rad^2] an angle that may be anywhere
_STILL_S = 0.1  # a speed is taken over no longer than this


@dataclass(frozen=True, slots=True, eq=False)
class _Said:
    """What one triple said: angles (5, 4), their covariances (5, 4, 4), who was told (5,), and from what (5,)."""

    t_ns: int
    angles_rad: Float
    cov_rad2: Float
    told: Bool
    level: Code


class FingerTrack:
    """Push machine. Holds what the last few triples said."""

    def __init__(self, habits: Float) -> None:
        """Begin without any.

        Args:
            habits: (5, 4, 4) [1/rad^2] that laser points alone were completed with, which the fit knows itself.
        """
        self._habits = habits
        self._said: deque[_Said] = deque(maxlen=4)

    def push(self, seen: SeenFingers, bend_cov_rad2: Float) -> None:
        """Take what a triple says, at a bend of the wrist with this covariance (2, 2) [rad^2]."""
        if self._said and seen.t_ns <= self._said[-1].t_ns:
            self._said.clear()
        found = seen.found
        known = np.isfinite(found.angles_rad[:, 0]) & ~found.off
        cov = np.where(known[:, None, None], found.cov_rad2, np.eye(4))
        by_habit = known & (found.level == Level.FK)
        information = np.linalg.inv(cov) - np.where(by_habit[:, None, None], self._habits, 0.0)
        cov = np.linalg.inv(_positive(information))
        cov = cov + seen.by_bend @ bend_cov_rad2 @ np.swapaxes(seen.by_bend, 1, 2)
        angles = np.where(known[:, None], found.angles_rad, np.nan)
        self._said.append(_Said(seen.t_ns, angles, cov, found.told & known, found.level))

    def at(self, t_ns: int) -> FingerBelief | None:
        """The fingers at an instant; None: no triple is near enough."""
        near = [said for said in self._said if abs(said.t_ns - t_ns) <= REACH_NS]
        if not near:
            return None
        before = [said for said in near if said.t_ns <= t_ns]
        after = [said for said in near if said.t_ns > t_ns]
        one = before[-1] if before else after[0]
        angles, cov, told = one.angles_rad.copy(), one.cov_rad2.copy(), one.told.copy()
        ahead_s = 1e-9 * (t_ns - one.t_ns)
        other = after[0] if before and after else self._previous(one)
        if other is not None:
            both = (
                np.isfinite(angles[:, 0]) & np.isfinite(other.angles_rad[:, 0]) & (one.level == other.level)
            )
            between_s = 1e-9 * (other.t_ns - one.t_ns)
            speed = np.where(both[:, None], (other.angles_rad - angles) / between_s, 0.0)
            speed = np.clip(speed, -_FASTEST_RAD_S, _FASTEST_RAD_S)
            angles = angles + speed * ahead_s
            if before and after:
                share = ahead_s / between_s
                cov[both] = (1.0 - share) * cov[both] + share * other.cov_rad2[both]
                ahead_s = min(ahead_s, between_s - ahead_s)
        else:
            speed = np.zeros((5, 4))
        strays = (_WALK_RAD_S + _SHARE * np.abs(speed)) * abs(ahead_s)
        cov = cov + strays[..., None] ** 2 * np.eye(4)
        known = np.isfinite(angles[:, 0])
        information = np.where(known[:, None, None], np.linalg.inv(cov), 0.0)
        return FingerBelief(angles, information, told & known, one.level)

    def _previous(self, one: _Said) -> _Said | None:
        """What was said before `one`, near enough to tell a speed."""
        earlier = [said for said in self._said if said.t_ns < one.t_ns]
        if not earlier or 1e-9 * (one.t_ns - earlier[-1].t_ns) > _STILL_S:
            return None
        return earlier[-1]


def _positive(information: Float) -> Float:
    """Symmetric matrices (5, 4, 4) with no direction in which less than nothing is known."""
    value, axes = np.linalg.eigh(0.5 * (information + np.swapaxes(information, 1, 2)))
    return (axes * np.maximum(value, _LEAST)[:, None]) @ np.swapaxes(axes, 1, 2)
