"""ROS 2 receives hands and objects as standard messages over zenoh.

No ROS is installed: this joins the router of ROS 2's middleware rmw_zenoh by a zenoh session of its own (not
the bus's). rmw_zenoh finds publishers by liveliness tokens that describe all about them, and reads each topic
at a key of domain, topic, type and the hash of the type's description. Written from its public description
(github.com/ros2/rmw_zenoh, docs/design.md and the token layout in liveliness_utils, Jazzy to Kilted). Types,
CDR and hashes are rosbags'.

Everything stands in the frame `FRAME`: the rig frame, x right, y down, z away from the reference camera,
which ROS calls an optical frame (REP 103). Metres, radians, quaternions xyzw; stamps are the wall clock's.
"""

import json
import logging
import re
import struct
import time
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import xxhash
import zenoh
from rosbags.typesys import Stores, get_typestore

from common.arrays import Float
from common.calibration.output_settings import Ros2Output
from common.errors import BusError
from common.hand.model import FINGERS, JOINTS
from common.messages import HandPose, ObjectPose, ResultMessage
from master.outputs.network.conventions import MasterTimes

ADMIN = "@ros2_lv"
# Reliable, volatile, keep the last ten; what rmw takes for granted is left out of the text: reliability, durability,
# history, and times of deadline, lifespan and liveliness.
QOS = "::,10:,:,:,,"


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic that is published."""

    name: str  # from the root: "/phalanx/right/joints"
    type_name: str  # "geometry_msgs/msg/PoseArray"
    type_hash: str  # RIHS01_ and 64 hexadecimal digits (REP 2016)

    @property
    def dds_type(self) -> str:
        """The type's name as DDS has it: "geometry_msgs::msg::dds_::PoseArray_"."""
        package, kind, name = self.type_name.split("/")
        return f"{package}::{kind}::dds_::{name}_"

    def key(self, domain: int) -> str:
        """Where its messages are put."""
        return f"{domain}/{self.name.strip('/')}/{self.dds_type}/{self.type_hash}"


@dataclass(frozen=True, slots=True)
class Node:
    """The node that publishes."""

    domain: int  # ROS_DOMAIN_ID
    zid: str  # id of the zenoh session, as zenoh writes it
    namespace: str  # "/" or "/some/name"
    name: str

    def token(self) -> str:
        """Its liveliness token; the first entity of the session."""
        return f"{self._place(0, 'NN')}/{_plain(self.namespace)}/{self.name}"

    def publisher_token(self, number: int, topic: Topic) -> str:
        """That of its publisher `number`, from 1, of a topic."""
        where = f"{self._place(number, 'MP')}/{_plain(self.namespace)}/{self.name}"
        return f"{where}/{_plain(topic.name)}/{topic.dds_type}/{topic.type_hash}/{QOS}"

    def _place(self, number: int, kind: str) -> str:
        return f"{ADMIN}/{self.domain}/{self.zid}/0/{number}/{kind}/%"


def gid_of(token: str) -> bytes:
    """Id (16 bytes) of an entity: XXH3-128 of its token, low half first, little end."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


def attachment(number: int, t_ns: int, gid: bytes) -> bytes:
    """Pack the attachment of a message: number, time sent [ns since 1970], gid."""
    gid_bytes = 16
    return struct.pack("<qqB", number, t_ns, gid_bytes) + gid


def ros_name(name: str) -> str:
    """Return `name` with letters, digits and underscores only, no digit first."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"_{plain}" if plain[:1].isdigit() else plain


def _plain(name: str) -> str:
    return name.replace("/", "%")


_LOG = logging.getLogger(__name__)


class _Publisher:
    def __init__(self, session: zenoh.Session, key: str, token: str) -> None:
        self._publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._token = session.liveliness().declare_token(token)
        self._gid = gid_of(token)
        self._sent = 0

    def put(self, payload: memoryview) -> None:
        self._sent += 1
        self._publisher.put(bytes(payload), attachment=attachment(self._sent, time.time_ns(), self._gid))


FRAME = "phalanx_optical_frame"
POSES, STATES = "geometry_msgs/msg/PoseArray", "sensor_msgs/msg/JointState"
FLAGS = "std_msgs/msg/UInt8MultiArray"
POSE, TRANSFORMS = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"
_ANGLES = ("abduction", "flexion", "pip", "dip")
_THUMB_ANGLES = ("cmc_abduction", "cmc_flexion", "mcp", "ip")
ANGLES = tuple(
    f"{finger}_{angle}" for finger in FINGERS for angle in (_THUMB_ANGLES if finger == "thumb" else _ANGLES)
)
_STORE = get_typestore(Stores.ROS2_JAZZY)
# dataclasses that rosbags makes; they have no static types of their own
_TYPES: dict[str, Any] = dict(_STORE.types)


@cache
def topic(name: str, type_name: str) -> Topic:
    """A topic under /phalanx, or /tf."""
    return Topic(name, type_name, _STORE.hash_rihs01(type_name))


def hand_messages(pose: HandPose, wall_ns: int) -> list[tuple[Topic, memoryview]]:
    """Return topic and CDR of all that is published of one pose of a hand.

    /phalanx/HAND/joint_poses (26, only while all are valid, for a NaN stops viewers),
    /phalanx/HAND/joint_states (angles that are known), /phalanx/HAND/joint_flags (26: 0 invalid, 1 valid, 2
    tracked), and /tf with a frame HAND/JOINT for each valid joint. `wall_ns`: when the pose holds,
    nanoseconds since 1970.
    """
    hand, header = ros_name(pose.hand), _header(wall_ns)
    valid = (
        pose.valid & np.isfinite(pose.position_m).all(axis=1) & np.isfinite(pose.orientation_wxyz).all(axis=1)
    )
    places, quaternions = pose.position_m.tolist(), pose.orientation_wxyz[:, [1, 2, 3, 0]].tolist()
    flags = np.where(pose.tracked & valid, 2, np.where(valid, 1, 0)).astype(np.uint8)
    layout = _TYPES["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    out = [
        _cdr(f"/phalanx/{hand}/joint_flags", FLAGS, layout=layout, data=flags),
        _cdr(f"/phalanx/{hand}/joint_states", STATES, **_states(pose, header)),
    ]
    if valid.all():
        poses = [_pose(*pair) for pair in zip(places, quaternions, strict=True)]
        out.append(_cdr(f"/phalanx/{hand}/joint_poses", POSES, header=header, poses=poses))
    if valid.any():
        frames = [
            _frame(header, f"{hand}/{JOINTS[j]}", places[j], quaternions[j])
            for j in np.flatnonzero(valid).tolist()
        ]
        out.append(_cdr("/tf", TRANSFORMS, transforms=frames))
    return out


def object_messages(pose: ObjectPose, wall_ns: int) -> list[tuple[Topic, memoryview]]:
    """Return topic and CDR of /phalanx/object/NAME/pose and /tf; none while unknown."""
    if not (np.isfinite(pose.position_m).all() and np.isfinite(pose.orientation_wxyz).all()):
        return []
    name, header = ros_name(pose.object), _header(wall_ns)
    place, quaternion = pose.position_m.tolist(), pose.orientation_wxyz[[1, 2, 3, 0]].tolist()
    # ROS: all zero is "not known"
    covariance: Float = pose.cov.ravel() if np.isfinite(pose.cov).all() else np.zeros(36)
    full = _TYPES["geometry_msgs/msg/PoseWithCovariance"](
        pose=_pose(place, quaternion), covariance=np.ascontiguousarray(covariance)
    )
    frame = _frame(header, f"object/{name}", place, quaternion)
    return [
        _cdr(f"/phalanx/object/{name}/pose", POSE, header=header, pose=full),
        _cdr("/tf", TRANSFORMS, transforms=[frame]),
    ]


def _states(pose: HandPose, header: object) -> dict[str, object]:
    angles = pose.angles_rad.ravel()
    known = np.flatnonzero(np.isfinite(angles))
    names = [f"{ros_name(pose.hand)}/{ANGLES[k]}" for k in known.tolist()]
    nothing = np.empty(0)
    return {
        "header": header,
        "name": names,
        "position": angles[known],
        "velocity": nothing,
        "effort": nothing,
    }


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


def _frame(header: object, child: str, place: list[float], quaternion: list[float]) -> object:
    return _TYPES["geometry_msgs/msg/TransformStamped"](
        header=header,
        child_frame_id=child,
        transform=_TYPES["geometry_msgs/msg/Transform"](
            translation=_TYPES["geometry_msgs/msg/Vector3"](*place),
            rotation=_TYPES["geometry_msgs/msg/Quaternion"](*quaternion),
        ),
    )


def _cdr(name: str, type_name: str, /, **fields: object) -> tuple[Topic, memoryview]:
    message = _TYPES[type_name](**fields)
    return topic(name, type_name), _STORE.serialize_cdr(message, type_name, little_endian=True)


class Ros2Sink:
    """A `Sink`: the node `phalanx` in ROS's network, and its publishers."""

    def __init__(self, settings: Ros2Output, times: MasterTimes) -> None:
        """Join the router, like tcp/127.0.0.1:7447; BusError: none is there."""
        self._times, self._router = times, settings.router
        config = {
            "mode": "client",
            "connect": {
                "endpoints": [settings.router],
                "timeout_ms": 1000,
                "exit_on_failure": True,
                "retry": {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 2},
            },
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            raise BusError(
                f"ros2: no router at {settings.router}: start one with `ros2 run rmw_zenoh_cpp rmw_zenohd`, or set"
                " `router`"
            ) from error
        self._node = Node(settings.domain_id, str(self._session.info.zid()), "/", "phalanx")
        self._token = self._session.liveliness().declare_token(self._node.token())
        self._publishers: dict[str, _Publisher] = {}

    def write(self, message: ResultMessage) -> None:
        """Publish a hand or an object; BusError: the router is gone."""
        if not self._session.info.routers_zid():
            raise BusError(f"ros2: the router at {self._router} is gone")
        if isinstance(message, HandPose):
            messages = hand_messages(message, self._times.wall_ns(message.t_ns))
        elif isinstance(message, ObjectPose):
            messages = object_messages(message, self._times.wall_ns(message.t_ns))
        else:
            return
        for topic, payload in messages:
            try:
                self._publisher(topic).put(payload)
            except zenoh.ZError as error:
                raise BusError(f"ros2: cannot publish {topic.name}: {error}") from error

    def close(self) -> None:
        """Leave ROS's network: all tokens go. Safe to call twice."""
        try:
            self._session.close()
        except zenoh.ZError as error:
            _LOG.warning("ros2: closing: %s", error)

    def _publisher(self, topic: Topic) -> _Publisher:
        """That of a topic, which its first message declares."""
        publisher = self._publishers.get(topic.name)
        if publisher is None:
            token = self._node.publisher_token(len(self._publishers) + 1, topic)
            publisher = _Publisher(self._session, topic.key(self._node.domain), token)
            self._publishers[topic.name] = publisher
        return publisher
