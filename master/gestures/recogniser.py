"""What a hand says, pose by pose: the shapes it is held in and what it does."""

from common.gesture_settings import GestureSettings
from common.hand_model import HandModel
from common.messages import Gesture, HandPose
from master.gestures.action import ActionWatch
from master.gestures.caps import Caps
from master.gestures.features import features_of
from master.gestures.poses import PoseRecogniser


class GestureRecogniser:
    """Push machine of one hand. Holds what has begun and not ended."""

    def __init__(self, settings: GestureSettings, model: HandModel) -> None:
        self._model = model
        self._poses = PoseRecogniser(settings)
        self._caps, self._actions = Caps(model), ActionWatch(settings, model.radius_m)

    def push(self, pose: HandPose) -> list[Gesture]:
        """What is to be told of a pose of that hand, in the order of capture; usually nothing or one message.

        Of a pose without a hand only what has lasted too long without one ends.
        """
        seen = features_of(pose, self._model)
        if seen is None:
            return self._poses.lose(pose.hand, pose.t_ns) + self._actions.lost(pose.t_ns)
        worn_only, caps_m = len(pose.markers_m) == 0, self._caps.of(pose, seen.rotation)
        return self._poses.push(seen) + self._actions.push(seen, caps_m, worn_only=worn_only)
