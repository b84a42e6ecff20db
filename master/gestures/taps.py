"""Taps of the thumb on the keys of a hand.

The thumb's tip touches a segment of a finger and leaves it again.

The four fingers side by side are a keypad, held so that the index finger lies on top and the tips at the left: the rows
are the fingers, the columns their segments, from the tip (docs/gestures.md). A touch is the thumb's that comes from
well away and leaves again; it is reported when it goes, so that a hand that closes, pinches or rests its thumb reports
no key. The finger is that of least gap between skins, the segment is given by the planes that halve the bends of
the finger, which the thumb's tip passes half a segment, a centimetre, from the middle of any key.

Both are judged over the whole touch, from when the thumb is down until it has gone, each epoch by how sure the
thumb's tip is in it: a finger that it touches hides part of its cap, so that it is known worst while it is down, and
best as it leaves. Fingers too alike in their gaps decide nothing, nor do gaps that are not known, nor a finger
whose tip is seen while its bones may be anywhere, as those of a palm that one pair of cameras looks into.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from common.arrays import Float
from common.calibration.gesture_actions import TapSettings
from common.hand.model import CHAINS, TIPS
from common.messages import Gesture
from master.estimator.matrices import spread
from master.gestures.features import HandFeatures
from master.gestures.held_gesture import HeldGesture, below
from master.gestures.touch import ThumbTouch

KEYS = (("3", "2", "1"), ("6", "5", "4"), ("9", "8", "7"), ("hash", "0", "star"))
"""Name of the key on each segment, from the knuckle on, of index ... little."""

_NEVER_NS = -(2**61)


class _Epoch(NamedTuple):
    """The thumb at one epoch of a touch.

    Attributes:
        gap_m: (4,) to index ... little.
        sigma_m: Of the least of them.
        thumb_sigma_m: Of the thumb's tip.
        joints_m: (26, 3), rig frame.
    """

    gap_m: list[float]
    sigma_m: float
    thumb_sigma_m: float
    joints_m: Float


@dataclass(slots=True)
class _Touch:
    """A touch in progress.

    Holds since when, the flexion of the fingers before, the least gap, and all epochs of the touch, of which there
    are no more than `longest_s` has.
    """

    began_ns: int
    bend_rad: float
    least_m: float
    epochs: list[_Epoch]


class ThumbTapMonitor:
    """Detector of thumb taps.

    Push machine. Holds the touch that goes on, when the thumb was clear of all keys last, and the last tap.
    """

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
        """Return the messages at the epoch of the features.

        A touch begins only where it may.
        """
        own = self._settings
        keys: list[list[float]] = touch.key_gap_m.tolist()
        gaps = [min(one) for one in keys]
        gap = min(gaps)
        finger = gaps.index(gap)
        segment = keys[finger].index(gap)
        sigma = float(touch.key_sigma_m[finger, segment])
        # Of the finger its PIP must be known, too, along its worst axis.
        known = sigma <= own.sigma_most_m and _worst_m(seen, CHAINS[finger + 1, 1]) <= own.place_sigma_m
        now = _Epoch(gaps, sigma, float(seen.sigma_m[0]), seen.joints_m)
        if self._touch is not None:
            return self._go_on(self._touch, seen, now, known=known)
        if not known:
            return []
        if gap >= own.leave_gap_m:
            self._clear_ns, self._clear_rad = seen.t_ns, _bend_rad(seen)
        # cosine: a thumb that lies on the back of a segment touches no key
        palmar = bool(touch.key_palmar[finger, segment] > (-0.3))
        if gap <= own.touch_gap_m and may_begin and palmar and self._begins(seen):
            self._touch = _Touch(seen.t_ns, self._clear_rad, gap, [now])
        return []

    def drop(self) -> None:
        """Forget the touch: the hand is gone, or does something else."""
        self._touch, self._clear_ns = None, _NEVER_NS

    def _go_on(self, going: _Touch, seen: HandFeatures, now: _Epoch, *, known: bool) -> list[Gesture]:
        """A touch goes on, ends as a tap, or was none."""
        own, gap = self._settings, min(now.gap_m)
        lasted = (seen.t_ns - going.began_ns) * 1e-9
        closes = abs(_bend_rad(seen) - going.bend_rad) > own.quiet_rad
        if lasted > own.longest_s or closes or (known and gap < -own.pressed_m) or not is_pad(seen, own):
            self.drop()
            return []
        if not known:
            return []
        going.epochs.append(now)
        going.least_m = min(going.least_m, gap)
        if gap < min(own.leave_gap_m, max(going.least_m + own.rise_m, own.touch_gap_m)):
            return []
        self._touch, self._clear_ns, self._clear_rad = None, seen.t_ns, _bend_rad(seen)
        if lasted < own.shortest_s or going.least_m > own.down_gap_m:
            return []
        return self._tapped(going, seen)

    def _begins(self, seen: HandFeatures) -> bool:
        own = self._settings
        apart = (seen.t_ns - self._tapped_ns) * 1e-9 >= own.apart_s
        return apart and (seen.t_ns - self._clear_ns) * 1e-9 <= own.approach_s and is_pad(seen, own)

    def _tapped(self, gone: _Touch, seen: HandFeatures) -> list[Gesture]:
        """Return the tap of a touch that is over.

        It is nothing where two fingers may have been touched.
        """
        least = [min(one.gap_m) for one in gone.epochs]
        down_m = 0.001  # a thumb whose gap is larger than the least by less is down
        down = next(k for k, gap in enumerate(least) if gap <= gone.least_m + down_m)
        flight, nearest = gone.epochs[down:], gone.epochs[int(np.argmin(least))]
        weight = np.array([1.0 / max(one.thumb_sigma_m, 1e-4) ** 2 for one in flight])
        weight = weight / weight.sum()
        gap = weight @ np.array([one.gap_m for one in flight])
        finger = int(gap.argmin())
        nearer_m = float(np.delete(gap, finger).min() - gap[finger])
        if nearer_m < self._settings.nearer_m:
            return []
        beyond = weight @ _beyond_m(np.array([one.joints_m for one in flight]), finger)
        segment = 2 if beyond[1] > 0.0 else int(beyond[0] > 0.0)
        sigma = nearest.sigma_m
        sure = below(gone.least_m, self._settings.leave_gap_m, sigma) * below(0.0, nearer_m, sigma)
        sure *= below(0.0, float(np.abs(beyond).min()), sigma)
        self._tapped_ns = seen.t_ns
        tap = HeldGesture(seen.hand, "tap", KEYS[finger][segment], gone.began_ns)
        ends = CHAINS[finger + 1, segment : segment + 2]
        middle = 0.5 * (nearest.joints_m[ends].mean(axis=0) + nearest.joints_m[TIPS[0]])
        return [tap.message("end", seen.t_ns, sure, distance_m=gone.least_m, origin_m=middle)]


def is_pad(seen: HandFeatures, settings: TapSettings) -> bool:
    """Whether the four fingers lie side by side, bent alike, and are no fist."""
    bend, curl = _finger_bends(seen), seen.curl.tolist()
    return max(bend) - min(bend) <= settings.level_rad and max(curl[1:]) <= settings.curl_most


def _finger_bends(seen: HandFeatures) -> list[float]:
    """How far each of the four fingers is bent [rad], MCP and PIP together."""
    bends: list[list[float]] = seen.bend_rad.tolist()
    return [mcp + pip for mcp, pip, _ in bends[1:]]


def _bend_rad(seen: HandFeatures) -> float:
    """How far the four fingers are bent together [rad]."""
    return sum(_finger_bends(seen)) / 4.0


def _worst_m(seen: HandFeatures, joint: int) -> float:
    """Standard deviation [m] of a joint along its worst axis."""
    return spread(seen.joints_cov_m2[joint])[1]


def _beyond_m(joints_m: Float, finger: int) -> Float:
    """How far (N, 2) [m] the thumb's tip is beyond PIP and DIP of a finger.

    Beyond the planes that halve its bends there.

    Of hands (N, 26, 3) [m] and a finger 0 ... 3.
    """
    chain = joints_m[:, CHAINS[finger + 1]]
    bone = np.diff(chain, axis=1)
    bone = bone / np.linalg.norm(bone, axis=2, keepdims=True)
    tip = joints_m[:, TIPS[0], None]
    return np.vecdot(tip - chain[:, 1:3], bone[:, :-1] + bone[:, 1:]) * 0.5
