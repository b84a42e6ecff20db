"""Recognise held poses of the hand, with hysteresis, and select its action.

The quantities (`common.calibration.gesture_settings.Quantity`) distinguish poses. A tip that is off by s turns the
finger's last two bones about the PIP, so that a bend is off by s over their length; that is the lever of all bends
here. What is measured of the thumb's tip is off as the tip is, gaps as both tips are. The part of a tip's covariance
that the palm's place has as well moves all tips alike, and is excluded.

Every pose defines which quantities are to lie in which range. It fits by

    s = exp(-1/2 sum z^2),   z = distance to the range / sqrt(border^2 + sigma^2)

with sigma the standard deviation of the quantity itself: a hidden finger is neutral. That alone would make a hand of
which little is known fit everything, so a pose is accepted as far as it stands out of the others,

    confidence = s . w s / (sum of all w s)

with w its weight (1 but for a special case of another pose), and only where most of its quantities are known. A hand
that fits nothing has no pose. A hand that goes from one pose to another may pass through a third, so a pose begins
where the fingers are nearly at rest, or once it has lasted a while; the end of a natural movement is slow, so that
this costs no time.

The hand's shape when an action begins decides which it is, and until it ends there is no other:

    thumb and one finger meet, that finger bent out of the row      pinch
    the thumb meets a finger of four that lie side by side          tap
    all tips about a circle, thumb across                           dial
    index finger stretched, the others bent                         point
"""

from collections import deque
from dataclasses import dataclass
from math import atan2, degrees, exp, hypot, inf, isfinite, sqrt
from typing import NamedTuple, get_args

import numpy as np

from common.arrays import Bool, Float
from common.calibration.gesture_settings import GestureSettings, HoldSettings, Quantity
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import CHAINS, FINGERS, MIDDLE_PROXIMAL, WRIST, HandModel
from common.kernels import constant, inner, kernel, log_if_slow
from common.messages import JOINT_COUNT, Gesture, HandPose, Phase, Source
from master.fabrik.linear_algebra import length, minus
from master.gestures.actions import PinchMonitor, PointMonitor, ThumbTapMonitor, is_pad
from master.gestures.dial import DialMonitor
from master.gestures.features import FeatureExtractor, HandFeatures, point_at, thumb_touch
from master.gestures.grip import rehearse

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
# MCP and PIP of a finger that hides, and of their sum the standard deviation.
_HIDDEN_DEG, _HIDDEN_SIGMA_DEG = (55.0, 75.0), 45.0
_COUNT = len(QUANTITIES)
_FROM, _TO = constant(WRIST), constant(MIDDLE_PROXIMAL)  # the length of the hand
_ALL = 21


@dataclass(frozen=True, slots=True, eq=False)
class Quantities:
    """Quantities (Q,) of a hand at one epoch, as `QUANTITIES`; sigma inf: not known."""

    value: Float
    sigma: Float

    @classmethod
    def of(cls, features: HandFeatures) -> "Quantities":
        """Those of one hand."""
        value, sigma = np.empty(_COUNT), np.empty(_COUNT)
        _write(
            features.joints_m,
            features.tips_m,
            features.radius_m,
            features.shape_sigma_m,
            features.bend_rad,
            features.seen,
            features.T_rig_palm,
            features.side_sign,
            value,
            sigma,
        )
        return cls(value, sigma)

    @property
    def known(self) -> Bool:
        """(Q,) which of them are known at all."""
        return np.isfinite(self.value) & np.isfinite(self.sigma)


@kernel
def _write(
    joints: Float,
    tips: Float,
    radius: Float,
    tip_sigma_m: Float,
    bend: Float,
    seen: Bool,
    T: Float,
    side: float,
    value: Float,
    sigma: Float,
) -> None:
    """Write values and standard deviations (Q,); arguments as of `HandFeatures`."""
    sigma_deg = np.empty(5)
    for f in range(5):
        pip, dip, tip = (
            point_at(joints, CHAINS[f, 1]),
            point_at(joints, CHAINS[f, 2]),
            point_at(joints, CHAINS[f, 3]),
        )
        lever = length(minus(dip, pip)) + length(minus(tip, dip))
        sigma_deg[f] = degrees(tip_sigma_m[f] / lever)
    size = length(minus(point_at(joints, _TO), point_at(joints, _FROM)))
    # Where they begin: index ... little, each MCP, PIP, both; and so on.
    thumb_bend, thumb_place, gaps, ahead, spreads = 12, 13, 16, 20, 22
    value[thumb_bend], sigma[thumb_bend] = degrees(bend[0, 1] + bend[0, 2]), sigma_deg[0]
    for i in range(3):
        place = 0.0
        for k in range(3):
            place += (tips[0, k] - T[k, 3]) * T[k, i]
        value[thumb_place + i] = place * (side if i == 0 else -1.0 if i == 1 else 1.0) / size
        sigma[thumb_place + i] = tip_sigma_m[0] / size
    others, others_2, every, sigma_sum = 0.0, 0.0, 0.0, 0.0
    for f in range(1, 5):
        weight, sigma_deg[f] = _hidden(sigma_deg[f], seen[f])
        both, column = 0.0, 3 * (f - 1)
        for k in range(2):
            own = degrees(bend[f, k])
            value[column + k] = own + weight * (_HIDDEN_DEG[k] - own)
            both += value[column + k]
        value[column + 2] = both
        for k in range(3):
            sigma[column + k] = sigma_deg[f]
        off = sqrt(
            (tips[f, 0] - tips[0, 0]) ** 2 + (tips[f, 1] - tips[0, 1]) ** 2 + (tips[f, 2] - tips[0, 2]) ** 2
        )
        value[gaps + f - 1] = 1e3 * (off - radius[f] - radius[0])
        sigma[gaps + f - 1] = 1e3 * hypot(tip_sigma_m[f], tip_sigma_m[0])
        every += both / 4.0
        sigma_sum += sigma_deg[f] / 4.0  # neighbours are wrong alike
        if f > 1:
            others += both / 3.0
            others_2 += sigma_deg[f] * sigma_deg[f]
    value[ahead], sigma[ahead] = value[2] - others, hypot(sigma_deg[1], sqrt(others_2) / 3.0)
    value[_ALL], sigma[_ALL] = every, sigma_sum
    before = 0.0
    for f in range(1, 5):
        heading = _heading(f, joints, T, side)
        if f > 1:
            value[spreads + f - 2] = before - heading
            sigma[spreads + f - 2] = hypot(sigma_deg[f - 1], sigma_deg[f])
        before = heading


@inner
def _hidden(sigma: float, seen: bool) -> tuple[float, float]:
    """How far a finger is taken for hidden, 0..1, and its sigma [deg].

    A straight finger is seldom hidden, neither from cameras nor from a device at the wrist; a bent one lies
    behind the hand or before the palm. That an unseen finger hides is fused with its prior, as one more
    observation.
    """
    if not isfinite(sigma):
        return (0.0, 0.0) if seen else (1.0, _HIDDEN_SIGMA_DEG)
    weight = 0.0 if seen else sigma * sigma / (sigma * sigma + _HIDDEN_SIGMA_DEG * _HIDDEN_SIGMA_DEG)
    return weight, sqrt(1.0 - weight) * sigma


@inner
def _heading(f: int, joints: Float, T: Float, side: float) -> float:
    """Heading [deg] of a finger's first bone in the palm's plane, thumb positive.

    Fingers that stand up from that plane have no heading in it: their angle fades with what is left.
    """
    x, y, z = 0.0, 0.0, 0.0
    for k in range(3):
        bone = joints[CHAINS[f, 1], k] - joints[CHAINS[f, 0], k]
        x, y, z = x + bone * T[k, 0], y + bone * T[k, 1], z + bone * T[k, 2]
    level = hypot(x, z) / sqrt(x * x + y * y + z * z)
    return degrees(side * atan2(x, z) * min(level / 0.6, 1.0))


def known_bends(features: HandFeatures) -> tuple[list[float], list[bool]]:
    """Return MCP + PIP flexion (4,) [deg] of index ... little, and which are known."""
    bends: list[list[float]] = features.bend_rad.tolist()
    return [degrees(mcp + pip) for mcp, pip, _ in bends[1:]], features.known.tolist()[1:]


class Fit(NamedTuple):
    """How well each pose fits one hand, in the order of `PoseTable.names`.

    Attributes:
        score: (P,) 0..1, each for itself, by what is known.
        confidence: (P,) 0..1, against the others.
        known: (P,) enough of its quantities are known, and the fingers that it needs.
        residuals: (P, Q) distance to each pose's ranges in sigmas; 0 inside, and without a range.
        best: The most confident pose of which enough is known; -1: there is none.
    """

    score: Float
    confidence: Float
    known: Bool
    residuals: Float
    best: int


class _Table(NamedTuple):
    """Poses as arrays for the kernel.

    Attributes:
        asked: (P, Q) whether a pose asks for a quantity.
        low, high, soft: (P, Q) its range and border.
        needs: (P, 5) fingers that must be known.
        weight: (P,) of the pose.
        share: Of its quantities that must be known.
    """

    asked: Bool
    low: Float
    high: Float
    soft: Float
    needs: Bool
    weight: Float
    share: float


class PoseTable:
    """The poses of a settings file as arrays."""

    def __init__(self, settings: GestureSettings) -> None:
        self.names: tuple[str, ...] = tuple(settings.poses)
        poses = list(settings.poses.values())
        shape = (len(poses), len(QUANTITIES))
        needs = np.array([[finger in pose.needs for finger in FINGERS] for pose in poses], np.bool_)
        self._table = own = _Table(
            asked=np.zeros(shape, np.bool_),
            low=np.full(shape, -np.inf),
            high=np.full(shape, np.inf),
            soft=np.ones(shape),
            needs=needs.reshape(len(poses), len(FINGERS)),
            weight=np.array([pose.weight for pose in poses], np.float64),
            share=settings.hold.known_share,
        )
        for row, pose in enumerate(poses):
            for name, span in pose.ranges.items():
                at = row, QUANTITIES.index(name)
                own.asked[at], own.low[at], own.high[at], own.soft[at] = True, span.low, span.high, span.soft

    def fit(self, quantities: Quantities, known: Bool) -> Fit:
        """How well each pose fits; `known` (5,) is which fingers are."""
        poses, residuals = len(self.names), np.zeros(self._table.low.shape)
        score, confidence, enough = np.empty(poses), np.empty(poses), np.empty(poses, np.bool_)
        best = _fit(
            self._table, quantities.value, quantities.sigma, known, residuals, score, confidence, enough
        )
        return Fit(score, confidence, enough, residuals, best)


@kernel
def _fit(
    table: _Table,
    value: Float,
    sigma: Float,
    known: Bool,
    residuals: Float,
    score: Float,
    confidence: Float,
    enough: Bool,
) -> int:
    """Return the best pose; write fields of `Fit`, and residuals (P, Q), 0 before."""
    poses, count = table.low.shape
    total = 0.0
    for p in range(poses):
        squares, share, asked = 0.0, 0.0, 0
        for q in range(count):
            if not table.asked[p, q]:
                continue
            there = isfinite(value[q] + sigma[q])
            anything = 1e9  # standard deviation of a quantity that is not known: it is as good as anything
            sigma_of = sigma[q] if there else anything
            own = value[q] if isfinite(value[q]) else 0.0
            outside = max(table.low[p, q] - own, own - table.high[p, q], 0.0)
            residuals[p, q] = outside / hypot(table.soft[p, q], sigma_of)
            squares += residuals[p, q] * residuals[p, q]
            # borders: a quantity that is as doubtful as that is half known
            vague = sigma_of / (4.0 * table.soft[p, q])
            share += 1.0 / (1.0 + vague * vague)
            asked += 1
        score[p] = confidence[p] = exp(-0.5 * squares)
        total += table.weight[p] * score[p]
        enough[p] = share / max(asked, 1) >= table.share
        for f in range(5):
            enough[p] = enough[p] and (known[f] or not table.needs[p, f])
    best = -1
    for p in range(poses):
        if total > 0.0:
            confidence[p] = score[p] * table.weight[p] * score[p] / total
        if enough[p] and (best < 0 or confidence[p] > confidence[best]):
            best = p
    return best


class FingerSpeed:
    """How fast the fingers bend; holds the bends of the last frames."""

    def __init__(self) -> None:
        self._past: deque[tuple[int, list[float], list[bool]]] = deque()

    def push(self, t_ns: int, bend_deg: list[float], known: list[bool]) -> float:
        """Return the RMS speed of the fingers [deg/s]; inf: no frame gives it.

        It is over the fingers known then and now, or over all where none is; `bend_deg` (4,) are MCP and PIP
        together.
        """
        memory_s = 0.15  # older frames do not measure how fast a finger is now
        while self._past and t_ns - self._past[0][0] > 1e9 * memory_s:
            self._past.popleft()
        self._past.append((t_ns, bend_deg, known))
        for then_ns, before, known_then in reversed(self._past):
            # over which the speed of fingers is taken: two frames at 60 Hz, one of a wrist device
            rate_s = 0.030
            if t_ns - then_ns >= 1e9 * rate_s:
                moved = [now - then for now, then in zip(bend_deg, before, strict=True)]
                both = [
                    one for one, *sure in zip(moved, known_then, known, strict=True) if all(sure)
                ] or moved
                return sqrt(sum(one * one for one in both) / len(both)) / (1e-9 * (t_ns - then_ns))
        return inf


class PoseRecogniser:
    """From the features of a hand to the pose it is held in: begin, update, end.

    Holds that pose, when it was last known, since when another would be it, and the speed of the fingers.
    """

    def __init__(self, settings: GestureSettings) -> None:
        self._hold: HoldSettings = settings.hold
        self._table = PoseTable(settings)
        self._speed = FingerSpeed()
        self._held: int | None = None
        self._began_ns = self._seen_ns = 0
        self._confidence = 0.0
        self._coming: int | None = None
        self._coming_ns = 0
        self._going_ns: int | None = None

    @property
    def held(self) -> str | None:
        """Name of the pose that is held."""
        return None if self._held is None else self._table.names[self._held]

    def push(self, features: HandFeatures) -> list[Gesture]:
        """Return the messages about a hand; epochs must rise."""
        quantities = Quantities.of(features)
        fit = self._table.fit(quantities, features.known)
        bends, known = known_bends(features)
        speed = self._speed.push(features.t_ns, bends, known)
        begins = self._beginning(features, fit, speed, sum(known))
        if begins is not None and begins != self._held:
            return self._begin(features, begins, float(fit.confidence[begins]))
        return self._go_on(features, fit)

    def lose(self, hand: str, t_ns: int) -> list[Gesture]:
        """Return the messages where the hand itself is not known at `t_ns`."""
        self._coming = None
        return [] if self._held is None else self._unsure(hand, t_ns, self._hold.lost_s)

    def _beginning(self, features: HandFeatures, fit: Fit, speed: float, known: int) -> int | None:
        """The pose that would be held now: confident long enough, of a hand at rest."""
        best, t_ns = fit.best, features.t_ns
        # Of both kinds of sensors none may see a tip just now and fingers be known all the same.
        there = features.seen.any() or features.known.any()
        if best < 0 or fit.confidence[best] < self._hold.begin or not there:
            self._coming = None
            return None
        if best != self._coming:
            self._coming, self._coming_ns = best, t_ns
        lasted_s = 1e-9 * (t_ns - self._coming_ns)
        # fingers of index ... little: what is recognised from fewer must last longer
        enough = known >= 3
        at_rest = (
            lasted_s >= (self._hold.begin_s if enough else self._hold.uncertain_s)
            and speed <= self._hold.still_deg_s
        )
        return best if at_rest or lasted_s >= self._hold.slow_s else None

    def _begin(self, features: HandFeatures, pose: int, confidence: float) -> list[Gesture]:
        t_ns = features.t_ns
        out = [] if self._held is None else [self._message(features.hand, t_ns, "end", 0.0)]
        self._held, self._began_ns, self._seen_ns, self._confidence = pose, t_ns, t_ns, confidence
        self._going_ns = None
        return [*out, self._message(features.hand, t_ns, "begin", confidence)]

    def _go_on(self, features: HandFeatures, fit: Fit) -> list[Gesture]:
        held, hand, t_ns = self._held, features.hand, features.t_ns
        if held is None:
            return []
        confidence, enough = float(fit.confidence[held]), bool(fit.known[held])
        if enough and confidence >= self._hold.end:
            self._going_ns, self._seen_ns, self._confidence = None, t_ns, confidence
            return [self._message(hand, t_ns, "update", confidence)]
        # Hidden fingers count neither for nor against it, and other poses begin where they are measured.
        if fit.score[held] >= self._hold.end:
            self._going_ns = None
            return self._unsure(hand, t_ns, self._hold.hidden_s)
        if self._going_ns is None:
            self._going_ns = t_ns
        if t_ns - self._going_ns >= 1e9 * self._hold.end_s:
            return self._end(hand, t_ns)
        return [self._message(hand, t_ns, "update", confidence)]

    def _unsure(self, hand: str, t_ns: int, longest_s: float) -> list[Gesture]:
        """The held pose goes on for a while, ever less sure."""
        left = 1.0 - 1e-9 * (t_ns - self._seen_ns) / max(longest_s, 1e-9)
        if left <= 0.0:
            return self._end(hand, t_ns)
        return [self._message(hand, t_ns, "update", min(left, 1.0) * self._confidence)]

    def _end(self, hand: str, t_ns: int) -> list[Gesture]:
        out = [self._message(hand, t_ns, "end", 0.0)]
        self._held, self._going_ns = None, None
        return out

    def _message(self, hand: str, t_ns: int, phase: Phase, confidence: float) -> Gesture:
        assert self._held is not None
        name = self._table.names[self._held]
        return Gesture(
            hand=hand,
            t_ns=t_ns,
            kind="pose",
            name=name,
            phase=phase,
            began_t_ns=self._began_ns,
            confidence=min(max(confidence, 0.0), 1.0),
        )


class Actions:
    """The four detectors of actions, of which one at most is active."""

    def __init__(self, settings: GestureSettings, radius_m: Float) -> None:
        """Of a hand whose joints have the radii (26,) [m]."""
        self._radius_m, self._taps = radius_m, settings.tap
        self.pinch, self.dial = PinchMonitor(settings.pinch), DialMonitor(settings.dial)
        self.tap, self.point = ThumbTapMonitor(settings.tap), PointMonitor(settings.point)

    def push(self, seen: HandFeatures, *, wrist_device_only: bool = False) -> list[Gesture]:
        """Return the messages at the epoch of the features.

        `wrist_device_only`: all that sees the hand is worn on its arm, and the rig frame goes with it.
        """
        pinch, dial, tap, point = self.pinch, self.dial, self.tap, self.point
        touch = thumb_touch(seen, self._radius_m)
        others = dial.active or tap.active or point.active
        gestures = pinch.push(seen, touch, may_begin=not others and not is_pad(seen, self._taps))
        if pinch.active or dial.active or point.active:
            tap.drop()
        else:
            gestures += tap.push(seen, touch, may_begin=True)
        others = pinch.active or tap.active
        dial_may = not others and not point.active
        gestures += dial.push(
            seen, float(touch.gap_m.min()), may_begin=dial_may, wrist_device_only=wrist_device_only
        )
        return gestures + point.push(seen, may_begin=not others and not dial.active)

    def lost(self, t_ns: int) -> list[Gesture]:
        """Return the messages at an epoch at which there is no hand."""
        self.tap.drop()
        return self.pinch.lost(t_ns) + self.dial.lost(t_ns) + self.point.lost(t_ns)


class GestureRecogniser:
    """Poses and actions of one hand; holds what has begun and not ended."""

    def __init__(self, settings: GestureSettings, model: HandModel) -> None:
        self._features, self._poses = FeatureExtractor(model), PoseRecogniser(settings)
        self._actions = Actions(settings, model.radius_m)
        with log_if_slow():
            self._rehearse(settings, model)

    def _rehearse(self, settings: GestureSettings, model: HandModel) -> None:
        """Call every kernel once, so that none is compiled while a hand is tracked."""
        seen = self._features.of(_at_rest(model))
        assert seen is not None
        PoseRecogniser(settings).push(seen)
        Actions(settings, model.radius_m).push(seen)
        rehearse(seen)

    def push(self, pose: HandPose) -> list[Gesture]:
        """Return messages of a pose, usually none or one; without a hand only ends."""
        seen = self._features.of(pose)
        if seen is None:
            return self._poses.lose(pose.hand, pose.t_ns) + self._actions.lost(pose.t_ns)
        return self._poses.push(seen) + self._actions.push(seen, wrist_device_only=len(pose.markers_m) == 0)


def _at_rest(model: HandModel) -> HandPose:
    """The rest pose of a hand, known to a millimetre."""
    whole, nothing = np.ones(JOINT_COUNT, np.bool_), np.empty((0, 3))
    return HandPose(
        hand=model.profile.name,
        t_ns=0,
        position_m=model.rest_position_m,
        orientation_wxyz=matrix_to_quaternion(model.rest_rotation),
        radius_m=model.radius_m,
        valid=whole,
        tracked=whole,
        cov_m2=np.tile(1e-6 * np.eye(3), (JOINT_COUNT, 1, 1)),
        source=np.full(JOINT_COUNT, Source.SOLVED, np.uint8),
        angles_rad=np.zeros((5, 4)),
        markers_m=nothing,
        markers_raw_m=nothing,
        markers_cov_m2=np.empty((0, 3, 3)),
        inside_volume=whole,
    )
