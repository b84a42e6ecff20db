"""Trials of a recording.

When each pose was held, and how a solved run compares with the truth.
"""

import csv
from pathlib import Path

import numpy as np
from msgspec import Struct

from common.arrays import Bool, Float
from common.errors import RecordingError
from common.hand.model import FINGER_JOINTS
from common.recording.frame_recording import FrameRecording
from common.recording.recorded_files import read_truth
from common.sim.motion import POSES
from master.evaluation.wrist_score import WristTruth, at_rows, clear_line, load_wrist_truth, rows_at
from master.outputs.poses import Poses
from master.study.session import COLUMNS, TRIALS, Held

LETTERS = dict(zip("ABCDEF", POSES, strict=True))  # as the paper names the poses
Five = tuple[float, ...]
Flags = tuple[bool, ...]


class Trial(Struct, frozen=True, kw_only=True):
    """One pose that one participant held once; fingers thumb ... little.

    Attributes:
        pip_deg: Median over its strobe cycles with the finger tracked; if it was in none, of those where there is
            an angle. Of the thumb the MCP. NaN (null in a file): no angle at all.
        truth_deg: Mean true angle over the strobe cycles that pip_deg is of.
        tracked: In at least half of its strobe cycles a laser point or fingertip measured the finger.
        solver_mode: The highest `SolverMode` that half of the tracked strobe cycles have.
        ambiguous: In at least half of the tracked strobe cycles another pose explained as much.
        laser_seen, tip_seen: In at least half of its cycles at least 2 mm of laser line, the fingertip, are in sight
            by the truth.
        cycles: How many were held.
    """

    participant: str
    block: int
    pose: str
    pip_deg: Five
    truth_deg: Five
    tracked: Flags
    solver_mode: tuple[int, ...]
    ambiguous: Flags
    laser_seen: Flags
    tip_seen: Flags
    cycles: int


def trials_of(recording: FrameRecording, camera: str, name: str, poses: Poses) -> list[Trial]:
    """What was made of each trial of a recording with truth.

    Args:
        recording: With truth.npz, and trials.csv or the key `label` in truth.npz.
        camera: That of the wrist device.
        name: Of the participant.
        poses: The recording, solved.

    Raises:
        RecordingError: There is no truth, or nothing that states which pose was held when; the text states what to do.
    """
    truth = load_wrist_truth(recording, camera)
    if truth is None:
        raise RecordingError(
            f"{recording.folder}/truth.npz: missing, or without a time for each row: a study needs the true angles"
            " of every triple (docs/study.md)"
        )
    held = held_in(recording.folder, truth)
    row = rows_at(truth.t_ns, poses.t_ns)
    angle = at_rows(np.degrees(poses.angles_rad[:, :, 2]), row)
    joints = np.stack([poses.tracked[:, list(chain[1:])].any(axis=1) for chain in FINGER_JOINTS], axis=1)
    tracked = (at_rows(joints.astype(np.float64), row) == 1.0) & np.isfinite(angle)
    solver_mode = np.nan_to_num(at_rows(poses.solver_mode.astype(np.float64), row))
    ambiguous = at_rows(poses.ambiguous.astype(np.float64), row) == 1.0
    line = clear_line(truth)
    out: list[Trial] = []
    for one in held:
        own = np.flatnonzero((truth.t_ns >= one.from_ns) & (truth.t_ns <= one.to_ns))
        if not len(own):
            raise RecordingError(
                f"{recording.folder}/{TRIALS}: {one.pose} of block {one.block}: no triple from {one.from_ns} to"
                f" {one.to_ns} ns"
            )
        found = [
            _finger(angle[own, f], np.degrees(truth.pip_rad[own, f]), tracked[own, f], solver_mode[own, f])
            for f in range(5)
        ]
        sure = tracked[own]
        out.append(
            Trial(
                participant=name,
                block=one.block,
                pose=one.pose,
                pip_deg=tuple(round(angle, 3) for angle, _, _ in found),
                truth_deg=tuple(round(true, 3) for _, true, _ in found),
                tracked=_most(sure),
                solver_mode=tuple(rank for _, _, rank in found),
                ambiguous=_most(ambiguous[own] & sure, sure),
                laser_seen=_most(line[own]),
                tip_seen=_most(truth.tip_visible[own]),
                cycles=len(own),
            )
        )
    return out


def held_in(folder: Path, truth: WristTruth) -> list[Held]:
    """Return which pose is held when.

    It is read from trials.csv or else from the labels in truth.npz, by name or by letter (`A_...`).

    Rows of one label that follow one another are one trial; the nth trial of a pose is of block n.

    Raises:
        RecordingError: There is neither, or one of them is broken; the text names file and line.
    """
    path = folder / TRIALS
    if path.exists():
        return read_trials(path)
    data = read_truth(folder, also=["label"])
    if "label" not in data or data["label"].shape != truth.t_ns.shape:
        raise RecordingError(
            f"{folder}: nothing says which pose was held when: it needs {TRIALS} with the columns"
            f" {','.join(COLUMNS)}, or the key label in truth.npz with a name for each triple"
        )
    names = [_pose_of(str(label)) for label in data["label"]]
    out: list[Held] = []
    for k, name in enumerate(names):
        if name is None:
            continue
        t_ns = int(truth.t_ns[k])
        if k and names[k - 1] == name:
            out[-1] = Held(out[-1].block, name, out[-1].from_ns, t_ns)
        else:
            out.append(Held(1 + sum(one.pose == name for one in out), name, t_ns, t_ns))
    if not out:
        known = ", ".join(f"{letter}_... or {pose}" for letter, pose in LETTERS.items())
        raise RecordingError(f"{folder}/truth.npz: label: none of them is a pose of the study: {known}")
    return out


def read_trials(path: Path) -> list[Held]:
    """Read trials.csv.

    Raises:
        RecordingError: It cannot be read, or a line is broken; the text names it.
    """
    try:
        with path.open(newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path}: cannot read: {error}") from error
    if not rows or tuple(rows[0]) != COLUMNS:
        raise RecordingError(f"{path}: header must be {','.join(COLUMNS)}")
    out: list[Held] = []
    for number, row in enumerate(rows[1:], start=2):
        try:
            block, pose, from_ns, to_ns = row
            one = Held(int(block), pose, int(from_ns), int(to_ns))
        except ValueError as error:
            raise RecordingError(f"{path}: line {number}: expected {','.join(COLUMNS)}, got {row}") from error
        if one.pose not in POSES:
            raise RecordingError(f"{path}: line {number}: pose {one.pose!r} is none of {', '.join(POSES)}")
        if one.to_ns < one.from_ns:
            raise RecordingError(f"{path}: line {number}: to_ns is before from_ns")
        if any((one.block, one.pose) == (other.block, other.pose) for other in out):
            raise RecordingError(f"{path}: line {number}: {one.pose} is twice in block {one.block}")
        out.append(one)
    if not out:
        raise RecordingError(f"{path}: no trial")
    return out


def _pose_of(label: str) -> str | None:
    """The pose of the study that a label names, by name or by letter."""
    if label in POSES:
        return label
    letter, _, rest = label.partition("_")
    return LETTERS.get(letter) if rest else None


def _finger(angle: Float, true: Float, tracked: Bool, solver_mode: Float) -> tuple[float, float, int]:
    """Evaluate one finger over the strobe cycles (n,) of a trial.

    Returns its median angle, mean truth [deg] and level.
    """
    own = tracked if tracked.any() else np.isfinite(angle)
    if not own.any():
        return float("nan"), float(true.mean()), 0
    return float(np.median(angle[own])), float(true[own].mean()), int(np.median(solver_mode[own]))


def _most(flags: Bool, of: Bool | None = None) -> Flags:
    """Return for each finger whether at least half of its flags (n, 5) are set.

    If `of` (n, 5) is given, only the entries set in it count.
    """
    total = np.full(5, len(flags)) if of is None else of.sum(axis=0)
    return tuple(((flags.sum(axis=0) * 2 >= total) & (total > 0)).tolist())
