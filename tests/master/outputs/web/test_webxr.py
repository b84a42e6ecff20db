"""Hands as JSON: golden numbers by hand, what is not known is null, and the law that nothing is lost."""

import json
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from common.hand.model import JOINTS
from common.messages import HandPose, Source
from master.outputs.web import object_json, webxr_json
from tests.master.outputs.network.hands import hand_pose, known_hand
from tests.results import object_pose

# WebXR Hand Input, "XRHandJoint": the order in which a hand's joints are iterated.
FINGER = ("metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")
ORDER = [
    "wrist",
    *("thumb-metacarpal", "thumb-phalanx-proximal", "thumb-phalanx-distal", "thumb-tip"),
    *(f"index-finger-{part}" for part in FINGER),
    *(f"middle-finger-{part}" for part in FINGER),
    *(f"ring-finger-{part}" for part in FINGER),
    *(f"pinky-finger-{part}" for part in FINGER),
]


def message_of(pose: HandPose) -> dict[str, Any]:
    """What the JSON says. Strict: NaN or Infinity, which JSON has not, fail."""

    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no JSON")

    return json.loads(webxr_json(pose), parse_constant=refuse)


def with_wrist(position_m: list[float], wxyz: list[float]) -> HandPose:
    """A hand whose wrist alone is known."""
    pose = hand_pose("right")
    position, rotation = np.full((26, 3), np.nan), np.full((26, 4), np.nan)
    position[1], rotation[1] = position_m, wxyz
    return replace(pose, position_m=position, orientation_wxyz=rotation)


def test_joints_are_those_of_webxr_in_its_order() -> None:
    message = message_of(hand_pose("right"))
    assert [joint["name"] for joint in message["joints"]] == ORDER
    assert len(ORDER) == 25
    assert (message["type"], message["version"], message["frame"]) == ("hand", 1, "webxr")
    assert (message["hand"], message["t_ns"], message["latency_ms"]) == ("my-right", 5_000_000_000, 12.0)


# What lies 3 cm to the right of, 2 cm below and 50 cm before the camera is at x +3, y -2, z -50 cm for WebXR.
# Joint axes that are the rig's own (no turn) have their x along WebXR's x, their y down and their z away: a half turn
# about x. A quarter turn about the rig's z (x -> y, which points down) takes x to -y of WebXR, y to -x, z to -z: a half
# turn about (1, -1, 0).
@pytest.mark.parametrize(
    ("wxyz", "xyzw"),
    [
        ([1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]),
        ([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], [0.707107, -0.707107, 0.0, 0.0]),
        ([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]),
    ],
)
def test_golden_axes(wxyz: list[float], xyzw: list[float]) -> None:
    wrist = message_of(with_wrist([0.03, 0.02, 0.5], wxyz))["joints"][0]
    assert wrist["position"] == [0.03, -0.02, -0.5]
    assert wrist["orientation"] in (xyzw, [-x if x else 0.0 for x in xyzw])


@pytest.mark.parametrize("side", ["left", "right"])
def test_turned_axes_say_the_same_rotation_as_the_pose(side: str) -> None:
    pose = hand_pose(side, rotation_vector=np.array([0.4, -1.1, 2.0]))
    message = message_of(pose)
    half_rotation = Rotation.from_euler("x", 180, degrees=True)
    expected = half_rotation * Rotation.from_quat(pose.orientation_wxyz[1:], scalar_first=True)
    output = Rotation.from_quat([joint["orientation"] for joint in message["joints"]])
    assert np.degrees((expected.inv() * output).magnitude()).max() < 1e-3
    points = np.array([joint["position"] for joint in message["joints"]])
    assert np.abs(half_rotation.apply(pose.position_m[1:].copy()) - points).max() < 1e-6
    assert message["side"] == side


def test_a_bone_lies_along_minus_z_of_its_joint_and_the_back_of_the_hand_along_y() -> None:
    # What WebXR demands of joint axes, of a flat hand that points up before the camera, its back to the camera.
    rotation_vector = Rotation.from_matrix([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]).as_rotvec()
    joints = message_of(hand_pose("right", rotation_vector=rotation_vector))["joints"]
    for first, second in pairwise(joints[11:15]):
        axes = Rotation.from_quat(first["orientation"]).as_matrix()
        bone = np.subtract(second["position"], first["position"])
        assert -axes[:, 2] @ bone / np.linalg.norm(bone) > math.cos(math.radians(6.0))
        assert axes[:, 1] @ [0.0, 0.0, 1.0] > math.cos(math.radians(6.0))  # z of WebXR: towards the camera
        assert bone[1] > 0.0  # y of WebXR: up


def test_what_is_not_known_is_null_and_stays_alone() -> None:
    message = message_of(with_wrist([0.0, 0.0, 0.4], [1.0, 0.0, 0.0, 0.0]))
    assert message["side"] is None
    wrist, *others = message["joints"]
    assert wrist["position"] is not None
    assert all(joint["position"] is None and joint["orientation"] is None for joint in others)


def test_uncertainty_is_the_root_mean_square_of_the_three_axes() -> None:
    pose = hand_pose("right")
    known = np.ones(26, dtype=bool)
    tracked = known.copy()
    tracked[5] = False
    cov = np.full((26, 3, 3), np.nan)
    cov[1] = np.diag([1e-6, 4e-6, 4e-6])  # 1, 2, 2 mm: sqrt((1 + 4 + 4) / 3)
    pose = known_hand("my-right", pose.position_m, np.tile(np.eye(3), (26, 1, 1)), pose.angles_rad, 7)
    held = replace(pose, cov_m2=cov, tracked=tracked, source=np.full(26, Source.HELD, np.uint8))
    joints = message_of(held)["joints"]
    assert joints[0]["sigma_mm"] == 1.732
    assert joints[1]["sigma_mm"] is None
    assert [joint["tracked"] for joint in joints] == [JOINTS[5] != joint["name"] for joint in joints]
    assert {joint["source"] for joint in joints} == {"held"}
    assert joints[3]["radius"] == 0.008


def test_an_object_and_one_that_was_never_seen() -> None:
    def thing(position: list[float], wxyz: list[float]) -> dict[str, Any]:
        cov = np.full((6, 6), np.nan)
        pose = object_pose(
            "mug", position, wxyz, cov=cov, residual_m=math.nan, source=2, latency_ns=2_000_000
        )
        return json.loads(object_json(pose))

    seen = thing([0.1, 0.2, 0.3], [1.0, 0.0, 0.0, 0.0])
    assert (seen["type"], seen["object"], seen["source"], seen["tracked"]) == ("object", "mug", "tags", True)
    assert (seen["position"], seen["orientation"]) == ([0.1, -0.2, -0.3], [1.0, 0.0, 0.0, 0.0])
    unseen = thing([math.nan] * 3, [math.nan] * 4)
    assert (unseen["position"], unseen["orientation"]) == (None, None)
