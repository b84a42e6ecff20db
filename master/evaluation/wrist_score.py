"""Errors of a wrist device against exact truth.

They cover its laser points, its fingertips, and the hand solved from them. Every strobe cycle of the truth
counts once, also one of which nothing was made: what is not found is missed there.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import RecordingError
from common.hand.model import FINGER_JOINTS, FINGERS
from common.messages import FINGER_COUNT, SolverMode, WristDetections
from common.recording.frame_recording import FrameRecording, Illumination
from common.recording.recorded_files import TRUTH, has_truth, read_truth
from master.evaluation.score import put
from master.outputs.poses import Poses
from master.rig.setup import WristSetup

GROUPS = ("palm", *FINGERS, "thenar")  # rows of the truth's laser line
_OF_FINGERS = slice(1, 1 + FINGER_COUNT)
# up to here the laser measures the flexion; from about 95 degrees its point stands still
_STRAIGHT_RAD = np.radians(85.0)
_OF_WRIST = "wrist_"
_ARRAYS = ("t_ns", "laser_pt", "laser_len_vis", "tip_uv", "tip_visible", "joints", "angles")
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class WristTruth:
    """Exact values at N strobe cycles, in the frame of the wrist camera; NaN: none."""

    t_ns: Int  # (N,) middle of the exposure of the laser frames
    # (N, 7, 3) what an ideal camera makes of the part of the line that is lit and seen on each of `GROUPS`
    laser_m: Float
    laser_seen_m: Float  # (N, 7) length of that part
    tip_uv: Float  # (N, 5, 2) fingertips [px], whether seen or not
    tip_visible: Bool  # (N, 5) whether they are seen
    joints_m: Float  # (N, 25, 3) WebXR joints
    pip_rad: Float  # (N, 5) PIP of index ... little, before them the MCP of the thumb

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together; the ValueError names the array."""
        n, groups = len(self.t_ns), len(GROUPS)
        for name, shape in (
            ("laser_m", (n, groups, 3)),
            ("laser_seen_m", (n, groups)),
            ("tip_uv", (n, FINGER_COUNT, 2)),
            ("tip_visible", (n, FINGER_COUNT)),
            ("joints_m", (n, 25, 3)),
            ("pip_rad", (n, FINGER_COUNT)),
        ):
            if (found := getattr(self, name).shape) != shape:
                raise ValueError(f"{name} has shape {found}, expected {shape}")


def load_wrist_truth(recording: FrameRecording, camera: str) -> WristTruth | None:
    """Truth of a rendered wrist recording; None where there is none.

    Its rows stand at its own `t_ns` where it has some; else there is one for each laser frame of `camera`. Where
    frames were lost since, it is not known which: there is none then, with a warning. In a recording of both kinds its
    keys begin with `wrist_`.

    Raises:
        RecordingError: truth.npz is broken, lacks an array, or leads out of the folder.
    """
    if not has_truth(recording.folder):
        return None
    path = recording.folder / TRUTH
    prefix = _OF_WRIST if recording.manifest.kind == "both" else ""
    found = read_truth(recording.folder, also=[prefix + name for name in _ARRAYS])
    data = {name.removeprefix(prefix): array for name, array in found.items()}
    rows = [row.t_ns for row in recording.frames_of(camera) if row.illumination is Illumination.LASER]
    points = len(np.atleast_1d(data["laser_pt"])) if "laser_pt" in data else len(rows)
    if "t_ns" not in data and points != len(rows):
        text = "%s: nothing is scored: it has %d rows and no t_ns, camera %s has %d laser frames"
        _LOG.warning(text, path, points, camera, len(rows))
        return None
    try:
        return WristTruth(
            t_ns=data["t_ns"].astype(np.int64) if "t_ns" in data else np.array(rows, np.int64),
            laser_m=data["laser_pt"].astype(np.float64),
            laser_seen_m=data["laser_len_vis"].astype(np.float64),
            tip_uv=data["tip_uv"].astype(np.float64),
            tip_visible=np.asarray(data["tip_visible"], np.bool_),
            joints_m=data["joints"].astype(np.float64),
            pip_rad=data["angles"].astype(np.float64)[:, [3, 7, 11, 15, 19]],
        )
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise RecordingError(
            f"{path}: not the truth of the {len(rows)} strobe cycles of camera {camera!r}: {error}"
        ) from error


def score_wrist(poses: Poses, truth: WristTruth) -> dict[str, float]:
    """Errors of the solved poses; a score with nothing to average is left out.

    Returns:
        laser_mm, laser_mm_<finger>: Median distance of the laser points found from those of the truth, where at
            least 2 mm of line is seen on the finger.
        laser_right: Share of these (found or not) whose point is found, and nearer to this finger's true point than
            to that of any other finger, the palm or the thenar. laser_missed: how many are not found.
        pip_rms_deg, pip_rms_deg_<finger>: RMS error of the PIP up to 85 degrees, of fingers that are tracked;
            pip_untracked: how many others there are.
        pip_deg, joint_mm: Mean over the fingers, and joints, that are valid.
        both_<finger>: Strobe cycles in which laser (2 mm of line or more) and fingertip are seen, by the truth;
            both_ik_<finger>: those of them that were solved from both; both_pip_deg_<finger>: mean error of the PIP
            (thumb: MCP) in those where the finger is valid.
        frames_without_pose: Poses of which nothing is valid.
    """
    row = rows_at(truth.t_ns, poses.t_ns)
    out = score_laser(at_rows(poses.laser_m, row), truth) | _score_both(poses, row, truth)
    there = row >= 0
    found = row[there]
    error = np.degrees(poses.angles_rad[found][:, 1:, 2] - truth.pip_rad[there, 1:])
    tracked = _any_of(poses.tracked[found]) & np.isfinite(error)
    typical = truth.pip_rad[there, 1:] <= _STRAIGHT_RAD
    put(out, "pip_rms_deg", error[tracked & typical], _rms)
    for f, name in enumerate(FINGERS[1:]):
        put(out, f"pip_rms_deg_{name}", error[:, f][(tracked & typical)[:, f]], _rms)
    out["pip_untracked"] = float((typical & ~tracked).sum())
    valid = poses.valid[found][:, 1:]
    distance = np.linalg.norm(poses.position_m[found][:, 1:] - truth.joints_m[there], axis=2)
    put(out, "pip_deg", np.abs(error[_any_of(poses.valid[found]) & np.isfinite(error)]), np.mean)
    put(out, "joint_mm", 1e3 * distance[valid & np.isfinite(distance)], np.mean)
    out["frames_without_pose"] = float((~valid.any(axis=1)).sum())
    return out


def cycles_missed(poses: Poses, truth: WristTruth) -> int:
    """Count the strobe cycles of a recording without a pose."""
    return int((rows_at(truth.t_ns, poses.t_ns) < 0).sum())


def score_cycles(
    setup: WristSetup, messages: Sequence[WristDetections], truth: WristTruth
) -> dict[str, float]:
    """Errors of the laser points of strobe cycles, whatever hand is solved from them.

    Returns:
        cycles; cycles_missed: how many of the truth's are missing; of the laser points as `score_wrist`.
    """
    row = rows_at(truth.t_ns, np.array([message.t_ns for message in messages], np.int64))
    uv = np.array([message.laser_uv for message in messages]).reshape(-1, FINGER_COUNT, 2)
    counted = {"cycles": float(len(messages)), "cycles_missed": float((row < 0).sum())}
    return counted | score_laser(at_rows(setup.on_plane(uv), row), truth)


def score_tips(messages: list[WristDetections], truth: WristTruth) -> dict[str, float]:
    """Errors of the fingertips that the slave reported.

    Returns:
        tip_px: Median distance of those found from the visible ones of the truth.
        tip_within_6px: Share of the visible tips, found or not, that are found within 6 px.
        tip_false: Share of the reported tips that are none: the tip of that finger is not seen, or more than 15 px
            away.
    """
    row = rows_at(truth.t_ns, np.array([message.t_ns for message in messages], np.int64))
    uv = np.array([message.tip_uv for message in messages]).reshape(-1, FINGER_COUNT, 2)
    found = at_rows(uv, row)
    off = np.linalg.norm(found - truth.tip_uv, axis=2)
    reported = np.isfinite(found).all(axis=2)
    out: dict[str, float] = {}
    put(out, "tip_px", off[reported & truth.tip_visible], np.median)
    # of a tip that is found, and of one that is false: half the width of a fingertip
    near_px, far_px = 6.0, 15.0
    put(out, "tip_within_6px", (reported & (off <= near_px))[truth.tip_visible].astype(np.float64), np.mean)
    right = truth.tip_visible & (off <= far_px)
    put(out, "tip_false", (~right)[reported].astype(np.float64), np.mean)
    return out


def score_laser(found: Float, truth: WristTruth) -> dict[str, float]:
    """Score the laser points (N, 5, 3) of all strobe cycles, as in `score_wrist`."""
    to_groups = 1e3 * np.linalg.norm(found[:, :, None] - truth.laser_m[:, None], axis=3)
    own = np.stack([to_groups[:, f, 1 + f] for f in range(FINGER_COUNT)], axis=1)
    reported = np.isfinite(found).all(axis=2)
    clear = clear_line(truth)
    nearest = np.nan_to_num(to_groups, nan=np.inf).min(axis=2)
    right = reported & (own <= nearest)
    out: dict[str, float] = {}
    put(out, "laser_mm", own[clear & reported], np.median)
    for f, name in enumerate(FINGERS):
        put(out, f"laser_mm_{name}", own[:, f][(clear & reported)[:, f]], np.median)
    put(out, "laser_right", right[clear].astype(np.float64), np.mean)
    out["laser_missed"] = float((clear & ~reported).sum())
    return out


def _score_both(poses: Poses, row: Int, truth: WristTruth) -> dict[str, float]:
    """Score fingers with laser line and tip in sight; `row` (N,) of the poses."""
    both = clear_line(truth) & truth.tip_visible
    error = np.abs(np.degrees(at_rows(poses.angles_rad[:, :, 2], row) - truth.pip_rad))
    by_ik = at_rows((poses.solver_mode == SolverMode.IK).astype(np.float64), row) == 1.0
    out: dict[str, float] = {}
    for f, name in enumerate(FINGERS):
        out[f"both_{name}"] = float(both[:, f].sum())
        out[f"both_ik_{name}"] = float((both & by_ik)[:, f].sum())
        put(out, f"both_pip_deg_{name}", error[:, f][both[:, f] & np.isfinite(error[:, f])], np.mean)
    return out


def clear_line(truth: WristTruth) -> Bool:
    """(N, 5) whether enough of the line is seen on a finger."""
    clear_m = 2e-3  # of line that is lit and seen: less is no more than a few pixels
    return (truth.laser_seen_m >= clear_m)[:, _OF_FINGERS] & np.isfinite(truth.laser_m[:, _OF_FINGERS, 0])


def rows_at(truth_ns: Int, t_ns: Int) -> Int:
    """Row of the same time in rising `t_ns` (T,) for each true cycle; -1: none."""
    if not len(t_ns):
        return np.full(len(truth_ns), -1)
    after = np.clip(np.searchsorted(t_ns, truth_ns), 0, len(t_ns) - 1)
    before = np.maximum(after - 1, 0)
    row = np.where(np.abs(t_ns[before] - truth_ns) < np.abs(t_ns[after] - truth_ns), before, after)
    match_ns = 5_000_000  # less than half the time from one frame to the next
    return np.where(np.abs(t_ns[row] - truth_ns) <= match_ns, row, -1)


def at_rows(values: Float, row: Int) -> Float:
    """Rows of values (T, ...); NaN where `row` is -1."""
    out = np.full((len(row), *values.shape[1:]), np.nan)
    out[row >= 0] = values[row[row >= 0]]
    return out


def _any_of(joints: Bool) -> Bool:
    """Mask (N, 4) of index ... little with any joint but the metacarpal in (N, 26)."""
    return np.stack([joints[:, list(finger[1:])].any(axis=1) for finger in FINGER_JOINTS[1:]], axis=1)


def _rms(error: Float) -> object:
    return np.sqrt(np.mean(error**2))
