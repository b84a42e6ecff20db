"""What ROS 2 reads from us: names and tokens as rmw_zenoh splits them, CDR as its specification has it."""

import json
import socket
import struct
import time
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
import zenoh

from common.calibration.output_settings import Ros2Output
from common.errors import BusError
from common.hand.model import JOINTS
from common.messages import HandPose, ObjectSource
from master.outputs.network.conventions import MasterTimes
from master.outputs.network.ros2 import (
    ANGLES,
    FRAME,
    Node,
    Ros2Sink,
    Topic,
    gid_of,
    hand_messages,
    object_messages,
    ros_name,
)
from tests.master.outputs.network.cdr_reader import (
    flags,
    joint_state,
    pose_array,
    pose_with_covariance,
    transforms,
)
from tests.master.outputs.test_outputs_files import random_pose
from tests.network_helpers import until
from tests.results import object_pose

# rmw_zenoh's own example, a talker of std_msgs/String; its hash is ROS's.
STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
WALL_NS = 1_750_000_000_123_456_789


class WallTimes(MasterTimes):
    """The wall clock as the master's, plus an hour."""

    def local_ns(self, t_ns: int) -> int:
        return t_ns

    def wall_ns(self, t_ns: int) -> int:
        return t_ns + 3_600_000_000_000


def whole_pose(index: int = 3) -> HandPose:
    pose = random_pose(index)
    return msgspec.structs.replace(
        pose, t_ns=10**18, valid=np.ones(26, np.bool_), tracked=np.arange(26) % 2 == 0
    )


def by_topic(pose: HandPose) -> dict[str, bytes]:
    return {topic.name: bytes(payload) for topic, payload in hand_messages(pose, WALL_NS)}


def test_keys_and_tokens_are_those_of_the_published_layout() -> None:
    topic = Topic("/chatter", "std_msgs/msg/String", STRING)
    assert topic.key(2) == f"2/chatter/std_msgs::msg::dds_::String_/{STRING}"
    node = Node(2, "aac3178e146ba6f1fc6e6a4085e77f21", "/", "talker")
    assert node.token() == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/talker"
    parts = node.publisher_token(10, topic).split("/")
    assert parts[:9] == [
        "@ros2_lv", "2", "aac3178e146ba6f1fc6e6a4085e77f21", "0", "10", "MP", "%", "%", "talker",
    ]  # fmt: skip
    assert parts[9:] == ["%chatter", "std_msgs::msg::dds_::String_", STRING, "::,10:,:,:,,"]


def test_a_gid_is_the_hash_of_the_token() -> None:
    # XXH3 of 128 bits of nothing: high 99aa06d3014798d8, low 6001c324468d497f (the specification's test vector).
    assert gid_of("") == struct.pack("<QQ", 0x6001C324468D497F, 0x99AA06D3014798D8)


def test_the_hash_of_a_type_is_ros_own() -> None:
    topics = {topic.type_name: topic.type_hash for topic, _ in hand_messages(whole_pose(), WALL_NS)}
    # As `ros2 topic info --verbose` prints it on Jazzy.
    assert topics["tf2_msgs/msg/TFMessage"] == (
        "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    )
    assert topics["sensor_msgs/msg/JointState"] == (
        "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    )


def test_poses_read_back() -> None:
    pose = whole_pose()
    t_ns, frame, poses = pose_array(by_topic(pose)["/phalanx/default_right/joint_poses"])
    assert (t_ns, frame) == (WALL_NS, FRAME)
    np.testing.assert_array_equal(np.array(poses)[:, :3], pose.position_m)
    np.testing.assert_array_equal(np.array(poses)[:, 3:], pose.orientation_wxyz[:, [1, 2, 3, 0]])


def test_angles_flags_and_frames_read_back() -> None:
    pose = whole_pose()
    topics = by_topic(pose)
    t_ns, names, positions = joint_state(topics["/phalanx/default_right/joint_states"])
    assert t_ns == WALL_NS
    assert names == [f"default_right/{name}" for name in ANGLES]
    np.testing.assert_array_equal(positions, pose.angles_rad.ravel())
    assert flags(topics["/phalanx/default_right/joint_flags"]) == [2, 1] * 13
    frames = transforms(topics["/tf"])
    assert list(frames) == [f"default_right/{joint}" for joint in JOINTS]
    tip = frames["default_right/index-finger-tip"]
    assert tip[:2] == (WALL_NS, FRAME)
    np.testing.assert_array_equal(tip[2][:3], pose.position_m[JOINTS.index("index-finger-tip")])


def test_what_is_not_known_is_left_out_and_never_nan() -> None:
    pose = whole_pose()
    position, angles, valid = pose.position_m.copy(), pose.angles_rad.copy(), pose.valid.copy()
    position[7], angles[2, 1], valid[9] = np.nan, np.nan, False
    pose = msgspec.structs.replace(pose, position_m=position, angles_rad=angles, valid=valid)
    topics = by_topic(pose)
    assert "/phalanx/default_right/joint_poses" not in topics
    _, names, positions = joint_state(topics["/phalanx/default_right/joint_states"])
    assert "default_right/middle_flexion" not in names
    assert np.isfinite(positions).all()
    states = flags(topics["/phalanx/default_right/joint_flags"])
    assert (states[7], states[9]) == (0, 0)
    assert len(transforms(topics["/tf"])) == 24


def test_an_object_reads_back_with_its_covariance() -> None:
    cov = np.arange(36.0).reshape(6, 6)
    cov = cov + cov.T
    pose = object_pose(
        "my-cube.2", [0.1, 0.2, 0.3], [0.5, 0.5, 0.5, -0.5], cov=cov, source=int(ObjectSource.TAGS)
    )
    topics = {topic.name: bytes(payload) for topic, payload in object_messages(pose, WALL_NS)}
    frame, numbers, covariance = pose_with_covariance(topics["/phalanx/object/my_cube_2/pose"])
    assert frame == FRAME
    assert numbers == [0.1, 0.2, 0.3, 0.5, 0.5, -0.5, 0.5]
    np.testing.assert_array_equal(np.reshape(covariance, (6, 6)), cov)
    assert transforms(topics["/tf"])["object/my_cube_2"][2][:3] == [0.1, 0.2, 0.3]
    lost = msgspec.structs.replace(pose, position_m=np.full(3, np.nan))
    assert object_messages(lost, WALL_NS) == []


def test_names_that_ros_refuses_are_made_plain() -> None:
    assert ros_name("left-back3.x") == "left_back3_x"
    assert ros_name("3rd") == "_3rd"


@pytest.fixture
def router() -> Iterator[tuple[str, zenoh.Session]]:
    """A zenoh router, as `rmw_zenohd` is one, and a session of a ROS program that has joined it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        end = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    of_router = {"mode": "router", "listen": {"endpoints": [end]}, "scouting": quiet}
    of_client = {"mode": "client", "connect": {"endpoints": [end]}, "scouting": quiet}
    with (
        zenoh.open(zenoh.Config.from_json5(json.dumps(of_router))),
        zenoh.open(zenoh.Config.from_json5(json.dumps(of_client))) as session,
    ):
        yield end, session


def test_a_program_that_has_joined_the_router_finds_and_reads_a_hand(
    router: tuple[str, zenoh.Session],
) -> None:
    end, session = router
    received = session.declare_subscriber(
        "7/phalanx/default_right/joint_poses/**", zenoh.handlers.FifoChannel(16)
    )
    pose = whole_pose()
    sink = Ros2Sink(Ros2Output(on=True, router=end, domain_id=7), WallTimes())
    sample = None
    for _ in range(400):  # who declares on one session is known to another a moment later
        sink.write(pose)
        if (sample := received.try_recv()) is not None:
            break
        time.sleep(0.05)
    assert sample is not None
    tokens: list[str] = []

    def all_are_known() -> bool:
        found = session.liveliness().get("@ros2_lv/7/**", timeout=2.0)
        tokens[:] = [str(reply.ok.key_expr) for reply in found if reply.ok is not None]
        return len(tokens) >= 5  # the node and four publishers

    assert until(all_are_known, 20.0)
    sink.close()
    published = {token.split("/")[9].replace("%", "/") for token in tokens if "/MP/" in token}
    assert published == {"/tf", *(f"/phalanx/default_right/joint_{x}" for x in ("poses", "states", "flags"))}
    assert next(token for token in tokens if "/NN/" in token).endswith("/NN/%/%/phalanx")
    # A subscriber of ROS listens at exactly this key.
    assert str(sample.key_expr) == (
        "7/phalanx/default_right/joint_poses/geometry_msgs::msg::dds_::PoseArray_/"
        "RIHS01_af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0"
    )
    t_ns, _, poses = pose_array(sample.payload.to_bytes())
    assert t_ns == pose.t_ns + 3_600_000_000_000
    assert len(poses) == 26
    assert sample.attachment is not None
    number, sent_ns, length = struct.unpack_from("<qqB", sample.attachment.to_bytes())
    assert (number >= 1, length, len(sample.attachment.to_bytes())) == (True, 16, 33)
    assert abs(sent_ns - time.time_ns()) < 60_000_000_000
    (mine,) = (token for token in tokens if "%joint_poses/" in token)
    assert sample.attachment.to_bytes()[17:] == gid_of(mine)


def test_a_router_that_is_not_there_is_an_error_with_the_fix() -> None:
    with pytest.raises(BusError, match="rmw_zenohd"):
        Ros2Sink(Ros2Output(on=True, router="tcp/127.0.0.1:9"), WallTimes())
