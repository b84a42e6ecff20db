"""Hand file from a motion capture.

Bones and hinges from its joints, couplings where it is long enough.

Bones are the mean distances of joints over all good frames, hinges follow from the planes in which fingers bend
(`common/hand/fitting.py`). What no motion capture gives is taken from the generated profile of the same length: radii,
where the marker sits on the tips, where the marker on the back is.
"""

from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.calibration import HandProfile, Provenance, RestJoint
from common.errors import FitError
from common.geometry.transforms import matrix_to_quaternion
from common.hand.fitting import profile_from_joints
from common.hand.model import CHAINS, FINGERS, JOINTS, METACARPALS, WRIST, HandModel
from common.hand.posture import joint_angles
from common.hand.profiles import generated_profile, joint_frame
from master.calibrate.hand.measure import hand_length_of
from master.calibrate.hand.motion_couplings import MotionCouplings, motion_couplings
from master.calibrate.hand.palm import Palm, find_palm
from master.calibrate.hand.save import TOOL
from master.calibrate.tree_files import provenance
from master.mocap.compare import joint_track
from master.mocap.joint_motion import JointMotion
from master.mocap.read import require
from master.mocap.track import known

_NEEDED = tuple(JOINTS[joint] for joint in (WRIST, *CHAINS.ravel().tolist()))
_BONES = (("metacarpal", "proximal", "distal"), ("proximal", "intermediate", "distal"))


@dataclass(frozen=True, slots=True, eq=False)
class MotionHand:
    """A hand from a motion capture.

    Attributes:
        profile: The hand file.
        motion: What it is from.
        palm: Its palm.
        couplings: Its couplings; where it determines any, the profile has a posture prior, too.
        bone_m, bone_sigma_m: (5, 3) [m] mean and spread over frames.
        frames: How many were used.
        length_m: From the wrist to the end of the middle finger.
    """

    profile: HandProfile
    motion: JointMotion
    palm: Palm
    couplings: MotionCouplings
    bone_m: Float
    bone_sigma_m: Float
    frames: int
    length_m: float


def hand_from_motion(motion: JointMotion, name: str) -> MotionHand:
    """Make a hand file of a motion.

    Args:
        motion: Wrist and the four joints of each finger at least; its `side` None: by the geometry.
        name: Of the hand.

    Raises:
        RecordingError: Joints are missing.
        FitError: Too few good frames, no hand by its size, or the fingers do not determine which side is the back.
        CalibrationError: A finger never bends.
    """
    require(motion, _NEEDED, "a hand")
    joints = joint_track(motion).position_m
    palm = find_palm(joints, motion.side, motion.source)
    good = _good(palm)
    least_frames = 60
    if good.sum() < least_frames:
        raise FitError(
            f"{motion.source}: {int(good.sum())} of {len(good)} frames show the whole hand with bones that keep their"
            f" length; {least_frames} are needed"
        )
    chains = palm.chains_m[good]
    bones = np.linalg.norm(np.diff(chains, axis=2), axis=3)
    profile = profile_from_joints(name, palm.side, chains)
    couplings = motion_couplings(joint_angles(HandModel.of(profile), chains), chains, motion.t_ns[good])
    if couplings.couplings is None:  # too little moves for a posture prior, too
        profile = replace(profile, couplings=None, posture=None)
    else:
        profile = replace(profile, couplings=couplings.couplings)
    profile = replace(profile, rest_joints=profile.rest_joints | _metacarpals(palm.shape_m))
    length_m = hand_length_of(HandModel.of(profile))
    try:
        like = generated_profile(name, palm.side, length_m)
    except ValueError as error:
        raise FitError(f"{motion.source}: {error}: is --unit right?") from error
    hand = MotionHand(
        profile, motion, palm, couplings, bones.mean(axis=0), bones.std(axis=0), int(good.sum()), length_m
    )
    origin = _provenance(hand)
    back = profile.markers["back"]
    profile = replace(
        profile, markers=like.markers | {"back": back}, radius_m=like.radius_m, provenance=origin
    )
    HandModel.of(profile)  # refuses what cannot be
    return changed(hand, profile=profile)


def _good(palm: Palm) -> Bool:
    """Select the frames (T,) with all joints and a plausible hand.

    The palm is no outlier and the bones are as long as usual.
    """
    whole = np.asarray(known(palm.chains_m).all(axis=(1, 2)), np.bool_) & ~palm.outlier
    lengths = np.linalg.norm(np.diff(palm.chains_m, axis=2), axis=3)
    if not whole.any():
        return whole
    middle = np.median(lengths[whole], axis=0)
    spread = np.median(np.abs(lengths[whole] - middle), axis=0)
    outlier, floor_m = 6.0, 2e-3  # of a bone's spread about its median, and at least
    typical = np.abs(lengths - middle) < np.maximum(outlier * spread, floor_m)
    return whole & np.asarray(typical.all(axis=(1, 2)), np.bool_)


def _metacarpals(shape_m: Float) -> dict[str, RestJoint]:
    """Rest joints of the metacarpals that a file has, each towards its knuckle."""
    out: dict[str, RestJoint] = {}
    for base, knuckle in zip(METACARPALS, CHAINS[1:, 0].tolist(), strict=True):
        if not (np.isfinite(shape_m[base]).all() and np.isfinite(shape_m[knuckle]).all()):
            continue
        frame = joint_frame(shape_m[knuckle] - shape_m[base], np.array([0.0, 1.0, 0.0]))
        x, y, z = (float(value) for value in shape_m[base])
        w, i, j, k = (float(value) for value in matrix_to_quaternion(frame))
        out[JOINTS[base]] = RestJoint(position_m=(x, y, z), orientation_wxyz=(w, i, j, k))
    return out


def missing(hand: MotionHand) -> list[str]:
    """What was not in the file, and what stands for it."""
    bases = [JOINTS[joint] for joint in METACARPALS if not np.isfinite(hand.palm.shape_m[joint]).all()]
    out = [f"{', '.join(bases)}: at 0.3 of the way to the knuckle"] if bases else []
    out.append("radii, painted caps and the marker on the back: those of a generated hand of this length")
    out.append("limits: the default (K), moved out to where the motion went")
    return out


def _provenance(hand: MotionHand) -> dict[str, Provenance]:
    data = (Path(hand.motion.source).name,)
    residual = {
        "palm_rms_mm": round(1e3 * hand.palm.rms_m, 3),
        "bone_spread_mm": round(1e3 * float(hand.bone_sigma_m.mean()), 3),
        "frames": float(hand.frames),
    }
    note = "joints of a motion capture; not in it: " + "; ".join([*missing(hand), *hand.couplings.remarks])
    out = {"rest_joints": provenance(TOOL, data, residual, note)}
    found = hand.couplings
    if found.couplings is not None and found.dip is not None and found.mcp is not None:
        spreads = {
            "dip_spread_deg": round(float(np.degrees(found.dip.spread_rad)), 2),
            "mcp_spread_deg": round(float(np.degrees(found.mcp.spread_rad)), 2),
            "moved_s": round(found.moved_s, 1),
        }
        out["couplings"] = provenance(TOOL, data, spreads, "index ... little together")
    return out


def motion_lines(hand: MotionHand) -> list[str]:
    """The report for a person."""
    palm, found = hand.palm, hand.couplings
    lines = [*hand.motion.remarks]
    text = "from its names or --side" if hand.motion.side else "as its fingers bend"
    lines.append(
        f"{palm.side} hand ({text}), {1e3 * hand.length_m:.0f} mm long, from {hand.frames} of {len(palm.outlier)}"
        f" frames; the palm's joints keep their places to {1e3 * palm.rms_m:.1f} mm"
    )
    if palm.mirrored:
        other = "left" if palm.side == "right" else "right"
        lines.append(
            f"its geometry is that of a {other} hand: its axes are left-handed (Unity, Unreal) and were turned over;"
            f" if it is a {other} hand, give --side {other}"
        )
    lines.append(f"{'bone':30}{'mm':>8}{'spread':>8}")
    for finger, label in enumerate(FINGERS):
        for k, bone in enumerate(_BONES[min(finger, 1)]):
            mean, sigma = 1e3 * hand.bone_m[finger, k], 1e3 * hand.bone_sigma_m[finger, k]
            loose_m = 3e-3  # a bone that changes more has no joint centres at its ends
            loose = "  changes with the pose: no joint centres" if sigma > 1e3 * loose_m else ""
            lines.append(f"{label + ' ' + bone:30}{mean:8.1f}{sigma:8.2f}{loose}")
    if found.dip is not None and found.mcp is not None:
        lines.append(
            f"couplings, by {found.moved_s:.0f} s of movement: DIP {found.dip.per_pip:.2f} PIP ±"
            f" {np.degrees(found.dip.spread_rad):.0f}°, MCP {found.mcp.per_pip:.2f} PIP ±"
            f" {np.degrees(found.mcp.spread_rad):.0f}°"
        )
    lines += found.remarks
    return lines + [f"not in the file: {what}" for what in missing(hand)]


def motion_json(hand: MotionHand) -> dict[str, object]:
    """The same for programs [mm, degrees]."""
    found = hand.couplings
    ratios = {
        name: {
            "per_pip": ratio.per_pip,
            "spread_deg": float(np.degrees(ratio.spread_rad)),
            "noise_deg": float(np.degrees(ratio.noise_rad)),
        }
        for name, ratio in (("dip", found.dip), ("mcp", found.mcp))
        if ratio is not None
    }
    return {
        "side": hand.palm.side,
        "mirrored": hand.palm.mirrored,
        "hand_length_mm": round(1e3 * hand.length_m, 2),
        "frames": hand.frames,
        "palm_rms_mm": round(1e3 * hand.palm.rms_m, 4),
        "bones": {
            f"{label}_{bone}": {
                "mm": round(1e3 * float(hand.bone_m[finger, k]), 3),
                "spread_mm": round(1e3 * float(hand.bone_sigma_m[finger, k]), 3),
            }
            for finger, label in enumerate(FINGERS)
            for k, bone in enumerate(_BONES[min(finger, 1)])
        },
        "moved_s": round(found.moved_s, 2),
        "couplings": ratios,
        "not_in_the_file": missing(hand),
        "remarks": [*hand.motion.remarks, *found.remarks],
    }
