"""Pinches of the thumb and one finger, pad to pad.

They have the distance of the skins and how firmly the fingers close.

A pinch begins when the gap falls below one threshold and ends above another, wider one. It is one finger's: the others
are well away from the thumb, or they are at least farther, and then the pads face each other as far as that is known
(the thumb over a fist lies on the backs of the fingers) and not all others are curled in. Where the others are away
no bend is asked for: the tips determine it, which are measured however the palm lies.

What decides is how sure the gap is, along the way from skin to skin; a thumb whose depth is doubtful may still be known
to meet a finger beside it. A gap that is not known neither begins nor ends a pinch: one that has begun goes on at the
gap that was known last, its confidence falling, until `lost_s` are over.
"""

from common.calibration.gesture_actions import PinchSettings
from common.hand.model import FINGERS
from common.messages import Gesture, Phase
from master.gestures.features import HandFeatures
from master.gestures.held_gesture import HeldGesture, below
from master.gestures.touch import ThumbTouch


class PinchMonitor:
    """Detector of pinches.

    Push machine. Holds the pinch that has begun, and when its gap was known last, and how wide it was.
    """

    def __init__(self, settings: PinchSettings) -> None:
        self._settings = settings
        self._pinch: HeldGesture | None = None
        self._finger, self._known_ns, self._gap_m = 0, 0, 0.0
        self._last: Gesture | None = None

    @property
    def active(self) -> bool:
        """Whether one has begun."""
        return self._pinch is not None

    def push(self, seen: HandFeatures, touch: ThumbTouch, *, may_begin: bool) -> list[Gesture]:
        """Return the messages at the epoch of the features.

        A pinch begins only where it may.
        """
        if self._pinch is None:
            finger = self._begins(seen, touch) if may_begin else None
            if finger is None:
                return []
            self._finger, self._known_ns = finger, seen.t_ns
            self._gap_m = float(touch.gap_m[finger])
            self._pinch = HeldGesture(seen.hand, "pinch", FINGERS[finger + 1], seen.t_ns)
            return [self._message(self._pinch, "begin", seen, touch)]
        if self._known(touch, self._finger):
            self._known_ns, self._gap_m = seen.t_ns, float(touch.gap_m[self._finger])
            if self._gap_m > self._settings.end_gap_m:
                return self._end(self._message(self._pinch, "end", seen, touch))
        elif (seen.t_ns - self._known_ns) * 1e-9 > self._settings.lost_s:
            return self._end(self._message(self._pinch, "end", seen, touch))
        return [self._message(self._pinch, "update", seen, touch)]

    def lost(self, t_ns: int) -> list[Gesture]:
        """Return the messages at an epoch at which there is no hand."""
        last = self._last
        if self._pinch is None or last is None or (t_ns - self._known_ns) * 1e-9 <= self._settings.lost_s:
            return []
        return self._end(
            self._pinch.message("end", t_ns, 0.0, distance_m=last.distance_m, strength=last.strength)
        )

    def _end(self, message: Gesture) -> list[Gesture]:
        self._pinch = self._last = None
        return [message]

    def _begins(self, seen: HandFeatures, touch: ThumbTouch) -> int | None:
        own = self._settings
        gaps: list[float] = touch.gap_m.tolist()
        gap = min(gaps)
        finger = gaps.index(gap)
        if gap > own.begin_gap_m or not self._known(touch, finger):
            return None
        others = [k for k in range(4) if k != finger]
        clear_m = min(gaps[k] for k in others) - gap
        if clear_m >= own.away_m:
            return finger
        opening_rad = float(touch.apart_rad[finger] + touch.apart_sigma_rad[finger])
        if clear_m < own.clear_m or opening_rad > own.apart_rad:
            return None
        return finger if min(float(seen.curl[1 + k]) for k in others) < own.fist_curl else None

    def _known(self, touch: ThumbTouch, finger: int) -> bool:
        return bool(touch.key_sigma_m[finger, 2] <= self._settings.sigma_most_m)

    def _message(self, pinch: HeldGesture, phase: Phase, seen: HandFeatures, touch: ThumbTouch) -> Gesture:
        own, gap = self._settings, self._gap_m
        sigma = float(touch.key_sigma_m[self._finger, 2])
        strength = (own.open_gap_m - gap) / (own.open_gap_m - own.closed_gap_m)
        self._last = pinch.message(
            phase,
            seen.t_ns,
            below(gap, own.end_gap_m, sigma),
            distance_m=gap,
            strength=min(max(strength, 0.0), 1.0),
            origin_m=touch.middle_m[self._finger],
        )
        return self._last
