"""Pinch, pointing and thumb taps are actions that a hand performs.

Pinch: begins when the gap between the skins of thumb and finger falls below one threshold and ends above another,
wider one. It is one finger's: the others are well away from the thumb, or they are at least farther, and then the
pads face each other as far as that is known (the thumb over a fist lies on the backs of the fingers) and not all
others are curled in. What decides is how sure the gap is, along the way from skin to skin. A gap that is not known
neither begins nor ends a pinch: one that has begun goes on at the last known gap, its confidence falling, until
`lost_s` are over.

Pointing: index finger extended, the three after it flexed. The ray goes from the knuckle through the tip and begins
at the tip. Both ends are what a hand is fitted to best, and they are far apart: the same millimetre turns this line
by a third of what it turns the last bone, whose direction is prior more than measurement (the DIP follows the PIP). A
ray that may be off by more than a few degrees is withheld: before one pair of cameras, a palm that faces them is
known by its fingertips alone, and knuckles stand anywhere within some centimetres. It must be sure twice in a row
when the pointing begins; one that is not for a moment later stays as it was. Nothing is smoothed: the markers are
already.

Tap: the thumb's tip touches a segment of a finger and leaves it again. Four fingers side by side are a keypad: the
rows are the fingers, the columns their segments, from the tip (docs/gestures.md). A touch comes from well away and is
reported when it goes, so that a hand that closes, pinches or rests its thumb reports no key. The finger is that of
least gap between skins, the segment is given by the planes that halve the bends of the finger. Both are judged over
the whole touch, each epoch by how sure the thumb's tip is in it: a finger that it touches hides part of its cap.
Fingers too alike in their gaps decide nothing, nor do gaps that are not known, nor a finger whose tip is seen while
its bones may be anywhere, as those of a palm that one pair of cameras looks into.
"""

from dataclasses import dataclass
from math import erf, isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration.gesture_settings import PinchSettings, PointSettings, TapSettings
from common.hand.model import CHAINS, FINGERS, TIPS
from common.kernels import constant, kernel
from common.messages import Gesture, Phase
from master.fabrik.linear_algebra import length, minus, spread
from master.gestures.features import HandFeatures, ThumbTouch, point_at

_NOWHERE = np.full(3, np.nan)


class ActionMonitor:
    """Base of the detectors of actions; holds the last message of a gesture."""

    def __init__(self) -> None:
        self._last: Gesture | None = None

    @property
    def active(self) -> bool:
        """Whether one has begun."""
        return self._last is not None

    def _send(
        self, of: Gesture, phase: Phase, t_ns: int, confidence: float, **quantities: Any
    ) -> list[Gesture]:
        """Return the message of an epoch about a gesture; hold it until the end."""
        confidence = min(max(confidence, 0.0), 1.0)
        message = replace(of, phase=phase, t_ns=t_ns, confidence=confidence, **quantities)
        self._last = None if phase == "end" else message
        return [message]


def below(value: float, limit: float, sigma: float) -> float:
    """Probability that a quantity measured as `value` is below the limit."""
    if not isfinite(sigma):
        return 0.5
    return 0.5 * (1.0 + erf((limit - value) / (max(sigma, 1e-6) * sqrt(2.0))))


class PinchMonitor(ActionMonitor):
    """Detector of pinches; holds the last known gap and time of the begun one."""

    def __init__(self, settings: PinchSettings) -> None:
        super().__init__()
        self._settings = settings
        self._finger, self._known_ns, self._gap_m = 0, 0, 0.0

    def push(self, seen: HandFeatures, touch: ThumbTouch, *, may_begin: bool) -> list[Gesture]:
        """Return the messages at an epoch; a pinch begins only where it may."""
        pinch, t_ns = self._last, seen.t_ns
        phase: Phase = "update"
        if pinch is None:
            finger = self._begins(seen, touch) if may_begin else None
            if finger is None:
                return []
            self._finger, phase = finger, "begin"
            pinch = Gesture(seen.hand, t_ns, "pinch", FINGERS[finger + 1], phase, t_ns, 1.0)
        if phase == "begin" or self._known(touch, self._finger):
            self._known_ns, self._gap_m = t_ns, float(touch.gap_m[self._finger])
            if phase == "update" and self._gap_m > self._settings.end_gap_m:
                phase = "end"
        elif self._lost(t_ns):
            phase = "end"
        own, gap = self._settings, self._gap_m
        strength = (own.open_gap_m - gap) / (own.open_gap_m - own.closed_gap_m)
        return self._send(
            pinch,
            phase,
            t_ns,
            below(gap, own.end_gap_m, float(touch.key_sigma_m[self._finger, 2])),
            distance_m=gap,
            strength=min(max(strength, 0.0), 1.0),
            origin_m=touch.middle_m[self._finger],
        )

    def lost(self, t_ns: int) -> list[Gesture]:
        """Return the messages at an epoch at which there is no hand."""
        if self._last is None or not self._lost(t_ns):
            return []
        return self._send(self._last, "end", t_ns, 0.0, origin_m=_NOWHERE)

    def _lost(self, t_ns: int) -> bool:
        return (t_ns - self._known_ns) * 1e-9 > self._settings.lost_s

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
        opening_rad = float(touch.opening_rad[finger] + touch.opening_sigma_rad[finger])
        if clear_m < own.clear_m or opening_rad > own.apart_rad:
            return None
        return finger if min(float(seen.curl[1 + k]) for k in others) < own.fist_curl else None

    def _known(self, touch: ThumbTouch, finger: int) -> bool:
        return bool(touch.key_sigma_m[finger, 2] <= self._settings.sigma_most_m)


_KNUCKLE, _TIP = constant(CHAINS[1, 0]), constant(CHAINS[1, 3])


class PointMonitor(ActionMonitor):
    """Detector of pointing; holds since when its shape is there."""

    def __init__(self, settings: PointSettings) -> None:
        super().__init__()
        self._settings = settings
        self._since_ns: int | None = None  # of the shape before it begins; of its loss after
        self._sure = False  # whether the ray was

    def push(self, seen: HandFeatures, *, may_begin: bool) -> list[Gesture]:
        """Return the messages at an epoch; pointing begins only where it may."""
        own, point = self._settings, self._last
        shape, before = self._shape(seen), self._sure
        held = 1.5  # the standard deviation of a ray that is reported already may be larger by this
        most_rad = own.ray_sigma_rad * (1.0 if point is None else held)
        self._sure = _ray_sigma_rad(seen.joints_m, seen.joints_cov_m2) <= most_rad
        if point is None:
            if not (shape and may_begin):
                self._since_ns = None
                return []
            if self._since_ns is None:
                self._since_ns = seen.t_ns
            if (seen.t_ns - self._since_ns) * 1e-9 < own.hold_s or not (self._sure and before):
                return []
            point = Gesture(seen.hand, seen.t_ns, "point", "point", "begin", self._since_ns, 1.0)
            self._since_ns = None
            return self._ray(point, "begin", seen)
        if shape and self._sure:
            self._since_ns = None
        elif self._over(seen.t_ns):
            return self._ray(point, "end", seen)
        return self._ray(point, "update", seen)

    def lost(self, t_ns: int) -> list[Gesture]:
        """Return the messages at an epoch at which there is no hand."""
        if self._last is None or not self._over(t_ns):
            return []
        self._since_ns = None
        return self._send(self._last, "end", t_ns, 0.0)

    def _over(self, t_ns: int) -> bool:
        """Whether the shape has been lost for long, counted from the first call."""
        if self._since_ns is None:
            self._since_ns = t_ns
        return (t_ns - self._since_ns) * 1e-9 >= self._settings.hold_s

    def _shape(self, seen: HandFeatures) -> bool:
        """Whether the index finger is extended and the others flexed, as far as known."""
        own, going = self._settings, self.active
        slack = own.slack_rad if going else 0.0
        sigma: list[float] = seen.sigma_m.tolist()
        known = [one <= own.sigma_most_m for one in sigma]
        _, index, *others = _bends(seen)
        if not known[1] and not going:
            return False
        bent = all(
            bend >= own.bent_rad - slack or (going and not sure)
            for bend, sure in zip(others, known[2:], strict=True)
        )
        return bent and (index <= own.stretched_rad + slack or not known[1])

    def _ray(self, point: Gesture, phase: Phase, seen: HandFeatures) -> list[Gesture]:
        """Return the message with the ray of an epoch, as it was where it is not sure."""
        tip = seen.joints_m[_TIP]
        way = tip - seen.joints_m[_KNUCKLE] if self._sure else point.direction
        if phase == "end":
            self._since_ns = None
        middle = 0.5 * (self._settings.stretched_rad + self._settings.bent_rad)
        clear = [min(max((bend - middle) / middle, 0.0), 1.0) for bend in _bends(seen)[2:]]
        known = 1.0 if seen.sigma_m[1] <= self._settings.sigma_most_m else 0.5
        confidence = known * sum(clear) / len(clear)
        return self._send(point, phase, seen.t_ns, confidence, origin_m=tip, direction=way / sqrt(way @ way))


def _bends(seen: HandFeatures) -> list[float]:
    """How far each finger is bent beyond its knuckle (5,) [rad]."""
    bends: list[list[float]] = seen.bend_rad.tolist()
    return [pip + dip for _, pip, dip in bends]


@kernel
def _ray_sigma_rad(joints: Float, cov: Float) -> float:
    """Standard deviation [rad] of the ray, about its worst axis.

    What is across the ray of both ends' covariance counts: P C P with P = I - w w'.
    """
    way = minus(point_at(joints, _TIP), point_at(joints, _KNUCKLE))
    far = length(way)
    w = way[0] / far, way[1] / far, way[2] / far
    both, along, total = np.empty((3, 3)), np.zeros(3), 0.0
    for i in range(3):
        for k in range(3):
            both[i, k] = cov[_TIP, i, k] + cov[_KNUCKLE, i, k]
            along[i] += both[i, k] * w[k]
        total += w[i] * along[i]
    for i in range(3):
        for k in range(3):
            both[i, k] += w[i] * w[k] * total - w[i] * along[k] - along[i] * w[k]
    return spread(both)[1] / far


# Name of the key on each segment, from the knuckle on, of index ... little.
KEYS = (("3", "2", "1"), ("6", "5", "4"), ("9", "8", "7"), ("hash", "0", "star"))

_NEVER_NS = -(2**61)


class _Epoch(NamedTuple):
    """The thumb at one epoch of a touch: gaps (4,), sigmas [m], joints (26, 3) [m]."""

    gap_m: list[float]
    sigma_m: float
    thumb_sigma_m: float
    joints_m: Float


@dataclass(slots=True)
class _Touch:
    """A touch in progress: begin, flexion before, least gap, epochs (of `longest_s`)."""

    began_ns: int
    bend_rad: float
    least_m: float
    epochs: list[_Epoch]


class ThumbTapMonitor:
    """Detector of thumb taps; holds the touch, the last clear epoch, the last tap."""

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
        """Return the messages at an epoch; a touch begins only where it may."""
        own = self._settings
        keys: list[list[float]] = touch.key_gap_m.tolist()
        gaps = [min(one) for one in keys]
        gap = min(gaps)
        finger = gaps.index(gap)
        segment = keys[finger].index(gap)
        sigma = float(touch.key_sigma_m[finger, segment])
        # Of the finger its PIP must be known, too, along its worst axis.
        known = (
            sigma <= own.sigma_most_m
            and spread(seen.joints_cov_m2[CHAINS[finger + 1, 1]])[1] <= own.place_sigma_m
        )
        now = _Epoch(gaps, sigma, float(seen.sigma_m[0]), seen.joints_m)
        if self._touch is not None:
            return self._go_on(self._touch, seen, now, known=known)
        if not known:
            return []
        if gap >= own.leave_gap_m:
            self._clear_ns, self._clear_rad = seen.t_ns, _bend_rad(seen)
        # cosine: a thumb that lies on the back of a segment touches no key
        palmar = bool(touch.key_palmar[finger, segment] > (-0.3))
        separate = (seen.t_ns - self._tapped_ns) * 1e-9 >= own.apart_s
        approached = (seen.t_ns - self._clear_ns) * 1e-9 <= own.approach_s
        near = gap <= own.touch_gap_m and may_begin and palmar
        if near and separate and approached and is_pad(seen, own):
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

    def _tapped(self, gone: _Touch, seen: HandFeatures) -> list[Gesture]:
        """The tap of a touch that is over; none where two fingers may have been touched."""
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
        ends = CHAINS[finger + 1, segment : segment + 2]
        middle = 0.5 * (nearest.joints_m[ends].mean(axis=0) + nearest.joints_m[TIPS[0]])
        key = KEYS[finger][segment]
        sure = min(max(sure, 0.0), 1.0)
        return [
            Gesture(
                seen.hand, seen.t_ns, "tap", key, "end", gone.began_ns, sure, gone.least_m, origin_m=middle
            )
        ]


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


def _beyond_m(joints_m: Float, finger: int) -> Float:
    """How far (N, 2) [m] the thumb's tip is beyond the planes that halve PIP and DIP.

    Of hands (N, 26, 3) [m] and a finger 0 ... 3.
    """
    chain = joints_m[:, CHAINS[finger + 1]]
    bone = np.diff(chain, axis=1)
    bone = bone / np.linalg.norm(bone, axis=2, keepdims=True)
    tip = joints_m[:, TIPS[0], None]
    return np.vecdot(tip - chain[:, 1:3], bone[:, :-1] + bone[:, 1:]) * 0.5
