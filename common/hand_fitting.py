"""A hand profile from joints that another tracker recorded (Leap, WebXR), so that its hand can be tracked by ours.

Two ways. A tracker that reports joint *frames* (WebXR) shows the rest pose itself in one flat hand. One that reports
joint *places* shows it in a motion: bones are the mean distances, the palm the median places of the roots, and the
hinges follow from the planes in which fingers bend. With n the normal of that plane, from a finger's bones,

    finger   n = R_y(abduction) n_rest: its height in the palm is the same in every frame and gives the hinge's roll
    thumb    n = R_rest R_y(abduction) x: all n lie in one plane, whose normal is the abduction's axis

A finger's rest direction lies in the palm's plane and in that in which it bends where it is most extended; at rest all
its bones are in one line. What is left is how far our joints (`docs/frames.md`) differ from the recorded ones:
abduction turns about the palm's y for every finger, and other hands lean that axis by 10 to 20 degrees.
"""

import numpy as np

from common.arrays import Float, Int
from common.calibration import Couplings, HandProfile, Limits, MarkerMount, Quaternion, RestJoint, Vector3
from common.errors import CalibrationError
from common.geometry import matrix_to_quaternion
from common.hand_model import CHAINS, METACARPALS, PALM_FRAME, TIPS, WEBXR_JOINTS
from common.hand_profiles import THUMB_DORSAL, joint_frame

_BENT = np.radians(5.0)  # a finger that never bends further has no plane
_EXTENDED = 0.1  # share of the frames that counts as most extended
_BASE = 0.3  # metacarpal joints lie about there on the way from the wrist to the knuckles
_BACK_M = 0.012  # the skin of the back above the bones
_MARKERS = ("thumb", "index", "middle", "ring", "little")


def profile_from_rest(
    name: str,
    side: str,
    position_m: Float,
    rotation: Float,
    limits: Limits | None = None,
    couplings: Couplings | None = None,
) -> HandProfile:
    """The profile of a hand whose flat pose is known with all joint frames.

    Args:
        name: Of the profile.
        side: "left" or "right".
        position_m: (25, 3) [m] WebXR joints, in the frame of the wrist joint (OpenXR: -z to the fingers, +y dorsal).
        rotation: (25, 3, 3) their frames in that one.
        limits: Of the angles; None: the default.
        couplings: None: the default.

    Raises:
        CalibrationError: The side is neither.
    """
    if side not in ("left", "right"):
        raise CalibrationError(f"hand {name!r}: side {side!r}: left or right")
    to_palm = np.diag([-1.0, 1.0, -1.0])  # our palm frame has its z to the fingers
    place, turned = position_m @ to_palm, to_palm @ rotation
    joints: dict[str, RestJoint] = {}
    for k, joint in enumerate(WEBXR_JOINTS):
        joints[joint] = RestJoint(position_m=_vector(place[k]), orientation_wxyz=_quaternion(turned[k]))
    knuckle, base = place[CHAINS[2, 0] - 1], place[METACARPALS[1] - 1]
    back = 0.5 * (knuckle + base) + [0.0, _BACK_M, 0.0]
    ends: list[int] = TIPS.tolist()
    tips: dict[str, MarkerMount] = {}
    for marker, tip in zip(_MARKERS, ends, strict=True):
        tips[marker] = MarkerMount(joint=WEBXR_JOINTS[tip - 1], offset_m=(0.0, 0.0, 0.0))
    return HandProfile(
        version=1,
        name=name,
        side="right" if side == "right" else "left",
        rest_joints=joints,
        markers={**tips, "back": MarkerMount(joint=PALM_FRAME, offset_m=_vector(back))},
        limits_rad=limits,
        couplings=couplings,
    )


def profile_from_joints(
    name: str,
    side: str,
    fingers_m: Float,
    limits: Limits | None = None,
    couplings: Couplings | None = None,
) -> HandProfile:
    """The profile of a hand whose joints were recorded in motion.

    Args:
        name: Of the profile.
        side: "left" or "right".
        fingers_m: (T, 5, 4, 3) [m] joints of the fingers' chains (`CHAINS`) in the palm frame, origin at the wrist.
        limits: Of the angles; None: the default.
        couplings: None: the default.

    Raises:
        CalibrationError: The side is neither, or a finger never bends by 5 degrees: its hinge is not known.
    """
    roots = np.median(fingers_m[:, :, 0], axis=0)
    steps = np.diff(fingers_m, axis=2)
    lengths = np.linalg.norm(steps, axis=3)
    bones = steps / lengths[..., None]
    normals = np.cross(bones[:, :, :2], bones[:, :, 1:]).sum(axis=2)  # (T, 5, 3), as long as it is bent
    position, rotation = np.zeros((26, 3)), np.tile(np.eye(3), (26, 1, 1))
    rotation[:] = joint_frame(np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]))
    for f, chain in enumerate(CHAINS):
        if np.linalg.norm(normals[:, f], axis=1).max() < 2.0 * np.sin(_BENT):
            raise CalibrationError(
                f"hand {name!r}: the {_MARKERS[f]} never bends by 5 degrees, so its hinge is not known: record a fist"
            )
        rest = (
            _finger_rest(bones[:, f], normals[:, f])
            if f
            else _thumb_rest(bones[:, 0], normals[:, 0], side == "right")
        )
        ends = np.concatenate([[0.0], np.cumsum(lengths[:, f].mean(axis=0))])
        position[chain] = roots[f] - ends[:, None] * rest[:, 2]
        rotation[chain] = rest
    for base, knuckle in zip(METACARPALS, CHAINS[1:, 0], strict=True):
        position[base] = _BASE * position[knuckle]
        rotation[base] = joint_frame(position[knuckle], np.array([0.0, 1.0, 0.0]))
    from_palm = np.diag([-1.0, 1.0, -1.0])
    return profile_from_rest(
        name, side, position[1:] @ from_palm, from_palm @ rotation[1:], limits, couplings
    )


def _finger_rest(bones: Float, normals: Float) -> Float:
    """Rest frame (3, 3) of a finger of unit bones (T, 3, 3) and bend normals (T, 3), palm frame."""
    bent = np.linalg.norm(normals, axis=1)
    height = normals[:, 1].sum() / bent.sum()
    known = bent > 2.0 * np.sin(_BENT)
    heading = np.cross(normals[known][_extended(bones[known])].sum(axis=0), [0.0, 1.0, 0.0])
    heading /= np.linalg.norm(heading)
    across = np.cross([0.0, 1.0, 0.0], heading)
    hinge = -(np.sqrt(1.0 - height * height) * across + height * np.array([0.0, 1.0, 0.0]))
    return np.stack([hinge, np.cross(-heading, hinge), -heading], axis=1)


def _thumb_rest(bones: Float, normals: Float, right: bool) -> Float:
    """Rest frame (3, 3) of the thumb's CMC; its y is what abduction turns about."""
    _, spread, axes = np.linalg.svd(normals)
    heading = bones[_extended(bones), 0].mean(axis=0)
    # Without a motion of the CMC, any axis across the one hinge would do: that across the rest direction.
    dorsal = axes[2] if spread[1] > 5.0 * spread[2] else np.cross(axes[0], heading)
    dorsal = dorsal * np.sign(dorsal @ (np.array(THUMB_DORSAL) * [1.0 if right else -1.0, 1.0, 1.0]))
    dorsal /= np.linalg.norm(dorsal)
    return joint_frame(heading - (heading @ dorsal) * dorsal, dorsal)


def _extended(bones: Float) -> Int:
    """The tenth of the frames in which a finger (T, 3, 3) is straightest and nearest the palm's plane."""
    straight = (bones[:, 0] * bones[:, 1]).sum(axis=1)
    level = 1.0 - np.abs(bones[:, 0, 1])
    return np.argsort(-(straight + level))[: max(1, round(_EXTENDED * len(bones)))]


def _vector(value: Float) -> Vector3:
    x, y, z = (float(number) for number in value)
    return x, y, z


def _quaternion(rotation: Float) -> Quaternion:
    w, x, y, z = (float(number) for number in matrix_to_quaternion(rotation))
    return w, x, y, z
