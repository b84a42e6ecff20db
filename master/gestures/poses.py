"""Recognise held poses of the hand, with hysteresis, and select its action.

A hand that fits none of the poses (`master.gestures.quantities`) has no pose. A hand that goes from one pose to another
may pass through a third, so a pose begins where the fingers are nearly at rest, or once it has lasted a while; the end
of a natural movement is slow, so that this costs no time.

The hand's shape when an action begins decides which it is, and until it ends there is no other:

    thumb and one finger meet, that finger bent out of the row      pinch
    the thumb meets a finger of four that lie side by side          tap
    all tips about a circle, thumb across                           dial
    index finger stretched, the others bent                         point
"""

import numpy as np

from common.arrays import Float
from common.calibration.gesture_settings import GestureSettings, HoldSettings
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandModel
from common.kernels import log_if_slow
from common.messages import JOINT_COUNT, Gesture, HandPose, Phase, Source
from master.gestures.actions import PinchMonitor, PointMonitor, ThumbTapMonitor, is_pad
from master.gestures.dial import DialMonitor
from master.gestures.features import FeatureExtractor, HandFeatures, thumb_touch
from master.gestures.grip import rehearse
from master.gestures.quantities import FingerSpeed, Fit, PoseTable, Quantities, known_bends


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
