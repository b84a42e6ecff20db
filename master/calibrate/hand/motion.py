"""A motion capture yields a hand file: palm, bone lengths and couplings.

Bones are mean distances of joints over all good frames, hinges follow from the planes in which fingers bend
(`common/hand/fitting.py`); radii and marker places are those of the generated profile of the same length.

**Palm.** Wrist, knuckles and the thumb's root are one rigid body, whose shape is the mean of all frames laid
on one another (generalised Procrustes analysis; Gower, 1975). The palm frame (origin at the wrist, +z to the
fingers, +y out of the back) is that in which this shape lies nearest to the scaled generated profile's.
Knuckles and wrist are nearly a plane, its own mirror image: which hand it is follows from the fingers, which
bend into the palm, towards -y.

**Couplings.** DIP = ratio . PIP and MCP = ratio . PIP of index ... little, least squares through zero (the
straight finger in the palm's plane) with the weights of Huber. Noise of the joints, which shows in bones that
change their length, rotates short bones; it is taken out of the spread. A DIP that keeps its ratio to half a
degree was not measured: trackers make it from the PIP (the Leap does so). An MCP off by more than 25 degrees
has no coupling: people bend it alone as well.
"""

from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float, Int
from common.calibration import Couplings, HandProfile, Provenance, RestJoint
from common.errors import FitError
from common.geometry.transforms import fit_rigid, matrix_to_quaternion
from common.hand.fitting import joint_angles, profile_from_joints
from common.hand.model import CHAINS, FINGERS, JOINTS, METACARPALS, WRIST, HandModel
from common.hand.profiles import generated_profile, joint_frame, preset_couplings
from master.calibrate.hand.measure import TOOL, hand_length_of
from master.calibrate.tree_files import provenance
from master.mocap.bvh_file import JointMotion, Side, known
from master.mocap.compare import joint_track
from master.mocap.read import require

_MOVES_RAD_S = np.radians(10.0)
_BENT_RAD = np.radians(15.0)  # the PIP, where it determines a ratio
_RANGE_RAD = np.radians(20.0)  # of the PIP from the 5th to the 95th hundredth, at least
_MADE_RAD = np.radians(0.5)
_NO_COUPLING_RAD = np.radians(25.0)
_ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Ratio:
    """One angle against the PIP."""

    per_pip: float
    spread_rad: float  # standard deviation about it, that of noise taken out; 0: no more than noise
    noise_rad: float  # standard deviation by noise of the joints


@dataclass(frozen=True, slots=True)
class MotionCouplings:
    """Couplings measured from a motion."""

    moved_s: float  # how long any PIP moved
    dip: Ratio | None  # this and mcp: the ratios; None: fingers bend too little
    mcp: Ratio | None
    couplings: Couplings | None  # those of the default with what was measured; None: nothing was
    remarks: tuple[str, ...]  # what was not taken, and why


def motion_couplings(angles_rad: Float, chains_m: Float, t_ns: Int) -> MotionCouplings:
    """Couplings from a motion with times (T,) [ns].

    Angles (T, 5, 4) [rad] are of `common.hand.fitting.joint_angles`, chains (T, 5, 4, 3) [m] the joints that
    they are of: their noise is estimated from bones that change.
    """
    angles = angles_rad[:, 1:, 1:]
    step_s = 1e-9 * np.diff(t_ns)
    rate = np.abs(np.diff(angles[:, :, 1], axis=0)).max(axis=1) / step_s
    moved_s = float(step_s[(rate > _MOVES_RAD_S) & (step_s < 0.1)].sum())  # longer, two frames are no step
    low, high = np.percentile(angles[:, :, 1], [5.0, 95.0])
    if moved_s < 20.0 or high - low < _RANGE_RAD:
        why = f"fingers move for {moved_s:.0f} s, and {np.degrees(high - low):.0f}° at the PIP"
        return MotionCouplings(
            moved_s, None, None, None, (f"couplings are the default: {why}; 20 s and 20° are needed",)
        )
    first, middle, last = _joint_noise(chains_m)
    dip = _ratio(angles[..., 2], angles[..., 1], (last, middle))
    mcp = _ratio(angles[..., 0], angles[..., 1], (first, middle))
    couplings, remarks, taken = preset_couplings("K"), list[str](), False
    if np.hypot(dip.spread_rad, dip.noise_rad) < _MADE_RAD:
        remarks.append(
            f"DIP is {dip.per_pip:.2f} PIP to {np.degrees(dip.spread_rad):.1f}°: its tracker made it so; the default"
            " stays"
        )
    else:
        couplings, taken = replace(couplings, dip_per_pip=dip.per_pip, dip_spread_rad=dip.spread_rad), True
    if mcp.spread_rad > _NO_COUPLING_RAD or mcp.per_pip <= 0.0:
        remarks.append(
            f"MCP deviates by {np.degrees(mcp.spread_rad):.0f}° from {mcp.per_pip:.2f} PIP: no coupling; the default"
            " stays"
        )
    else:
        couplings, taken = replace(couplings, mcp_per_pip=mcp.per_pip), True
    return MotionCouplings(moved_s, dip, mcp, couplings if taken else None, tuple(remarks))


def _joint_noise(chains_m: Float) -> tuple[float, float, float]:
    """Rms deviations [rad] of MCP, PIP and DIP by joint noise, index ... little.

    A bone from a to b of length L turns by the noise across it; b moves both bones at an angle. The noise is
    that along the bones, whose length does not change in truth, alike in all directions.
    """
    length = np.linalg.norm(np.diff(chains_m[:, 1:], axis=2), axis=3)
    variance = 0.5 * length.var(axis=0).mean(axis=1, keepdims=True)  # of a joint, per axis; (4, 1)
    inverse = 1.0 / length.mean(axis=0)
    joined = inverse[:, :-1] ** 2 + (inverse[:, :-1] + inverse[:, 1:]) ** 2 + inverse[:, 1:] ** 2
    first = np.sqrt((variance * 2.0 * inverse[:, :1] ** 2).mean())
    middle, last = np.sqrt((variance * joined).mean(axis=0))
    return float(first), float(middle), float(last)


def _ratio(angle: Float, pip: Float, noise_rad: tuple[float, float]) -> Ratio:
    """Ratio of angles (T, 4) [rad] to bent PIPs, and the noise of both."""
    bent = pip > _BENT_RAD
    x, y = pip[bent], angle[bent]
    weight, slope = np.ones(len(x)), 0.0
    off, spread = np.zeros(len(x)), 0.0
    for _ in range(_ROUNDS):
        slope = float((weight * x * y).sum() / (weight * x * x).sum())
        off = np.asarray(np.abs(y - slope * x), np.float64)
        spread = max(1.4826 * float(np.median(off)), 1e-6)
        weight = np.minimum(1.0, 1.345 * spread / np.maximum(off, 1e-12))
    typical = off < 4.0 * spread
    spread = float(np.sqrt((off[typical] ** 2).mean()))
    noise = float(np.hypot(noise_rad[0], slope * noise_rad[1]))
    left = spread * spread - noise * noise
    least_share = 0.25  # of a variance: less is noise
    return Ratio(slope, float(np.sqrt(left)) if left > least_share * spread * spread else 0.0, noise)


PALM_JOINTS = (WRIST, *CHAINS[:, 0].tolist(), *METACARPALS)
_SIDES: tuple[Side, Side] = ("right", "left")
_PALM_ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Palm:
    """The palm of one hand."""

    side: Side
    mirrored: bool  # positions were turned over in x first: their axes are left-handed
    chains_m: Float  # (T, 5, 4, 3) [m] the joints of `CHAINS` in the palm frame
    shape_m: Float  # (26, 3) [m] the palm's own joints in it; NaN: not in the file, or not of the palm
    rms_m: float  # residual of the palm's joints from that shape
    outlier: Bool  # (T,) frames whose palm is none


def find_palm(joints_m: Float, side: Side | None, where: str) -> Palm:
    """The palm frame of joints (T, 26, 3) [m]; NaN: not seen.

    Of the given side, or of the side that the joints show.

    Raises:
        FitError: The palm is never seen whole, or the fingers do not determine which side is the back.
    """
    mine = list(PALM_JOINTS)
    there = [joint for joint in mine if known(joints_m[:, joint]).mean() > 0.5]
    if WRIST not in there or len(there) < 4:
        raise FitError(f"{where}: wrist and three knuckles, or more, must be seen in half of the frames")
    body = joints_m[:, there]
    whole = np.asarray(known(body).all(axis=1), np.bool_)
    if whole.sum() < 2:
        raise FitError(f"{where}: wrist, knuckles and thumb root are never seen together")
    shape, T_file_shape, distance = _mean_shape(body[whole])
    outlier = np.zeros(len(joints_m), np.bool_)
    outlier[~whole] = True
    # Four times the median distance of a frame's palm from the shape; real palms arch by a millimetre or two.
    outlier[np.flatnonzero(whole)[distance > max(4.0 * float(np.median(distance)), 5e-3)]] = True
    in_shape = np.full_like(joints_m, np.nan)
    transposed = np.swapaxes(T_file_shape[:, :3, :3], 1, 2)
    moved = joints_m[whole] - T_file_shape[:, None, :3, 3]
    in_shape[whole] = np.einsum("tij,tkj->tki", transposed, moved)
    fits: dict[Side, Float] = {one: palm_axes(shape, there, one) for one in _SIDES}
    shown = _side_shown(in_shape[~outlier], fits, where)
    wanted = side or shown
    flip = np.array([-1.0 if wanted != shown else 1.0, 1.0, 1.0])
    R = palm_axes(shape * flip, there, wanted)
    local = (in_shape * flip - shape[there.index(WRIST)] * flip) @ R
    own = np.full((26, 3), np.nan)
    own[there] = (shape - shape[there.index(WRIST)]) * flip @ R
    rms = float(np.sqrt((distance[~outlier[whole]] ** 2).mean()))
    return Palm(wanted, wanted != shown, local[:, CHAINS], own, rms, outlier)


def _mean_shape(body_m: Float) -> tuple[Float, Float, Float]:
    """Mean shape (K, 3) of points (T, K, 3), poses (T, 4, 4) and distances (T,)."""
    shape = body_m[len(body_m) // 2]
    T = np.zeros((len(body_m), 4, 4))
    for _ in range(_PALM_ROUNDS):
        T = fit_rigid(body_m, np.broadcast_to(shape, body_m.shape))
        back = np.einsum("tji,tkj->tki", T[:, :3, :3], body_m - T[:, None, :3, 3])
        shape = np.asarray(np.median(back, axis=0), np.float64)
    T = fit_rigid(body_m, np.broadcast_to(shape, body_m.shape))
    back = np.einsum("tji,tkj->tki", T[:, :3, :3], body_m - T[:, None, :3, 3])
    return shape, T, np.sqrt(((back - shape) ** 2).sum(axis=2).mean(axis=1))


def palm_axes(shape_m: Float, joints: list[int], side: Side) -> Float:
    """The palm's axes as columns (3, 3), in those of a shape (K, 3) of some joints."""
    rest = HandModel.of(generated_profile("palm", side)).rest_position_m[joints]
    size = np.linalg.norm(shape_m - shape_m.mean(axis=0)) / np.linalg.norm(rest - rest.mean(axis=0))
    return fit_rigid(shape_m, size * rest)[:3, :3]


def _side_shown(in_shape: Float, fits: dict[Side, Float], where: str) -> Side:
    """The side whose fingers flex towards -y, that is about +x; or refuse."""
    chains = in_shape[:, CHAINS[1:]]
    chains = chains[known(chains).all(axis=(1, 2))]
    bones = np.diff(chains, axis=2)
    bones /= np.linalg.norm(bones, axis=3, keepdims=True)
    normal = np.cross(bones[:, :, :2], bones[:, :, 1:]).sum(axis=(0, 1, 2))
    length = float(np.linalg.norm(normal))
    along = {side: float(normal @ R[:, 0]) / max(length, 1e-12) for side, R in fits.items()}
    sure = 0.5  # of the mean axis about which fingers bend, along +x
    right: list[Side] = [side for side in _SIDES if along[side] > sure]
    if len(right) != 1:
        raise FitError(
            f"{where}: fingers bend about an axis that is {along['right']:+.2f} that of a right hand and"
            f" {along['left']:+.2f} that of a left one, where +1 is expected of one alone: record fists; if names were"
            " matched wrongly, give --joints"
        )
    return right[0]


_NEEDED = tuple(JOINTS[joint] for joint in (WRIST, *CHAINS.ravel().tolist()))
_BONES = (("metacarpal", "proximal", "distal"), ("proximal", "intermediate", "distal"))


@dataclass(frozen=True, slots=True, eq=False)
class MotionHand:
    """A hand from a motion capture."""

    profile: HandProfile
    motion: JointMotion
    palm: Palm
    couplings: MotionCouplings  # its couplings; where it determines any, the profile has a posture prior, too
    bone_m: Float  # this and bone_sigma_m: (5, 3) [m] mean and spread over frames
    bone_sigma_m: Float
    frames: int  # how many were used
    length_m: float  # from the wrist to the end of the middle finger


def hand_from_motion(motion: JointMotion, name: str) -> MotionHand:
    """Make a hand file of a motion.

    Its wrist and the four joints of each finger at least are needed; `side` None: by the geometry.

    Raises:
        RecordingError: Joints are missing.
        FitError: Too few good frames, no hand by its size, or fingers that do not determine the side.
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
    mean, sd, frames = bones.mean(axis=0), bones.std(axis=0), int(good.sum())
    hand = MotionHand(profile, motion, palm, couplings, mean, sd, frames, length_m)
    origin = _provenance(hand)
    back = profile.markers["back"]
    markers = like.markers | {"back": back}
    profile = replace(profile, markers=markers, radius_m=like.radius_m, provenance=origin)
    HandModel.of(profile)  # refuses what cannot be
    return changed(hand, profile=profile)


def _good(palm: Palm) -> Bool:
    """The frames (T,) with all joints, no outlier palm, and usual bone lengths."""
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
