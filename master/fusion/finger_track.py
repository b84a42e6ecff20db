"""Fingers by a wrist device between its triples: what it said last, led on to the instant of a pose.

A device says how fingers are bent some thirty times a second, marker cameras ask twice or three times as often, and a
little later than the last triple. Between two triples a finger is on the line between its angles; after the last one it
goes on at the speed between the last two, which is as doubtful as it is fast (and none where one of the two was told
from the laser alone and the other from laser and tip: that is no motion):

    sigma(ahead) = (WALK + SHARE |speed|) ahead

What a triple says changes with the wrist's bend, for all fingers at once; how, is told along (`by_bend`).
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Bool, Code, Float
from common.messages import Level
from master.wrist.fingers import SeenFingers

REACH_NS = 70_000_000  # two triples at 30 Hz: a finger that was told longer ago is not seen now
_WALK_RAD_S, _SHARE = 0.7, 0.5
_FASTEST_RAD_S = 10.0
_LEAST = 1e-2  # [1/rad^2] an angle that may be anywhere
_STILL_S = 0.1  # a speed is taken over no longer than this


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFingers:
    """Fingers at one instant; all but the time and the bend as of `master.ik.sensed_hand.SensedHand`.

    Attributes:
        t_ns: The instant.
        bend_rad: (2,) the bend of the wrist at which these are the angles.
    """

    t_ns: int
    angles_rad: Float
    own_cov_rad2: Float
    told: Bool
    level: Code
    by_bend: Float
    bend_rad: Float


class FingerTrack:
    """Push machine. Holds what the last few triples said."""

    def __init__(self, habits: Float) -> None:
        """Begin without any.

        Args:
            habits: (5, 4, 4) [1/rad^2] that laser points alone were completed with, which the fit knows itself.
        """
        self._habits = habits
        self._said: deque[TrackedFingers] = deque(maxlen=4)

    def push(self, seen: SeenFingers, bend_rad: Float) -> None:
        """Take what a triple says, at that bend of the wrist (2,)."""
        if self._said and seen.t_ns <= self._said[-1].t_ns:
            self._said.clear()
        found = seen.found
        known = np.isfinite(found.angles_rad[:, 0]) & ~found.off
        cov = np.where(known[:, None, None], found.cov_rad2, np.eye(4))
        by_habit = known & (found.level == Level.FK)
        information = np.linalg.inv(cov) - np.where(by_habit[:, None, None], self._habits, 0.0)
        self._said.append(
            TrackedFingers(
                seen.t_ns,
                np.where(known[:, None], found.angles_rad, np.nan),
                np.asarray(np.linalg.inv(_positive(information)), np.float64),
                found.told & known,
                found.level,
                np.where(known[:, None, None], seen.by_bend, 0.0),
                bend_rad,
            )
        )

    def at(self, t_ns: int) -> TrackedFingers | None:
        """The fingers at an instant; None: no triple is near enough."""
        near = [said for said in self._said if abs(said.t_ns - t_ns) <= REACH_NS]
        before = [said for said in near if said.t_ns <= t_ns]
        after = [said for said in near if said.t_ns > t_ns]
        if not near:
            return None
        one = before[-1] if before else after[0]
        other = after[0] if before and after else self._previous(one)
        angles, cov, ahead_s = one.angles_rad, one.own_cov_rad2, 1e-9 * (t_ns - one.t_ns)
        speed = np.zeros((5, 4))
        if other is not None:
            between_s = 1e-9 * (other.t_ns - one.t_ns)
            both = (
                np.isfinite(angles[:, 0]) & np.isfinite(other.angles_rad[:, 0]) & (one.level == other.level)
            )
            speed = np.where(both[:, None], (other.angles_rad - angles) / between_s, 0.0)
            speed = np.clip(speed, -_FASTEST_RAD_S, _FASTEST_RAD_S)
            angles = angles + speed * ahead_s
            if before and after:
                share = np.where(both, ahead_s / between_s, 0.0)[:, None, None]
                cov = (1.0 - share) * cov + share * other.own_cov_rad2
                ahead_s = min(ahead_s, between_s - ahead_s)
        strays = (_WALK_RAD_S + _SHARE * np.abs(speed)) * abs(ahead_s)
        cov = cov + strays[..., None] ** 2 * np.eye(4)
        return replace(one, t_ns=t_ns, angles_rad=angles, own_cov_rad2=cov)

    def _previous(self, one: TrackedFingers) -> TrackedFingers | None:
        """What was said before `one`, near enough to tell a speed."""
        earlier = [said for said in self._said if said.t_ns < one.t_ns]
        if not earlier or 1e-9 * (one.t_ns - earlier[-1].t_ns) > _STILL_S:
            return None
        return earlier[-1]


def _positive(information: Float) -> Float:
    """Symmetric matrices (5, 4, 4) with no direction in which less than nothing is known."""
    value, axes = np.linalg.eigh(0.5 * (information + np.swapaxes(information, 1, 2)))
    return (axes * np.maximum(value, _LEAST)[:, None]) @ np.swapaxes(axes, 1, 2)
