"""Hands of given joints as poses, and what is told of them: what the benches of gestures share."""

from collections.abc import Sequence

import numpy as np

from common.arrays import Float
from common.gesture_settings import default_gestures
from common.hand_model import HandModel
from common.messages import JOINT_COUNT, HandPose, Source
from master.gestures.features import features_of
from master.gestures.poses import PoseRecogniser

_SIGMA_M = 2e-3  # claimed of every joint


def pose_of(model: HandModel, t_ns: int, place_m: Float, turned_wxyz: Float, angles_rad: Float) -> HandPose:
    """The pose of joints (26, 3) [m] and (26, 4) that are all seen."""
    whole = np.ones(JOINT_COUNT, np.bool_)
    return HandPose(
        hand=model.profile.name,
        t_ns=t_ns,
        position_m=place_m,
        orientation_wxyz=turned_wxyz,
        radius_m=model.radius_m,
        valid=whole,
        tracked=whole,
        cov_m2=np.tile(_SIGMA_M**2 * np.eye(3), (JOINT_COUNT, 1, 1)),
        source=np.full(JOINT_COUNT, Source.SOLVED, np.uint8),
        angles_rad=angles_rad,
        markers_m=np.zeros((0, 3)),
        markers_raw_m=np.zeros((0, 3)),
        markers_cov_m2=np.zeros((0, 3, 3)),
        inside_volume=whole,
    )


def told_of(poses: Sequence[HandPose], model: HandModel) -> list[str | None]:
    """The pose that is held after each."""
    recogniser = PoseRecogniser(default_gestures())
    out: list[str | None] = []
    for pose in poses:
        features = features_of(pose, model)
        if features is None:
            recogniser.lose(pose.hand, pose.t_ns)
        else:
            recogniser.push(features)
        out.append(recogniser.held)
    return out
