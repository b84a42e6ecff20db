"""Gesture recognition, pose by pose: held poses and actions of a hand."""

import numpy as np

from common.calibration.gesture_settings import GestureSettings
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandModel
from common.messages import JOINT_COUNT, Gesture, HandPose, Source
from master.fabrik.compile import log_if_slow
from master.gestures.action import ActionMonitor
from master.gestures.features import FeatureExtractor
from master.gestures.grip import rehearse
from master.gestures.poses import PoseRecogniser


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
