"""The keys of a hand: the thumb's tip touches a segment of a finger and leaves it again.

The four fingers side by side are a keypad, held so that the index finger lies on top and the tips at the left: the rows
are the fingers, the columns their segments, from the tip (docs/gestures.md). A touch is the thumb's that comes from
well away and goes away again; it is told when it goes, so that a hand that closes, pinches or rests its thumb tells
no key. The key is where the thumb was when it was nearest: the finger by the gap between skins, the segment by the
planes that halve the bends of the finger, which the thumb's tip passes half a segment, a centimetre, from the middle
of any key.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.gesture_actions import TapSettings
from common.hand_model import CHAINS
from common.messages import Gesture
from master.gestures.features import HandFeatures
from master.gestures.lasting import Lasting, below
from master.gestures.touch import ThumbTouch

KEYS = (("3", "2", "1"), ("6", "5", "4"), ("9", "8", "7"), ("hash", "0", "star"))
"""Name of the key on each segment, from the knuckle on, of index ... little."""

_PALMAR = -0.3  # cosine: a thumb that lies on the back of a segment touches no key
_ALIKE = 0.7  # of the doubt of two tips: part of it is the palm's, and moves both
_NEVER_NS = -(2**61)


@dataclass(slots=True)
class _Touch:
    """A touch that goes on: what it was like when the thumb was nearest, and how the fingers were bent before."""

    began_ns: int
    gap_m: float
    key: str
    middle_m: Float
    confidence: float
    bend_rad: float


class TapWatch:
    """Push machine. Holds the touch that goes on, when the thumb was clear of all keys last, and of the last tap."""

    def __init__(self, settings: TapSettings) -> None:
        self._settings = settings
        self._touch: _Touch | None = None
        self._clear_ns = self._tapped_ns = _NEVER_NS
        self._clear_rad = 0.0  # how the fingers were bent then

    @property
    def active(self) -> bool:
        """Whether the thumb touches a key, which may yet become a tap."""
        return self._touch is not None

    def push(self, seen: HandFeatures, touch: ThumbTouch, *, may_begin: bool) -> list[Gesture]:
        """What is to be told at the instant of the features; a touch begins only where it may."""
        own = self._settings
        gaps = touch.key_gap_m.min(axis=1)
        finger = int(np.argmin(gaps))
        gap = float(gaps[finger])
        known = max(seen.sigma_m[0], seen.sigma_m[finger + 1]) <= own.sigma_most_m
        if self._touch is not None:
            return self._go_on(self._touch, seen, touch, finger, gap, known=bool(known))
        if not known:
            return []
        if gap >= own.leave_gap_m:
            self._clear_ns, self._clear_rad = seen.t_ns, _bend_rad(seen)
        if gap > own.touch_gap_m or not may_begin or not self._begins(seen, touch, finger, gaps):
            return []
        self._touch = self._as_it_is(seen.t_ns, seen, touch, finger, self._clear_rad)
        return []

    def drop(self) -> None:
        """Forget the touch: the hand is gone, or does something else."""
        self._touch, self._clear_ns = None, _NEVER_NS

    def _go_on(
        self, going: _Touch, seen: HandFeatures, touch: ThumbTouch, finger: int, gap: float, *, known: bool
    ) -> list[Gesture]:
        """A touch goes on, ends as a tap, or was none."""
        own = self._settings
        lasted = (seen.t_ns - going.began_ns) * 1e-9
        closes = abs(_bend_rad(seen) - going.bend_rad) > own.quiet_rad
        closes = closes or gap < -own.pressed_m
        if lasted > own.longest_s or closes or not is_pad(seen, own):
            self.drop()
            return []
        if not known:
            return []
        if gap < going.gap_m:
            self._touch = self._as_it_is(going.began_ns, seen, touch, finger, going.bend_rad)
            return []
        if gap < min(own.leave_gap_m, max(going.gap_m + own.rise_m, own.touch_gap_m)):
            return []
        self._touch, self._clear_ns, self._clear_rad = None, seen.t_ns, _bend_rad(seen)
        if lasted < own.shortest_s:
            return []
        self._tapped_ns = seen.t_ns
        tap = Lasting(seen.hand, "tap", going.key, going.began_ns)
        return [tap.told("end", seen.t_ns, going.confidence, distance_m=going.gap_m, origin_m=going.middle_m)]

    def _begins(self, seen: HandFeatures, touch: ThumbTouch, finger: int, gaps: Float) -> bool:
        own = self._settings
        if (seen.t_ns - self._tapped_ns) * 1e-9 < own.apart_s:
            return False
        if (seen.t_ns - self._clear_ns) * 1e-9 > own.approach_s:
            return False
        if np.delete(gaps, finger).min() - gaps[finger] < own.nearer_m:
            return False
        segment = int(np.argmin(touch.key_gap_m[finger]))
        return bool(touch.key_palmar[finger, segment] > _PALMAR and is_pad(seen, own))

    def _as_it_is(
        self, began_ns: int, seen: HandFeatures, touch: ThumbTouch, finger: int, bend_rad: float
    ) -> _Touch:
        segment = segment_of(seen, finger + 1)
        gap = float(touch.key_gap_m[finger].min())
        sigma = _ALIKE * float(np.hypot(seen.sigma_m[0], seen.sigma_m[finger + 1]))
        chain = seen.joints_m[CHAINS[finger + 1]]
        middle = 0.5 * (0.5 * (chain[segment] + chain[segment + 1]) + seen.tips_m[0])
        return _Touch(
            began_ns,
            gap,
            KEYS[finger][segment],
            middle,
            below(gap, self._settings.leave_gap_m, sigma),
            bend_rad,
        )


def is_pad(seen: HandFeatures, settings: TapSettings) -> bool:
    """Whether the four fingers lie side by side, bent alike, and are no fist."""
    bend = seen.bend_rad[1:, :2].sum(axis=1)
    return bool(np.ptp(bend) <= settings.level_rad and seen.curl[1:].max() <= settings.curl_most)


def _bend_rad(seen: HandFeatures) -> float:
    """How far the four fingers are bent together [rad], MCP and PIP."""
    return float(seen.bend_rad[1:, :2].sum(axis=1).mean())


def segment_of(seen: HandFeatures, finger: int) -> int:
    """Which segment 0 ... 2, from the knuckle, of finger 1 ... 4 the thumb's tip is at."""
    chain = seen.joints_m[CHAINS[finger]]
    bone = np.diff(chain, axis=0)
    bone = bone / np.linalg.norm(bone, axis=1, keepdims=True)
    beyond = np.vecdot(seen.tips_m[0] - chain[1:3], bone[:-1] + bone[1:]) > 0.0
    return 2 if beyond[1] else int(beyond[0])
