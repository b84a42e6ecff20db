"""What a master publishes of hands and objects: every field, of which a test names those that it is about."""

import numpy as np

from common.arrays import Float
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandJoints, HandModel
from common.messages import JOINT_COUNT, HandPose, ObjectPose, Source

EYE_WXYZ = np.array([1.0, 0.0, 0.0, 0.0])


def hand_pose(**changes: object) -> HandPose:
    """A hand at the origin whose joints are all known to 1 mm and solved, and of whose six markers none is seen."""
    known = np.ones(JOINT_COUNT, np.bool_)
    markers = np.asarray(changes.get("markers_m", np.full((6, 3), np.nan)))
    values: dict[str, object] = {
        "hand": "made",
        "t_ns": 0,
        "position_m": np.zeros((JOINT_COUNT, 3)),
        "orientation_wxyz": np.tile(EYE_WXYZ, (JOINT_COUNT, 1)),
        "radius_m": np.full(JOINT_COUNT, 0.01),
        "valid": known,
        "tracked": known,
        "cov_m2": np.tile(1e-6 * np.eye(3), (JOINT_COUNT, 1, 1)),
        "source": np.full(JOINT_COUNT, Source.SOLVED, np.uint8),
        "angles_rad": np.zeros((5, 4)),
        "markers_m": markers,
        "markers_raw_m": markers,
        "markers_cov_m2": np.full((len(markers), 3, 3), np.nan),
        "inside_volume": known,
    }
    return HandPose(**(values | changes))  # pyright: ignore[reportArgumentType]


def pose_of(model: HandModel, joints: HandJoints, **changes: object) -> HandPose:
    """The hand of these joints; other fields as of `hand_pose`."""
    own: dict[str, object] = {
        "hand": model.profile.name,
        "position_m": joints.position_m,
        "orientation_wxyz": matrix_to_quaternion(joints.rotation),
        "radius_m": model.radius_m,
    }
    return hand_pose(**(own | changes))


def object_pose(
    name: str, position_m: Float | list[float], wxyz: Float | list[float] = EYE_WXYZ, **changes: object
) -> ObjectPose:
    """An object that is tracked by its three markers, exactly."""
    values: dict[str, object] = {
        "position_m": np.array(position_m),
        "orientation_wxyz": np.array(wxyz),
        "t_ns": 0,
        "cov": np.zeros((6, 6)),
        "residual_m": 0.0,
        "source": 1,
        "tracked": True,
        "seen": 3,
        "expected": 3,
        "occluded": False,
    }
    return ObjectPose(name, **(values | changes))  # pyright: ignore[reportArgumentType]
