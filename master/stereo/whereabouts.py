"""Where each marker is to be expected, from the hand and from its own past; asked only where a slave was in doubt.

A marker on a hand that was just seen is expected where that hand has it: the hand is held by all its markers, so a
thing that one of them was once mistaken for does not become its past. Before there is a hand, its markers are expected
near each other. A marker on no hand is expected where it was.
"""

import numpy as np

from common.arrays import Bool, Float, Int
from master.stereo.rivals import Expected

_PLACE_M = 0.01  # a cap is expected no better than this
_SPEED_M_S = 1.0  # standard deviation of a hand's speed
_REACH_M = 0.1  # a finger's end is within about this of where its hand has it, and of the other markers
_FORGET_S = 0.5  # what is older says nothing


class Whereabouts:
    """Push machine. Holds where and when each marker was last placed."""

    def __init__(self, on_hand: Bool) -> None:
        """Begin with nothing seen; `on_hand` (M,) tells the markers of the hand from the others."""
        self._on_hand = on_hand
        self._points = np.full((len(on_hand), 3), np.nan)
        self._t_ns: Int = np.full(len(on_hand), -(2**62), np.int64)

    def saw(self, t_ns: int, points: Float) -> None:
        """Remember points (M, 3) [m] of one instant; NaN: not placed."""
        found = np.isfinite(points[:, 0])
        self._points[found] = points[found]
        self._t_ns[found] = t_ns

    def expected(self, t_ns: int, of_hand: Float | None, clear: Float) -> Expected:
        """Where the markers should be at `t_ns`.

        Args:
            t_ns: The instant.
            of_hand: (M, 3) [m] where the last hand has its markers; None: there is none.
            clear: (M, 3) [m] markers about which there is no doubt at this instant; NaN: the others.
        """
        age_s: Float = (t_ns - self._t_ns).astype(np.float64) * 1e-9
        points = np.where((age_s <= _FORGET_S)[:, None], self._points, np.nan)
        spread_m = _PLACE_M + _SPEED_M_S * age_s
        hand = self._on_hand
        if of_hand is not None and age_s[hand].min(initial=np.inf) <= _FORGET_S:
            points[hand], spread_m[hand] = of_hand[hand], np.minimum(spread_m[hand], _REACH_M)
            return Expected(points, spread_m)
        lost = hand & np.isnan(points[:, 0])
        others = clear[hand & np.isfinite(clear[:, 0])]
        if len(others):
            points[lost], spread_m[lost] = np.median(others, axis=0), _REACH_M
        return Expected(points, spread_m)
