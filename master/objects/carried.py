"""Detection of a hand that carries an object, by how both move.

It works also for a hand whose fingers nobody sees.

Whoever holds a thing hides from the cameras the fingers that hold it. But what is held moves as the palm does. Over
some tenths of a second an object's motion foretells where the palm gets to if it is fixed to it; if that is a way long
enough to be no noise, and the palm, which is near, went it, then the object is carried. It stays so at rest, until the
palm has moved about the object, or fingers are seen to be away from it.

A hand that pushes an object along with the palm looks the same.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry.transforms import invert, transform

SPAN_S = 0.35  # over which motions are compared


@dataclass(frozen=True, slots=True, eq=False)
class _Moment:
    """An object and the palm at one time.

    A time [ns], `T_rig_object` (4, 4), the palm (3,) [m], rig frame.
    """

    t_ns: int
    T: Float
    palm_m: Float


class Carried:
    """Detector of one hand that carries one object.

    Push machine. Holds their last places, and where the palm is on what it carries.
    """

    def __init__(self) -> None:
        """Begin with a hand that carries nothing."""
        self._moments: deque[_Moment] = deque()
        self._at_m: Float | None = None

    def push(self, t_ns: int, T_rig_object: Float, palm_m: Float, distance_m: float, away: bool) -> bool:
        """Whether the object is carried.

        Args:
            t_ns: The epoch; it rises.
            T_rig_object: Where the object is (4, 4).
            palm_m: The palm (3,), rig frame; NaN: not known.
            distance_m: Between palm and object.
            away: The fingers are seen not to touch it.
        """
        if np.isnan(palm_m).any() or np.isnan(distance_m):
            return self._at_m is not None and not away
        gap_s = 0.1
        if self._moments and t_ns - self._moments[-1].t_ns > gap_s * 1e9:
            self._moments.clear()
        self._moments.append(_Moment(t_ns, T_rig_object, palm_m))
        while t_ns - self._moments[0].t_ns > SPAN_S * 1e9:
            self._moments.popleft()
        at_m = transform(invert(T_rig_object), palm_m)
        near_m = 0.05  # between palm and object, at most
        if away or distance_m > near_m:
            self._at_m = None
            self._moments.clear()
        elif self._goes_along():
            self._at_m = at_m
        elif self._at_m is not None:
            off = at_m - self._at_m
            left_m = 0.03  # by which the palm moves about the object before it has left it
            slow = 0.02  # share by which what is remembered of the palm's place follows it, in each pose
            self._at_m = None if float(off @ off) > left_m**2 else self._at_m + slow * off
        return self._at_m is not None

    def forget(self) -> None:
        """The object is lost: nobody knows."""
        self._at_m = None
        self._moments.clear()

    def _goes_along(self) -> bool:
        first, last = self._moments[0], self._moments[-1]
        if last.t_ns - first.t_ns < 0.5 * SPAN_S * 1e9:
            return False
        to = transform(last.T @ invert(first.T), first.palm_m)
        way = float(np.linalg.norm(to - first.palm_m))
        way_m = 0.015  # of the palm, at least: by that much it would move with the object
        alike = 0.5  # by which share of that way the palm may miss
        return way > way_m and float(np.linalg.norm(last.palm_m - to)) < alike * way
