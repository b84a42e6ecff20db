"""What a hand says, pose by pose: the shapes it is held in and what it does."""

from common.gesture_settings import GestureSettings
from common.hand_model import HandModel
from common.messages import Gesture, HandPose
from master.gestures.action import ActionWatch
from master.gestures.features import FeatureExtractor
from master.gestures.poses import PoseRecogniser


class GestureRecogniser:
    """Push machine of one hand. Holds what has begun and not ended."""

    def __init__(self, settings: GestureSettings, model: HandModel) -> None:
        self._features, self._poses = FeatureExtractor(model), PoseRecogniser(settings)
        self._actions = ActionWatch(settings, model.radius_m)

    def push(self, pose: HandPose) -> list[Gesture]:
        """What is to be told of a pose of that hand, in the order of capture; usually nothing or one message.

        Of a pose without a hand only what has lasted too long without one ends.
        """
        seen = self._features.of(pose)
        if seen is None:
            return self._poses.lose(pose.hand, pose.t_ns) + self._actions.lost(pose.t_ns)
        return self._poses.push(seen) + self._actions.push(seen, worn_only=len(pose.markers_m) == 0)
