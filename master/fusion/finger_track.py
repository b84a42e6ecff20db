"""Fingers by a wrist device between its triples: what it said last, led on to the instant of a pose.

A device says how fingers are bent some thirty times a second, marker cameras ask twice or three times as often, and a
little later than the last triple. Between two triples a finger is on the line between its angles; after the last one it
goes on at the speed between the last two, which is as doubtful as it is fast (and none where one of the two was told
from the laser alone and the other from laser and tip: that is no motion):

    sigma(ahead) = (WALK + SHARE |speed|) ahead

What sights tell of angles and bend (`master.wrist.bend_slope`) is worth less by that, and by FLESH, what no hand file
knows of hinges and skin. With Q the information of the sights about angles a' and bend b, and S the covariance of a
about a', that of a and b is what is left when a' is integrated out.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Bool, Code, Float
from master.wrist.bend_slope import SightWorth
from master.wrist.fingers import SeenFingers

REACH_NS = 70_000_000  # two triples at 30 Hz: a finger that was told longer ago is not seen now
_OWN_NS = 17_000_000  # half of the time from triple to triple
_WALK_RAD_S, _SHARE = 0.7, 0.5
_FASTEST_RAD_S = 10.0
_FLESH_RAD = np.radians(2.5)
_STILL_S = 0.1  # a speed is taken over no longer than this


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFingers:
    """Fingers at one instant; angles and worth as of `master.fusion.sensed_hand.SensedHand`.

    Attributes:
        t_ns: The instant.
        angles_rad: (5, 4); NaN: nothing is known.
        strays_rad2: (5, 4, 4) covariance of the angles beside what sights tell.
        worth: What these tell, of angles as they were at their own instant.
        told, level: (5,).
        by_bend: (5, 4, 2).
        bend_rad: (2,) the bend of the wrist at which these are the angles.
    """

    t_ns: int
    angles_rad: Float
    strays_rad2: Float
    worth: SightWorth
    told: Bool
    level: Code
    by_bend: Float
    bend_rad: Float

    def left(self) -> SightWorth:
        """What the sights tell of the angles at this instant, and of the bend."""
        sure = np.linalg.inv(self.strays_rad2)
        both = np.linalg.inv(self.worth.angles + sure)
        crossed = sure @ both @ self.worth.with_bend
        bend = self.worth.bend - np.swapaxes(self.worth.with_bend, 1, 2) @ both @ self.worth.with_bend
        return SightWorth(sure - sure @ both @ sure, crossed, bend)


class FingerTrack:
    """Push machine. Holds what the last few triples said."""

    def __init__(self, *, continuous: bool = True) -> None:
        """Begin without any; where instants are unrelated poses a finger is as the one triple says that is its own."""
        self._continuous = continuous
        self._said: deque[TrackedFingers] = deque(maxlen=4)

    def push(self, seen: SeenFingers, bend_rad: Float) -> None:
        """Take what a triple says, at that bend of the wrist (2,)."""
        if self._said and seen.t_ns <= self._said[-1].t_ns:
            self._said.clear()
        found, worth = seen.found, seen.worth
        known = np.isfinite(found.angles_rad[:, 0]) & ~found.off
        # Of two poses that explain as much the whole doubt counts, of one past the branch what is left of it.
        wide = known & (found.ambiguous | found.past)
        strays = np.where(wide[:, None, None], found.cov_rad2, _FLESH_RAD**2 * np.eye(4))
        kept = known[:, None, None]
        self._said.append(
            TrackedFingers(
                seen.t_ns,
                np.where(known[:, None], found.angles_rad, np.nan),
                strays,
                SightWorth(
                    np.where(kept, worth.angles, 0.0),
                    np.where(kept, worth.with_bend, 0.0),
                    np.where(kept, worth.bend, 0.0),
                ),
                found.told & known,
                found.level,
                np.where(kept, seen.by_bend, 0.0),
                bend_rad,
            )
        )

    def at(self, t_ns: int) -> TrackedFingers | None:
        """The fingers at an instant; None: no triple is near enough."""
        if not self._continuous:
            own = min(self._said, key=lambda said: abs(said.t_ns - t_ns), default=None)
            return None if own is None or abs(own.t_ns - t_ns) > _OWN_NS else replace(own, t_ns=t_ns)
        near = [said for said in self._said if abs(said.t_ns - t_ns) <= REACH_NS]
        before = [said for said in near if said.t_ns <= t_ns]
        after = [said for said in near if said.t_ns > t_ns]
        if not near:
            return None
        one = before[-1] if before else after[0]
        other = after[0] if before and after else self._previous(one)
        angles, ahead_s = one.angles_rad, 1e-9 * (t_ns - one.t_ns)
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
                ahead_s = min(ahead_s, between_s - ahead_s)
        strays = (_WALK_RAD_S + _SHARE * np.abs(speed)) * abs(ahead_s)
        moved = one.strays_rad2 + strays[..., None] ** 2 * np.eye(4)
        return replace(one, t_ns=t_ns, angles_rad=angles, strays_rad2=moved)

    def _previous(self, one: TrackedFingers) -> TrackedFingers | None:
        """What was said before `one`, near enough to tell a speed."""
        earlier = [said for said in self._said if said.t_ns < one.t_ns]
        if not earlier or 1e-9 * (one.t_ns - earlier[-1].t_ns) > _STILL_S:
            return None
        return earlier[-1]
