"""Real processing line of the study, from a recording to poses.

It runs the slave as a process, then feeds its detections to the master's own pipeline.

What the sensors by the truth would see without error can take the place of what they saw: whatever is wrong then
comes from the model of the hand, its calibration, or from what a laser point and a fingertip cannot determine.
"""

import subprocess
import sys
from collections import deque
from pathlib import Path
from typing import Literal

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import HandProfile, RigCalibration, save
from common.errors import PhalanxError, RecordingError
from common.hand.model import HandModel
from common.recording.frame_recording import MANIFEST, open_recording
from common.recording.npz import write_npz
from common.recording.recorded_files import TRUTH, read_truth
from master.outputs.files import load_poses
from master.outputs.poses import Poses
from master.replay.solve import solve
from master.rig.setup import RigSetup

SolverMode = Literal["fk", "ik", "auto"]
Inputs = Literal["detected", "exact"]
LASER_SIGMA_PX, TIP_SIGMA_PX = 0.2, 2.0  # claimed of exact places: what a good detection claims of itself
_GROUPS = slice(1, 6)  # rows of the truth's line: palm, thumb ... little, thenar


def claim(folder: Path, rig: RigCalibration) -> None:
    """Store a rig in a recording's manifest as the description of its device.

    The recording states this rig from then on.

    Raises:
        RecordingError: It is none, or cannot be written.
    """
    manifest = open_recording(folder).manifest
    save(folder / MANIFEST, replace(manifest, rig=rig))


def detect(folder: Path, camera: str, hand: Path, out: Path) -> None:
    """Run `phalanx-slave run -o` on a recording of a wrist camera.

    The detections go into the folder `out`.

    Raises:
        PhalanxError: It ended with an error, which the text repeats.
    """
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"detections_{camera}.npz"
    command = ["run", "--name", camera, "--camera", f"replay:{folder}", "--hand", str(hand), "-o", str(file)]
    # What the slave prints as it goes is not kept; its last lines are.
    with subprocess.Popen(
        [sys.executable, "-m", "slave", *command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    ) as child:
        tail = deque(child.stderr or (), maxlen=4)
        code = child.wait()
    if code != 0:
        said = " ".join(line.strip() for line in tail) or "it said nothing"
        raise PhalanxError(f"phalanx-slave {' '.join(command)}: ended with {code}: {said}")


def write_exact(folder: Path, camera: str, out: Path) -> None:
    """Write error-free detections of a recording with truth into the folder `out`.

    They are what sensors without error would have reported.

    The centroid of the lit and seen part of the line on each finger, and the tip where it is seen.

    Raises:
        RecordingError: It has no truth with these, or the file cannot be written.
    """
    names = ("t_ns", "laser_uv", "laser_len_vis", "laser_xyz", "tip_uv", "tip_xyz", "tip_visible")
    truth = read_truth(folder, names, "only a simulated recording has exact inputs")
    recording = open_recording(folder)
    lens = recording.manifest.cameras[camera].intrinsics
    if lens is None:
        raise RecordingError(f"{folder / MANIFEST}: camera {camera!r} has no intrinsics")
    laser = truth["laser_uv"][:, _GROUPS]
    tip = np.where(np.asarray(truth["tip_visible"], np.bool_)[..., None], truth["tip_uv"], np.nan)
    length_px = lens.fx_px * truth["laser_len_vis"][:, _GROUPS] / truth["laser_xyz"][:, _GROUPS, 2]
    numbers = {row.t_ns: row.seq for row in recording.frames_of(camera)}
    out.mkdir(parents=True, exist_ok=True)
    try:
        write_npz(
            out / f"detections_{camera}.npz",
            {
                "t_ns": truth["t_ns"],
                "seq": np.array([numbers[int(t_ns)] for t_ns in truth["t_ns"]], np.int64),
                "laser_uv": laser,
                "laser_sigma_px": _where_seen(laser, LASER_SIGMA_PX),
                "laser_px": np.where(np.isnan(laser[..., 0]), np.nan, length_px),
                "tip_uv": tip,
                "tip_sigma_px": _where_seen(tip, TIP_SIGMA_PX),
                "tip_depth": np.where(np.isnan(tip[..., 0]), np.nan, truth["tip_xyz"][..., 2]),
            },
        )
    except KeyError as error:
        raise RecordingError(f"{folder / TRUTH}: t_ns: no frame at {error}") from error
    except OSError as error:
        raise RecordingError(f"{out}: cannot write: {error.strerror}") from error


def solved(folder: Path, hand: HandProfile, detections: Path, solver_mode: SolverMode | None) -> Poses:
    """Solve the detections of a recording as `phalanx replay` does.

    poses.npz and summary.json are written beside them.

    Raises:
        RecordingError: A file is missing or broken, or nothing was seen at all.
        CalibrationError: Hand and device do not fit together.
    """
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    if solver_mode is not None:
        rig = replace(rig, solver_mode=solver_mode)
    setup = RigSetup.of(rig, recording.manifest.cameras, HandModel.of(hand))
    solve(recording, setup, detections, detections)
    poses = load_poses(detections / "poses.npz")
    if not len(poses):
        raise RecordingError(f"{folder}: no strobed triple was recognised in it")
    return poses


def _where_seen(uv: Float, value: float) -> Float:
    """`value` (T, 5) where uv (T, 5, 2) is seen, NaN elsewhere."""
    return np.where(np.isnan(uv).any(axis=2), np.nan, value)
