"""Hands and objects as ROS 2's standard messages, in CDR.

Types, serialization and hashes of types are rosbags'.

Everything stands in the frame `FRAME`: the rig frame, x right, y down, z away from the reference camera, which ROS
calls an optical frame (REP 103). Metres, radians, quaternions xyzw; stamps are the wall clock's.
"""

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from common.arrays import Float
from common.hand.model import FINGERS, JOINTS
from common.messages import HandPose, ObjectPose
from master.outputs.network.ros2_names import Topic, ros_name

FRAME = "phalanx_optical_frame"
POSES, STATES, FLAGS = (
    "geometry_msgs/msg/PoseArray",
    "sensor_msgs/msg/JointState",
    "std_msgs/msg/UInt8MultiArray",
)
POSE, TRANSFORMS = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"
_ANGLES = ("abduction", "flexion", "pip", "dip")
_THUMB_ANGLES = ("cmc_abduction", "cmc_flexion", "mcp", "ip")
ANGLES = tuple(
    f"{finger}_{angle}" for finger in FINGERS for angle in (_THUMB_ANGLES if finger == "thumb" else _ANGLES)
)
_STORE = get_typestore(Stores.ROS2_JAZZY)
_TYPES: dict[str, Any] = dict(
    _STORE.types
)  # dataclasses that rosbags makes; they have no static types of their own


@cache
def topic(name: str, type_name: str) -> Topic:
    """A topic under /phalanx, or /tf."""
    return Topic(name, type_name, _STORE.hash_rihs01(type_name))


def hand_messages(pose: HandPose, wall_ns: int) -> list[tuple[Topic, memoryview]]:
    """All that is published of one pose of a hand.

    Args:
        pose: In the rig frame.
        wall_ns: When it holds, nanoseconds since 1970.

    Returns:
        Topic and CDR of each: /phalanx/HAND/joint_poses (26, only while all are valid, for a NaN stops viewers),
        /phalanx/HAND/joint_states (angles that are known), /phalanx/HAND/joint_flags (26: 0 invalid, 1 valid,
        2 tracked), and /tf with a frame HAND/JOINT for each valid joint.
    """
    hand, header = ros_name(pose.hand), _header(wall_ns)
    valid = (
        pose.valid & np.isfinite(pose.position_m).all(axis=1) & np.isfinite(pose.orientation_wxyz).all(axis=1)
    )
    places, quaternions = pose.position_m.tolist(), pose.orientation_wxyz[:, [1, 2, 3, 0]].tolist()
    flags = np.where(pose.tracked & valid, 2, np.where(valid, 1, 0)).astype(np.uint8)
    layout = _TYPES["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    out = [
        _cdr(f"/phalanx/{hand}/joint_flags", FLAGS, _TYPES[FLAGS](layout=layout, data=flags)),
        _cdr(f"/phalanx/{hand}/joint_states", STATES, _states(pose, header)),
    ]
    if valid.all():
        poses = [_pose(places[j], quaternions[j]) for j in range(len(JOINTS))]
        out.append(_cdr(f"/phalanx/{hand}/joint_poses", POSES, _TYPES[POSES](header=header, poses=poses)))
    frames = [
        _TYPES["geometry_msgs/msg/TransformStamped"](
            header=header,
            child_frame_id=f"{hand}/{JOINTS[j]}",
            transform=_TYPES["geometry_msgs/msg/Transform"](
                translation=_TYPES["geometry_msgs/msg/Vector3"](*places[j]),
                rotation=_TYPES["geometry_msgs/msg/Quaternion"](*quaternions[j]),
            ),
        )
        for j in np.flatnonzero(valid).tolist()
    ]
    if frames:
        out.append(_cdr("/tf", TRANSFORMS, _TYPES[TRANSFORMS](transforms=frames)))
    return out


def object_messages(pose: ObjectPose, wall_ns: int) -> list[tuple[Topic, memoryview]]:
    """Return the ROS 2 messages of an object.

    /phalanx/object/NAME/pose, with its covariance, and its frame on /tf; nothing while its pose is unknown.
    """
    if not (np.isfinite(pose.position_m).all() and np.isfinite(pose.orientation_wxyz).all()):
        return []
    name, header = ros_name(pose.object), _header(wall_ns)
    place, quaternion = pose.position_m.tolist(), pose.orientation_wxyz[[1, 2, 3, 0]].tolist()
    covariance: Float = np.ascontiguousarray(pose.cov).ravel()
    if not np.isfinite(covariance).all():
        covariance = np.zeros(36)  # ROS: all zero is "not known"
    encoded = _TYPES[POSE](
        header=header,
        pose=_TYPES["geometry_msgs/msg/PoseWithCovariance"](
            pose=_pose(place, quaternion), covariance=covariance
        ),
    )
    frame = _TYPES["geometry_msgs/msg/TransformStamped"](
        header=header,
        child_frame_id=f"object/{name}",
        transform=_TYPES["geometry_msgs/msg/Transform"](
            translation=_TYPES["geometry_msgs/msg/Vector3"](*place),
            rotation=_TYPES["geometry_msgs/msg/Quaternion"](*quaternion),
        ),
    )
    return [
        _cdr(f"/phalanx/object/{name}/pose", POSE, encoded),
        _cdr("/tf", TRANSFORMS, _TYPES[TRANSFORMS](transforms=[frame])),
    ]


def _states(pose: HandPose, header: object) -> object:
    angles = pose.angles_rad.ravel()
    known = np.flatnonzero(np.isfinite(angles))
    nothing = np.empty(0)
    return _TYPES[STATES](
        header=header,
        name=[f"{ros_name(pose.hand)}/{ANGLES[k]}" for k in known.tolist()],
        position=angles[known],
        velocity=nothing,
        effort=nothing,
    )


def _header(wall_ns: int) -> object:
    last_ns = 2**31 * 1_000_000_000 - 1  # ROS's seconds have 32 bits
    seconds, rest = divmod(min(max(wall_ns, 0), last_ns), 1_000_000_000)
    stamp = _TYPES["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return _TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME)


def _pose(place: list[float], quaternion: list[float]) -> object:
    return _TYPES["geometry_msgs/msg/Pose"](
        position=_TYPES["geometry_msgs/msg/Point"](*place),
        orientation=_TYPES["geometry_msgs/msg/Quaternion"](*quaternion),
    )


def _cdr(name: str, type_name: str, message: object) -> tuple[Topic, memoryview]:
    return topic(name, type_name), _STORE.serialize_cdr(message, type_name, little_endian=True)
