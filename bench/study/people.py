"""Simulated participants: a hand with its own bones, a device a little askew, darker or brighter skin.

Each is drawn from the study's seed and a number. What is known of somebody before a trial is one of

- **all**: the exact bones, and exactly how the device sits (never the skin, which no file describes);
- **calibrated**: bones as a hand calibration measures them, and what `master.calibrate.wrist.subject` makes of the
  guided motion this person performed;
- **nothing**: the hand that the rig names, and the pose of the palm in the rig's file.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from msgspec import convert
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import HandProfile, RestJoint, RigCalibration
from common.calibration.files import Matrix4
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.model import FINGER_JOINTS, FINGERS, JOINTS
from master.calibrate.tree_files import provenance

Known = Literal["all", "calibrated", "nothing"]

BONE_SHARE = 0.08  # of each bone's length, either way
ROTATION_RAD, SHIFT_M = np.radians(3.0), 2e-3  # of the device, about and along each axis, either way
REFLECTANCE_SHARE = 0.2
# What `calibrate hand` reaches at 1 mm of noise (docs/calibrate.md): fingers from knuckle to cap, and bones alone.
FINGER_SIGMA_M, BONE_SIGMA_M = 0.43e-3, 0.9e-3
PALM_SIGMA = 0.01  # of the palm's length, by a ruler: 1 mm of 9 cm
_STREAM = 61


@dataclass(frozen=True, slots=True, eq=False)
class Participant:
    """One person with a device on the wrist.

    Attributes:
        number: 1, 2, ...
        seed: Of flesh, skin, room, noise and motion.
        hand: The exact hand.
        measured: The same hand as a hand calibration would have it.
        rig: The device as it really sits.
        reflectance: Of the skin, 1 is usual.
    """

    number: int
    seed: int
    hand: HandProfile
    measured: HandProfile
    rig: RigCalibration
    reflectance: float

    @property
    def name(self) -> str:
        """As folders and tables call this person."""
        return f"participant-{self.number:02d}"


def participant(study_seed: int, number: int, rig: RigCalibration, hand: HandProfile) -> Participant:
    """Draw participant `number` of a study.

    The draw varies around a rig file with a palm pose, and the usual hand.

    Fingers bend as the Digits paper states (preset D), up to how people deviate from it.
    """
    rng = np.random.default_rng([study_seed, _STREAM, number])
    typical = replace(hand, couplings="D", limits_rad="D")
    bones = 1.0 + rng.uniform(-BONE_SHARE, BONE_SHARE, (5, 3))
    palm = 1.0 + float(rng.uniform(-BONE_SHARE, BONE_SHARE))
    rotation, shift = rng.uniform(-ROTATION_RAD, ROTATION_RAD, 3), rng.uniform(-SHIFT_M, SHIFT_M, 3)
    reflectance = 1.0 + float(rng.uniform(-REFLECTANCE_SHARE, REFLECTANCE_SHARE))
    lengths = _lengths(typical)
    wrong = _bone_errors(rng) / lengths
    return Participant(
        number=number,
        seed=1000 * study_seed + number,
        hand=with_bones(typical, palm, bones),
        measured=_measured(
            with_bones(typical, palm * (1.0 + PALM_SIGMA * float(rng.normal())), bones + wrong)
        ),
        rig=rotated(rig, rotation, shift),
        reflectance=reflectance,
    )


def about(rig: RigCalibration) -> RigCalibration:
    """Return the rig file with the spread of device placement between people.

    It is what the maker of the device knows: how differently people wear it, as standard deviations.
    """
    known = {
        "rotation_sigma_deg": round(float(np.degrees(ROTATION_RAD) / np.sqrt(3.0)), 4),
        "shift_sigma_mm": round(float(1e3 * SHIFT_M / np.sqrt(3.0)), 4),
    }
    how = provenance("study", (), known, "how the device sits on the wrists of people")
    return replace(rig, provenance=rig.provenance | {"T_camera_palm": how})


def with_bones(hand: HandProfile, palm: float, bones: Float) -> HandProfile:
    """Return the hand with scaled palm and phalanges.

    The palm (wrist to knuckles) and the radii are multiplied by `palm`, the phalanges by `bones` (5, 3).

    Of the thumb the first bone is its metacarpal.
    """
    rest = dict(hand.rest_joints)
    for finger, chain in enumerate(FINGER_JOINTS):
        names = [JOINTS[joint] for joint in chain]
        own = [np.array(hand.rest_joints[name].position_m) for name in names]
        still = len(names) - 3  # joints that belong to the palm
        place = [palm * position for position in own[:still]]
        for k in range(3):
            place.append(place[-1] + bones[finger, k] * (own[still + k] - own[still + k - 1]))
        for name, position in zip(names, place, strict=True):
            rest[name] = _at(rest[name], position)
    radius = None if hand.radius_m is None else {name: palm * r for name, r in hand.radius_m.items()}
    return replace(hand, rest_joints=rest, radius_m=radius)


def rotated(rig: RigCalibration, rotation_rad: Float, shift_m: Float) -> RigCalibration:
    """Return the rig with its device rotated and shifted about the wrist joint.

    The rotation (3,) about the wrist joint and the shift (3,) are in the camera's axes.
    """
    pose = np.array(rig.T_camera_palm, dtype=np.float64)
    pose[:3, :3] = rotation_vector_to_matrix(rotation_rad) @ pose[:3, :3]
    pose[:3, 3] += shift_m
    return replace(rig, T_camera_palm=_matrix(pose))


def _measured(hand: HandProfile) -> HandProfile:
    """Return the hand with the provenance of measured finger lengths.

    It is the provenance that `calibrate hand` gives to fingers whose length it measured.
    """
    sigma = {"finger_sigma_mm": 1e3 * FINGER_SIGMA_M, "bone_sigma_mm": 1e3 * BONE_SIGMA_M}
    how = {name: provenance("calibrate hand", ("study",), sigma) for name in FINGERS[1:]}
    return replace(hand, provenance=hand.provenance | how)


def _lengths(hand: HandProfile) -> Float:
    """Return the bone lengths (5, 3) [m], three for each finger.

    The thumb's metacarpal is among them.
    """
    place = [
        [np.array(hand.rest_joints[JOINTS[j]].position_m) for j in chain[-4:]] for chain in FINGER_JOINTS
    ]
    return np.linalg.norm(np.diff(np.array(place), axis=1), axis=2)


def _bone_errors(rng: np.random.Generator) -> Float:
    """Draw errors (5, 3) [m] of measured bone lengths.

    Each bone alone has the standard deviation BONE_SIGMA_M, the sum of each finger FINGER_SIGMA_M.
    """
    whole = rng.normal(0.0, FINGER_SIGMA_M, (5, 1)) / 3.0
    # Without their mean, three numbers keep two thirds of their variance.
    alone = rng.normal(0.0, np.sqrt(1.5 * (BONE_SIGMA_M**2 - FINGER_SIGMA_M**2 / 9.0)), (5, 3))
    return whole + alone - alone.mean(axis=1, keepdims=True)


def _at(joint: RestJoint, position: Float) -> RestJoint:
    x, y, z = (float(value) for value in position)
    return replace(joint, position_m=(x, y, z))


def _matrix(pose: Float) -> Matrix4:
    return convert(pose.tolist(), Matrix4)
