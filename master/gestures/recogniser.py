"""The recogniser finds the pose and the action of a hand.

Selection of the action that a hand performs.

The hand's shape when the action begins decides, and until it ends there is no other.

    thumb and one finger meet, that finger bent out of the row      pinch
    the thumb meets a finger of four that lie side by side          tap
    all tips about a circle, thumb across                           dial
    index finger stretched, the others bent                         point

So a thumb on the index finger's tip is the key 1 over a row of fingers that are bent alike, and a pinch where the
finger has come to meet the thumb; and a finger that is stretched while a dial turns points at nothing.

Gesture recognition, pose by pose: held poses and actions of a hand.
"""

import numpy as np

from common.arrays import Float
from common.calibration.gesture_settings import GestureSettings
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandModel
from common.messages import JOINT_COUNT, Gesture, HandPose, Source
from master.fabrik.compile import log_if_slow
from master.gestures.actions import PinchMonitor, PointMonitor, ThumbTapMonitor, is_pad
from master.gestures.dial import DialMonitor
from master.gestures.features import FeatureExtractor, HandFeatures, thumb_touch
from master.gestures.grip import rehearse
from master.gestures.poses import PoseRecogniser


class ActionMonitor:
    """Push machine. Holds the four watches, of which one at most is active."""

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
    """Push machine of one hand. Holds what has begun and not ended."""

    def __init__(self, settings: GestureSettings, model: HandModel) -> None:
        self._features, self._poses = FeatureExtractor(model), PoseRecogniser(settings)
        self._actions = ActionMonitor(settings, model.radius_m)
        with log_if_slow():
            self._rehearse(settings, model)

    def _rehearse(self, settings: GestureSettings, model: HandModel) -> None:
        """Call every kernel once, so that none is compiled while a hand is tracked."""
        seen = self._features.of(_at_rest(model))
        assert seen is not None
        PoseRecogniser(settings).push(seen)
        ActionMonitor(settings, model.radius_m).push(seen)
        rehearse(seen)

    def push(self, pose: HandPose) -> list[Gesture]:
        """Return the messages about a pose of that hand.

        They are in the order of capture; usually nothing or one message.

        Of a pose without a hand only what has lasted too long without one ends.
        """
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
