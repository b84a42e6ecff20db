"""The VMC output: bones of known poses in Unity's axes, and the pose built again from the bones that arrive."""

import re
import socket
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from common.arrays import Float
from common.calibration.output_settings import VmcOutput
from common.geometry.transforms import axis_rotation, quaternion_to_matrix
from common.hand.model import FINGER_JOINTS, PALM, WRIST
from common.messages import HandPose
from master.outputs.network.conventions import MasterTimes, Side, side_of
from master.outputs.network.vmc import VmcSink
from tests.master.outputs.network.hands import MODELS, hand_pose, known_hand
from tests.master.outputs.network.osc_reader import Received, packet_of

SIDES: tuple[Side, ...] = ("left", "right")
# The bones of one hand in Unity's HumanBodyBones, and the joints of OpenXR at which they begin and end.
CHAINS = {
    "Thumb": ("thumb-metacarpal", (2, 3, 4, 5)),
    "Index": ("index-finger", (7, 8, 9, 10)),
    "Middle": ("middle-finger", (12, 13, 14, 15)),
    "Ring": ("ring-finger", (17, 18, 19, 20)),
    "Little": ("pinky-finger", (22, 23, 24, 25)),
}
SEGMENTS = ("Proximal", "Intermediate", "Distal")
FACING = VmcOutput(q_avatar_rig=(1.0, 0.0, 0.0, 0.0))  # rig axes are those of the avatar, OpenXR


@dataclass(frozen=True)
class Bone:
    """A bone as it came: position [m] and rotation (3, 3), Unity's axes, against its parent."""

    position_m: Float
    rotation: Float


def sent(
    ear: socket.socket, pose: HandPose, output: VmcOutput = FACING
) -> tuple[list[Received], dict[str, Bone]]:
    """What arrives of one pose: the messages about the whole avatar, and the bones."""
    sink = VmcSink(replace(output, port=ear.getsockname()[1]), MasterTimes())
    sink.write(pose)
    sink.close()
    packets = [ear.recv(65536) for _ in range(2)]
    assert max(map(len, packets)) <= 1472, "a network would split it"
    bones: dict[str, Bone] = {}
    for one in packet_of(packets[1]):
        assert one.address == "/VMC/Ext/Bone/Pos"
        x, y, z, qx, qy, qz, qw = one.numbers
        bones[str(one.arguments[0])] = Bone(
            np.array([x, y, z]), quaternion_to_matrix(np.array([qw, qx, qy, qz]))
        )
    return packet_of(packets[0]), bones


def t_hand(side: Side, bend: dict[int, Float] | None = None) -> HandPose:
    """A geometrically flat hand in the T-pose of VRM, avatar frame in OpenXR axes; `bend`: joint -> turn of its own.

    Built from the words of the definition: fingers along x away from the body, palm down, the thumb half way between
    them and the front, its nail half way between the front and the other hand. Each joint turns those behind it.
    """
    out, front, up = (1.0 if side == "right" else -1.0) * np.eye(3)[0], -np.eye(3)[2], np.eye(3)[1]
    finger = np.stack([np.cross(up, -out), up, -out], axis=1)
    ahead, nail = (out + front) / np.sqrt(2.0), (front - out) / np.sqrt(2.0)
    thumb = np.stack([np.cross(nail, -ahead), nail, -ahead], axis=1)
    position, rotation = np.zeros((26, 3)), np.repeat(finger[None], 26, axis=0)
    rest = {
        joint: thumb if row == 0 else finger for row, joints in enumerate(FINGER_JOINTS) for joint in joints
    }
    for row, joints in enumerate(FINGER_JOINTS):
        at, rotation_vector = (0.02 + 0.015 * row) * -front + 0.02 * out, np.eye(3)
        if row == 0:
            at = 0.03 * out + 0.02 * front
        frame = rest[joints[0]]
        for joint in joints:
            frame = rotation_vector @ rest[joint] if joint == joints[0] else frame
            frame = frame @ (np.eye(3) if bend is None else bend.get(joint, np.eye(3)))
            position[joint], rotation[joint] = at, frame
            at = at - 0.03 * frame[:, 2]
    position[PALM] = 0.05 * out
    return known_hand(side, position, rotation, np.zeros((5, 4)), 10**9)


@pytest.mark.parametrize("side", SIDES)
def test_the_t_pose_turns_no_bone(ear: socket.socket, side: Side) -> None:
    pose = t_hand(side)
    assert side_of(pose) == side
    state, bones = sent(ear, pose)
    assert [(one.address, one.arguments) for one in state] == [
        ("/VMC/Ext/OK", (1, 3, 0)),
        ("/VMC/Ext/T", (0.0,)),
        ("/VMC/Ext/Root/Pos", ("root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    ]
    top = side.capitalize()
    assert list(bones) == [
        f"{top}Hand", *(f"{top}{finger}{segment}" for finger in CHAINS for segment in SEGMENTS)
    ]  # fmt: skip
    for bone in bones.values():
        np.testing.assert_allclose(bone.rotation, np.eye(3), atol=1e-6)
    # Unity: the right hand to +x, the front is +z; so a right thumb is ahead of its index.
    sign = 1.0 if side == "right" else -1.0
    np.testing.assert_allclose(bones[f"{top}IndexIntermediate"].position_m, [sign * 0.03, 0, 0], atol=1e-6)
    half = 0.03 * np.sqrt(0.5)
    np.testing.assert_allclose(bones[f"{top}ThumbIntermediate"].position_m, [sign * half, 0, half], atol=1e-6)


@pytest.mark.parametrize("side", SIDES)
def test_an_index_at_a_right_angle_points_down_by_a_turn_about_unitys_z(
    ear: socket.socket, side: Side
) -> None:
    _, bones = sent(ear, t_hand(side, {7: axis_rotation(0, -np.pi / 2)}))
    top, sign = side.capitalize(), 1.0 if side == "right" else -1.0
    # Unity multiplies quaternions as everybody does: a turn by +90 deg about z takes +x to +y. A right finger that lies
    # along +x goes down, to -y, by -90 deg; a left one, along -x, by +90 deg.
    proximal = bones[f"{top}IndexProximal"].rotation
    np.testing.assert_allclose(proximal, axis_rotation(2, -sign * np.pi / 2), atol=1e-6)
    np.testing.assert_allclose(proximal @ [sign, 0, 0], [0, -1, 0], atol=1e-6)
    for name, bone in bones.items():
        if name != f"{top}IndexProximal":
            np.testing.assert_allclose(bone.rotation, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("side", SIDES)
def test_a_thumb_bends_level_across_the_palm_by_a_turn_about_unitys_y(ear: socket.socket, side: Side) -> None:
    _, bones = sent(ear, t_hand(side, {3: axis_rotation(0, -np.pi / 2)}))
    top, sign = side.capitalize(), 1.0 if side == "right" else -1.0
    middle = bones[f"{top}ThumbIntermediate"].rotation
    half = np.sqrt(0.5)
    ahead = np.array([sign * half, 0.0, half])
    np.testing.assert_allclose(middle @ ahead, [sign * half, 0, -half], atol=1e-6)  # to the fingers, not away
    np.testing.assert_allclose(middle @ [0, 1, 0], [0, 1, 0], atol=1e-6)


def test_the_mirror_between_the_axes_is_no_rotation(ear: socket.socket) -> None:
    # Three directions of a hand that make a right-handed triple in the rig make a left-handed one in Unity.
    pose = hand_pose("right", rotation_vector=np.array([0.3, 1.0, -0.4]))
    _, bones = sent(ear, pose)
    rig = pose.position_m[[8, 13, 18]] - pose.position_m[WRIST]
    dispatcher = np.stack([built(bones, "right")[row] for row in (8, 13, 18)])
    assert np.linalg.det(rig) * np.linalg.det(dispatcher) < 0.0
    np.testing.assert_allclose(np.linalg.norm(rig, axis=1), np.linalg.norm(dispatcher, axis=1), atol=1e-6)


def built(bones: dict[str, Bone], side: Side) -> dict[int, Float]:
    """Places of the joints [m] from the wrist, Unity's axes: forward kinematics as a receiver does it."""
    top = side.capitalize()
    hand = bones[f"{top}Hand"].rotation
    places: dict[int, Float] = {}
    for finger, (_, joints) in CHAINS.items():
        at, rotation_vector = np.zeros(3), hand
        for joint, segment in zip(joints, SEGMENTS, strict=False):
            bone = bones[f"{top}{finger}{segment}"]
            at = at + rotation_vector @ bone.position_m
            rotation_vector = rotation_vector @ bone.rotation
            places[joint] = at
    return places


angle = st.floats(-0.4, 1.6)


@settings(max_examples=60)
@given(
    side=st.sampled_from(SIDES),
    angles=st.lists(angle, min_size=20, max_size=20),
    rotation_vector=st.tuples(*[st.floats(-2.0, 2.0)] * 3),
)
def test_the_bones_build_the_pose_again(
    ear: socket.socket, side: Side, angles: list[float], rotation_vector: tuple[float, float, float]
) -> None:
    pose = hand_pose(side, np.array(angles).reshape(5, 4), np.array(rotation_vector))
    _, bones = sent(ear, pose, VmcOutput())
    # The usual rig: an upright camera that looks where the avatar looks; x is its right, y its down, z its front.
    to_unity = np.diag([1.0, -1.0, 1.0])
    for joint, place in built(bones, side).items():
        expected = to_unity @ (pose.position_m[joint] - pose.position_m[WRIST])
        np.testing.assert_allclose(place, expected, atol=1e-6)


@settings(max_examples=40)
@given(side=st.sampled_from(SIDES), angles=st.lists(angle, min_size=20, max_size=20))
def test_an_avatar_with_straight_bones_points_its_fingers_where_ours_point(
    ear: socket.socket, side: Side, angles: list[float]
) -> None:
    # A receiver has bones of its own and takes rotations alone: in the T-pose straight along x, the thumb at 45 deg.
    pose = hand_pose(side, np.array(angles).reshape(5, 4), np.array([0.2, -0.7, 0.4]))
    _, bones = sent(ear, pose, VmcOutput())
    top, sign, half = side.capitalize(), 1.0 if side == "right" else -1.0, np.sqrt(0.5)
    for finger, (_, joints) in CHAINS.items():
        rest = np.array([sign * half, 0.0, half]) if finger == "Thumb" else np.array([sign, 0.0, 0.0])
        rotation_vector = bones[f"{top}Hand"].rotation
        for joint, segment in zip(joints, SEGMENTS, strict=False):
            rotation_vector = rotation_vector @ bones[f"{top}{finger}{segment}"].rotation
            along = -quaternion_to_matrix(pose.orientation_wxyz[joint])[:, 2]
            np.testing.assert_allclose(rotation_vector @ rest, np.diag([1.0, -1.0, 1.0]) @ along, atol=1e-5)


@pytest.mark.parametrize("side", SIDES)
def test_the_bone_of_the_hand_as_the_settings_want_it(ear: socket.socket, side: Side) -> None:
    pose = hand_pose(side, rotation_vector=np.array([0.2, -0.7, 0.4]))
    top, sign = side.capitalize(), 1.0 if side == "right" else -1.0
    _, still = sent(ear, pose, replace(FACING, hand="rest", forearm_m=0.3))
    np.testing.assert_allclose(still[f"{top}Hand"].rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(still[f"{top}Hand"].position_m, [0.3 * sign, 0, 0], atol=1e-6)
    _, unknown = sent(ear, pose, replace(FACING, hand="wrist"))
    assert f"{top}Hand" not in unknown  # no device on the forearm: the avatar keeps it as it is
    assert len(unknown) == 15
    flexed = replace(pose, wrist_angles_rad=np.array([np.pi / 2, 0.0]))  # fingers to the palm's side: down
    _, down = sent(ear, flexed, replace(FACING, hand="wrist"))
    np.testing.assert_allclose(down[f"{top}Hand"].rotation @ [sign, 0, 0], [0, -1, 0], atol=1e-6)
    aside = replace(pose, wrist_angles_rad=np.array([0.0, np.pi / 2]))  # to the thumb of a right hand
    _, to_side = sent(ear, aside, replace(FACING, hand="wrist"))
    np.testing.assert_allclose(to_side[f"{top}Hand"].rotation @ [sign, 0, 0], [0, 0, sign], atol=1e-6)


def test_what_is_not_known_is_left_out(ear: socket.socket) -> None:
    pose = hand_pose("left")
    orientation = pose.orientation_wxyz.copy()
    orientation[8] = np.nan
    _, bones = sent(ear, replace(pose, orientation_wxyz=orientation))
    assert {"LeftIndexIntermediate", "LeftIndexDistal"}.isdisjoint(bones)
    assert len(bones) == 14


@pytest.mark.parametrize("side", SIDES)
def test_the_side_is_determined_by_the_shape_however_the_hand_lies(side: Side) -> None:
    rng = np.random.default_rng(5)
    for rotation_vector in rng.normal(size=(20, 3)) * 2.0:
        assert side_of(hand_pose(side, rng.uniform(-0.2, 1.2, (5, 4)), rotation_vector)) == side
    assert MODELS[side].profile.side == side
    lost = np.full((26, 3), np.nan)
    assert side_of(replace(hand_pose(side), position_m=lost)) is None


def test_the_examples_of_how_a_rig_lies_to_the_avatar_are_what_the_document_says(root: Path) -> None:
    text = (root / "docs" / "outputs.md").read_text()
    part = text[text.index("`vmc.q_avatar_rig` says") :].split("\n\n")[0]
    quaternions = [[float(x) for x in found.split(",")] for found in re.findall(r"\[([^]]+)\]", part)]
    right, up, back = np.eye(3)
    # Where the camera's x, y and z point, in the avatar's frame.
    same_way, from_above, facing = (quaternion_to_matrix(np.array(q)).T for q in quaternions)
    np.testing.assert_allclose(same_way, [right, -up, -back], atol=1e-9)
    np.testing.assert_allclose(from_above, [right, back, -up], atol=1e-9)
    np.testing.assert_allclose(facing, [-right, -up, back], atol=1e-9)
    assert VmcOutput().q_avatar_rig == tuple(quaternions[0])
