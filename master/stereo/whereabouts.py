"""Where the markers are to be expected: by the hand that the others show, and by the past of each.

Asked only where a slave was in doubt. A marker's own past may be a mistake that repeats itself, so what the hand says
is made without the marker and believes nothing of the past, which only says where the search begins.
"""

import numpy as np

from common.arrays import Float, Int
from common.hand_model import HandModel
from master.fabrik.estimate import SolvedHand
from master.stereo.rivals import Belief

_PLACE_M = 0.01  # a cap is expected no better than this
_HAND_M = 0.015  # nor the place of a finger that others tell
_SPEED_M_S = 1.0  # standard deviation of a marker's speed
_TOGETHER_M = 0.1  # the markers of a hand lie about this far from its middle
_FORGET_S = 0.5  # what is older says nothing


class Past:
    """Push machine. Holds where and when each marker was last placed."""

    def __init__(self, markers: int) -> None:
        """Begin with nothing seen."""
        self._points = np.full((markers, 3), np.nan)
        self._t_ns: Int = np.full(markers, -(2**62), np.int64)

    def saw(self, t_ns: int, points: Float) -> None:
        """Remember points (M, 3) [m] of one instant; NaN: not placed."""
        found = np.isfinite(points[:, 0])
        self._points[found] = points[found]
        self._t_ns[found] = t_ns

    def at(self, t_ns: int) -> Belief:
        """Where the markers are at `t_ns` if they moved on like a hand."""
        age_s: Float = (t_ns - self._t_ns).astype(np.float64) * 1e-9
        points = np.where((age_s <= _FORGET_S)[:, None], self._points, np.nan)
        spread_m = _PLACE_M + _SPEED_M_S * age_s
        return Belief(points, spread_m[:, None, None] ** 2 * np.eye(3))


class HandBelief:
    """Where a hand has its markers. Holds no state between calls."""

    def __init__(self, model: HandModel, markers: tuple[str, ...], on_hand: Int) -> None:
        """Of all markers of the rig, those `on_hand` (H,) are mounted on the hand."""
        self._model, self._count, self._on_hand = model, len(markers), on_hand
        self._names = tuple(markers[int(m)] for m in on_hand)
        joints = [model.mount(name).joint for name in self._names]
        self._joint = np.array([0 if joint is None else joint for joint in joints], np.int64)  # 0: the palm

    def __call__(self, hand: SolvedHand | None, clear: Float) -> Belief:
        """Beliefs about all markers of the rig; NaN for those on no hand.

        Args:
            hand: Solved from the markers that nobody doubts; None: they are too few.
            clear: Those markers (M, 3) [m]; NaN: the others.
        """
        points, cov = np.full((self._count, 3), np.nan), np.full((self._count, 3, 3), np.nan)
        others = clear[self._on_hand]
        others = others[np.isfinite(others[:, 0])]
        if hand is not None:
            points[self._on_hand] = self._model.marker_points(hand.joints, self._names)
            cov[self._on_hand] = hand.cov_m2[self._joint] + _HAND_M**2 * np.eye(3)
        elif len(others):
            points[self._on_hand] = np.median(others, axis=0)
            cov[self._on_hand] = _TOGETHER_M**2 * np.eye(3)
        return Belief(points, cov)
