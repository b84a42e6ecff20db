"""Profiles describe a hand; its length, presets and limits fill what is open.

Bone lengths are the shares of hand length published by Buchholz, Armstrong & Goldstein (1992); the layout of the palm
is a plain fan. Left profiles are the exact mirror image of right ones. Presets have the limits and couplings of the
two papers, Kalbfleisch (K) and Digits (D).

Spread fingers cannot stay spread in a fist: the collateral ligaments of the MCP tighten, because the head of the
metacarpal is a cam. With f the flexion, F the highest and s what is left there, the range of the abduction is
multiplied by the parabolic limit Kalbfleisch wished for,

    1 - (1 - s) (min(max(f, 0), F) / F)^2

It narrows towards 0, so 0 lies in the range. s is in neither paper: fingers pushed aside by a known force give way by
24 degrees at a straight MCP and by 15 at 90 degrees of flexion, the mean of all fingers of 100 people (Lutsky, Matzon,
Walinchus, Ross & Beredjiklian, J. Hand Surg. Am. 39, 2014); their ratio is taken. Active ranges of young adults have
standard deviations of 5 to 12 degrees, and knuckles reach 20 degrees beyond the straight finger (Mallon, Brown &
Nunley, "Digital ranges of motion: normal values in young adults", J. Hand Surg. Am. 16, 1991): so a preset is a prior
with a width.
"""

from math import radians
from typing import TypeVar

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import (
    Couplings,
    FingerLimits,
    HandProfile,
    Limits,
    MarkerMount,
    Preset,
    RestJoint,
    Vector3,
)
from common.errors import CalibrationError
from common.geometry.transforms import matrix_to_quaternion

# Share of hand length. Fingers: MCP place (x, y, z), heading in the palm plane [deg, positive to the thumb],
# then proximal, middle and distal bone; the tip joint lies one tip radius before the end of the finger.
_FINGER_LAYOUT = {
    "index": ((0.120, -0.030, 0.470), 1.0, (0.245, 0.143, 0.060)),
    "middle": ((0.005, -0.010, 0.480), -1.0, (0.266, 0.170, 0.070)),
    "ring": ((-0.095, -0.030, 0.445), -5.0, (0.244, 0.165, 0.068)),
    "pinky": ((-0.185, -0.065, 0.390), -10.0, (0.204, 0.117, 0.055)),
}
_METACARPAL_BASE = {
    "index": (0.055, -0.035, 0.155),
    "middle": (0.015, -0.030, 0.155),
    "ring": (-0.040, -0.030, 0.145),
    "pinky": (-0.115, -0.045, 0.175),
}
_THUMB_BASE = (0.145, -0.100, 0.190)
_THUMB_HEADING = (0.55, -0.42, 0.72)
THUMB_DORSAL = (0.62, 0.62, -0.10)  # right hand, palm frame: the way the back of a resting thumb faces
_THUMB_BONES = (0.180, 0.165, 0.075)
_TIP_RADIUS = {"thumb": 0.044, "index": 0.038, "middle": 0.038, "ring": 0.036, "pinky": 0.033}
_BACK_MARKER = (0.000, 0.068, 0.290)
_MARKER_JOINT = {
    "thumb": "thumb-tip",
    "index": "index-finger-tip",
    "middle": "middle-finger-tip",
    "ring": "ring-finger-tip",
    "little": "pinky-finger-tip",
}


def generated_profile(name: str, side: str, hand_length_m: float = 0.19) -> HandProfile:
    """Return a profile scaled from the length of the hand [m].

    The length is from wrist crease to middle finger end.

    Raises:
        ValueError: The side is neither "left" nor "right", or the length is no hand's (0.1 to 0.25 m).
    """
    if side not in ("left", "right"):
        raise ValueError(f"side {side!r}: left or right")
    if not 0.1 <= hand_length_m <= 0.25:
        raise ValueError(f"hand length {hand_length_m} m: expected 0.1 to 0.25 m")
    joints: dict[str, tuple[Float, Float]] = {
        "wrist": (np.zeros(3), joint_frame(np.array([0, 0, 1.0]), np.array([0, 1.0, 0])))
    }
    joints |= _thumb() | _fingers()
    mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])

    def rest(position: Float, rotation: Float) -> RestJoint:
        # Mirroring in x turns a rotation R into M R M, and the joint's own x axis back with the second M.
        rotated = np.diag(mirror) @ rotation @ np.diag(mirror)
        w, i, j, k = (float(value) for value in np.round(matrix_to_quaternion(rotated), 8))
        return RestJoint(position_m=_vector(position * mirror * hand_length_m), orientation_wxyz=(w, i, j, k))

    radius = {joint: round(share * hand_length_m, 6) for joint, share in _radii().items()}
    back = _vector(np.array(_BACK_MARKER) * mirror * hand_length_m)
    cap_ahead = 0.15  # cap centroid ahead of the tip joint, share of the tip radius
    markers = {
        marker: MarkerMount(
            joint=joint,
            offset_m=(0.0, 0.0, -round(cap_ahead * radius[joint], 7)),
            # Half a sphere and the cylinder that puts the centroid there, see `master.fabrik.caps`.
            painted_m=round((2.0 - 2.0 * cap_ahead) * radius[joint], 7),
        )
        for marker, joint in _MARKER_JOINT.items()
    }
    markers["back"] = MarkerMount(joint="palm_frame", offset_m=back)
    return HandProfile(
        version=1,
        name=name,
        side="right" if side == "right" else "left",
        rest_joints={joint: rest(*pose) for joint, pose in joints.items()},
        markers=markers,
        radius_m=radius,
    )


def scaled_profile(profile: HandProfile, factor: float) -> HandProfile:
    """The profile with all lengths multiplied by `factor`."""

    def scaled(vector: Vector3) -> Vector3:
        return _vector(factor * np.array(vector))

    return replace(
        profile,
        rest_joints={
            name: replace(joint, position_m=scaled(joint.position_m))
            for name, joint in profile.rest_joints.items()
        },
        markers={
            name: replace(mount, offset_m=scaled(mount.offset_m), painted_m=factor * mount.painted_m)
            for name, mount in profile.markers.items()
        },
        radius_m=None
        if profile.radius_m is None
        else {name: factor * radius for name, radius in profile.radius_m.items()},
    )


def mirrored_profile(profile: HandProfile) -> HandProfile:
    """The other hand of the same person, mirrored in the palm's x; the same name."""

    def mirrored(vector: Vector3) -> Vector3:
        x, y, z = vector
        return -x + 0.0, y, z

    def rotated(joint: RestJoint) -> RestJoint:
        # M R M of a rotation keeps w and x of its quaternion and flips y and z.
        w, x, y, z = joint.orientation_wxyz
        return RestJoint(position_m=mirrored(joint.position_m), orientation_wxyz=(w, x, -y, -z))

    return replace(
        profile,
        side="left" if profile.side == "right" else "right",
        rest_joints={name: rotated(joint) for name, joint in profile.rest_joints.items()},
        markers={
            name: replace(mount, offset_m=mirrored(mount.offset_m)) for name, mount in profile.markers.items()
        },
    )


def _vector(value: Float) -> Vector3:
    x, y, z = (round(float(number), 7) + 0.0 for number in value)
    return x, y, z


def joint_frame(heading: Float, dorsal: Float) -> Float:
    """Joint frame (3, 3): -z along heading (3,), +y nearest to dorsal (3,)."""
    z = -heading / np.linalg.norm(heading)
    y = dorsal - (dorsal @ z) * z
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _thumb() -> dict[str, tuple[Float, Float]]:
    heading = np.array(_THUMB_HEADING) / np.linalg.norm(_THUMB_HEADING)
    frame = joint_frame(heading, np.array(THUMB_DORSAL))
    ends = np.array(_THUMB_BASE) + np.cumsum([0.0, *_THUMB_BONES])[:, None] * heading
    names = ("thumb-metacarpal", "thumb-phalanx-proximal", "thumb-phalanx-distal", "thumb-tip")
    return {name: (end, frame) for name, end in zip(names, ends, strict=True)}


def _fingers() -> dict[str, tuple[Float, Float]]:
    joints: dict[str, tuple[Float, Float]] = {}
    for finger, (mcp, degrees, bones) in _FINGER_LAYOUT.items():
        a = np.radians(degrees)
        heading = np.array([np.sin(a), 0.0, np.cos(a)])
        frame = joint_frame(heading, np.array([0.0, 1.0, 0.0]))
        base, knuckle = np.array(_METACARPAL_BASE[finger]), np.array(mcp)
        joints[f"{finger}-finger-metacarpal"] = (base, joint_frame(knuckle - base, np.array([0.0, 1.0, 0.0])))
        ends = knuckle + np.cumsum([0.0, *bones])[:, None] * heading
        for part, end in zip(
            ("phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip"), ends, strict=True
        ):
            joints[f"{finger}-finger-{part}"] = (end, frame)
    return joints


def _radii() -> dict[str, float]:
    radius = {"palm": 0.075, "wrist": 0.13}
    for finger, tip in _TIP_RADIUS.items():
        stem = "thumb" if finger == "thumb" else f"{finger}-finger"
        radius |= {f"{stem}-metacarpal": 2.0 * tip, f"{stem}-phalanx-proximal": 1.3 * tip}
        if finger != "thumb":
            radius[f"{stem}-phalanx-intermediate"] = 1.2 * tip
        radius |= {f"{stem}-phalanx-distal": 1.1 * tip, f"{stem}-tip": tip}
    return radius


ABDUCTION, FLEXION = 0, 1  # columns of the angles
_FINGERS = Limits.__struct_fields__  # thumb ... little
_ANGLES = ("abduction", "flexion", "pip", "dip")

FloatOrArray = TypeVar("FloatOrArray", float, Float)


def spread_left(flexed: FloatOrArray, at_full_flexion: FloatOrArray) -> FloatOrArray:
    """Share of the abduction range left at a flexion (0 ... 1: share of the highest)."""
    return 1.0 - (1.0 - at_full_flexion) * flexed * flexed


def limit_table(limits: Limits, where: str) -> Float:
    """Low and high (5, 4, 2) [rad] of every angle; CalibrationError if crossed."""
    table = np.array(
        [[getattr(getattr(limits, finger), f"{angle}_rad") for angle in _ANGLES] for finger in _FINGERS]
    )
    crossed = np.argwhere(table[..., 0] > table[..., 1])
    if len(crossed):
        finger, angle = crossed[0]
        raise CalibrationError(
            f"{where}: limits_rad.{_FINGERS[finger]}.{_ANGLES[angle]}_rad: low is above high"
        )
    return table


def tolerance_table(limits: Limits) -> Float:
    """Standard deviations (5, 4) [rad] by which people differ from the limits."""
    return np.array([getattr(limits, finger).tolerance_rad for finger in _FINGERS])


def spread_table(limits: Limits, where: str) -> Float:
    """Share (5,) of the abduction range left at the highest flexion.

    Raises:
        CalibrationError: A range that does not contain 0 cannot narrow towards it.
    """
    shares: list[float] = []
    for finger in _FINGERS:
        of: FingerLimits = getattr(limits, finger)
        low, high = of.abduction_rad
        if of.spread_at_full_flexion < 1.0 and not low <= 0.0 <= high:
            raise CalibrationError(
                f"{where}: limits_rad.{finger}.spread_at_full_flexion: below 1 it narrows abduction_rad towards 0,"
                f" which {low} ... {high} does not contain"
            )
        shares.append(of.spread_at_full_flexion)
    return np.array(shares)


# Radii by place in the finger [share of the middle finger's proximal bone], for profiles without radius_m.
_RADIUS_SHARE = {
    "palm": 0.3,
    "wrist": 0.5,
    "metacarpal": 0.3,
    "proximal": 0.2,
    "intermediate": 0.175,
    "distal": 0.16,
    "tip": 0.145,
}

_TOLERANCE_RAD = (radians(5.0), radians(6.0), radians(4.0), radians(4.0))


def preset_limits(preset: Preset) -> Limits:
    """Joint limits of Kalbfleisch (K) or Digits (D), relative to the rest pose."""
    k = preset == "K"
    abduction = 15.0 if k else 20.0
    thumb = _degrees((-20.0, 50.0), (-15.0, 50.0), (-10.0, 60.0), (-15.0, 85.0))

    def finger(spread: float) -> FingerLimits:
        flexion, pip, dip = (90.0, 110.0, 90.0) if k else (100.0, 120.0, 101.0)
        spread_at_full_flexion = 15.0 / 24.0
        return _degrees((-spread, spread), (0.0, flexion), (0.0, pip), (0.0, dip), spread_at_full_flexion)

    side = finger(abduction)
    return Limits(thumb=thumb, index=side, middle=finger(0.0 if k else abduction), ring=side, little=side)


def preset_couplings(preset: Preset) -> Couplings:
    """DIP per PIP: 2/3 (K), 0.84 (D, Kamper's ratio); MCP = 0.54 PIP: natural (D)."""
    return Couplings(dip_per_pip=2.0 / 3.0 if preset == "K" else 0.84, mcp_per_pip=0.54)


def _degrees(
    abduction: tuple[float, float],
    flexion: tuple[float, float],
    pip: tuple[float, float],
    dip: tuple[float, float],
    spread_at_full_flexion: float = 1.0,
) -> FingerLimits:
    def span(value: tuple[float, float]) -> tuple[float, float]:
        return float(np.radians(value[0])), float(np.radians(value[1]))

    return FingerLimits(
        abduction_rad=span(abduction),
        flexion_rad=span(flexion),
        pip_rad=span(pip),
        dip_rad=span(dip),
        spread_at_full_flexion=spread_at_full_flexion,
        tolerance_rad=_TOLERANCE_RAD,
    )


def radius_share(joint: str) -> float:
    """Radius of an OpenXR joint, as a share of the middle finger's proximal bone."""
    return _RADIUS_SHARE[joint.rsplit("-", 1)[-1]]
