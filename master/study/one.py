"""One simulated participant from start to end.

The guided motion, its calibration, the trials, and the results of the processing line.
"""

import shutil
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from msgspec import Struct

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load, save
from common.errors import FitError, RecordingError
from common.geometry.transforms import transform
from common.recording.frame_recording import open_recording
from master.calibrate.wrist.subject import calibrate_subject
from master.commands.summary import read_summary, write_summary
from master.replay.recorded import recorded_cycles
from master.study.line import Inputs, SolverMode, claim, detect, solved, write_exact
from master.study.participant import Known, Participant, about, participant
from master.study.session import TRIAL_S, record_guided, record_trials
from master.study.trials import Trial, trials_of

Condition = tuple[Known, Inputs]
Resume = Literal["frames", "detections"]
CAUSES: tuple[Condition, ...] = (
    ("all", "exact"),
    ("all", "detected"),
    ("calibrated", "exact"),
    ("calibrated", "detected"),
    ("nothing", "detected"),
)
GUIDED, TRIALS = "guided", "trials"  # recordings
KNOWN: tuple[Known, ...] = get_args(Known)
INPUTS: tuple[Inputs, ...] = get_args(Inputs)
DONE, RIG, HAND, CALIBRATED = "made.json", "rig.json", "hand.json", "calibration.json"
_KNUCKLES_M = np.array([0.0, 0.0, 0.08])  # palm frame


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A study as one participant needs it.

    Attributes:
        rig, camera, hand: The device by its file, its camera, and the usual hand.
        seed: Of the study.
        blocks: How often the six poses are made.
        conditions: What is known and from what inputs fingers are solved, in which all trials are judged.
        solver_mode: Of the master; None: by the rig file.
        step: Pixels between the rays that shade skin.
        guided: Strobe cycles of the guided motion.
        out: Folder of the study.
        resume: Take what is there from a study of the same settings: frames that it kept, or what was detected in them
            and calibrated, too. None: nothing.
        keep: Keep all frames, 140 MB for a participant of three blocks.
        trial_s: How long each trial takes [s].
    """

    rig: RigCalibration
    camera: CameraCalibration
    hand: HandProfile
    seed: int
    blocks: int
    conditions: tuple[Condition, ...]
    solver_mode: SolverMode | None
    step: int
    guided: int
    out: Path
    resume: Resume | None
    keep: bool
    trial_s: float = TRIAL_S


class Calibrated(Struct, frozen=True, kw_only=True):
    """What calibration made of a participant's device.

    Attributes:
        said: Its report; where it was refused, why, and the rig file's palm pose and the measured bones are used.
        refused: Whether it was.
        rotation_deg, shift_mm: How far the palm's pose is from the truth, at the knuckles.
        nominal_rotation_deg, nominal_shift_mm: The same of the rig file.
    """

    report: tuple[str, ...]
    refused: bool
    rotation_deg: float
    shift_mm: float
    nominal_rotation_deg: float
    nominal_shift_mm: float


class Outcome(Struct, frozen=True, kw_only=True):
    """A participant's results: trials by condition, such as "calibrated, detected"."""

    participant: str
    reflectance: float
    calibrated: Calibrated | None
    trials: dict[str, list[Trial]]


def name_of(condition: Condition) -> str:
    """How files and tables call it."""
    return ", ".join(condition)


def run_participant(task: Task, number: int) -> Outcome:
    """Let one participant do everything; files go into OUT/participant-NN.

    Raises:
        PhalanxError: Files cannot be written, or the slave ended with an error.
    """
    who = participant(task.seed, number, task.rig, task.hand)
    folder, camera = task.out / who.name, task.camera.name
    asked: dict[Known, list[Inputs]] = {}
    for known, inputs in task.conditions:
        asked.setdefault(known, []).append(inputs)
    _perform(task, who, folder)
    trials: dict[str, list[Trial]] = {}
    for known, kinds in asked.items():
        rig, hand = _knowledge(task, who, folder, known)
        claim(folder / TRIALS, rig)
        for inputs in kinds:
            there = folder / name_of((known, inputs)).replace(", ", "-")
            if inputs == "exact":
                write_exact(folder / TRIALS, camera, there)
            elif not (there / f"detections_{camera}.npz").exists():
                detect(folder / TRIALS, camera, folder / known / HAND, there)
            poses = solved(folder / TRIALS, hand, there, task.solver_mode)
            opened = open_recording(folder / TRIALS)
            trials[name_of((known, inputs))] = trials_of(opened, camera, who.name, poses)
    if not task.keep:
        for recording in (GUIDED, TRIALS):
            shutil.rmtree(folder / recording / camera, ignore_errors=True)
    calibrated = load(folder / "calibrated" / CALIBRATED, Calibrated) if "calibrated" in asked else None
    return Outcome(
        participant=who.name, reflectance=round(who.reflectance, 3), calibrated=calibrated, trials=trials
    )


def _settings(task: Task) -> dict[str, object]:
    """What must be alike for a study to go on from the files of another."""
    return {
        "seed": task.seed,
        "blocks": task.blocks,
        "trial_s": task.trial_s,
        "step": task.step,
        "guided": task.guided,
        "rig": task.rig.name,
        "hand": task.hand.name,
    }


def _may_go_on(task: Task, folder: Path) -> bool:
    """Return whether an earlier run left everything needed to resume.

    That is the frames, or what was computed from them.

    Exact inputs need no frames, the guided motion does.
    """
    if not task.resume or not (folder / DONE).exists() or read_summary(folder / DONE) != _settings(task):
        return False
    needed = [TRIALS, *([GUIDED] if any(known == "calibrated" for known, _ in task.conditions) else [])]
    if all((folder / name / task.camera.name).is_dir() for name in needed):
        return True
    return task.resume == "detections" and all(
        (folder / known).exists() and (inputs == "exact" or (folder / f"{known}-{inputs}").exists())
        for known, inputs in task.conditions
        if known == "calibrated" or inputs == "detected"
    )


def _perform(task: Task, who: Participant, folder: Path) -> None:
    """Render what this participant does, unless it was already and may be taken."""
    if _may_go_on(task, folder):
        if task.resume == "frames":
            for made in (*KNOWN, *("-".join(condition) for condition in product(KNOWN, INPUTS))):
                shutil.rmtree(folder / made, ignore_errors=True)
        return
    try:
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot write: {error.strerror}") from error
    if any(known == "calibrated" for known, _ in task.conditions):
        record_guided(folder / GUIDED, who, task.camera, task.guided, task.step)
    record_trials(folder / TRIALS, who, task.camera, task.blocks, task.step, task.trial_s)
    write_summary(folder / DONE, _settings(task))


def _knowledge(
    task: Task, who: Participant, folder: Path, known: Known
) -> tuple[RigCalibration, HandProfile]:
    """Rig and hand as they are known of this participant, and their files."""
    there = folder / known
    if not (there / HAND).exists():  # else they are what the detections were made with
        there.mkdir()
        rig, hand = task.rig, task.hand
        if known == "all":
            rig, hand = who.rig, who.hand
        elif known == "calibrated":
            rig, hand, calibrated = _calibrated(task, who, folder / GUIDED, there)
            save(there / CALIBRATED, calibrated)
        save(there / RIG, rig)
        save(there / HAND, hand)
    return load(there / RIG, RigCalibration), load(there / HAND, HandProfile)


def _calibrated(
    task: Task, who: Participant, guided: Path, there: Path
) -> tuple[RigCalibration, HandProfile, Calibrated]:
    """Calibrate rig and hand from this participant's guided motion.

    The project's own calibration is used.
    """
    rig, hand, refused = about(task.rig), who.measured, False
    claim(guided, rig)
    save(there / "measured.json", hand)
    detect(guided, task.camera.name, there / "measured.json", there)
    try:
        found = calibrate_subject(list(recorded_cycles(there, task.camera.name)), rig, task.camera, hand)
        rig, hand, report = found.rig, found.hand, tuple(found.report)
    except FitError as error:
        report, refused = (str(error),), True
    rotation, shift = _off(rig, who.rig)
    nominal_rotation, nominal_shift = _off(task.rig, who.rig)
    calibrated = Calibrated(
        report=report,
        refused=refused,
        rotation_deg=round(rotation, 3),
        shift_mm=round(shift, 3),
        nominal_rotation_deg=round(nominal_rotation, 3),
        nominal_shift_mm=round(nominal_shift, 3),
    )
    return rig, hand, calibrated


def _off(rig: RigCalibration, true: RigCalibration) -> tuple[float, float]:
    """How far a palm pose is turned [deg] and, at the knuckles, shifted [mm]."""
    pose, exact = _pose(rig), _pose(true)
    cosine = 0.5 * (float(np.trace(pose[:3, :3] @ exact[:3, :3].T)) - 1.0)
    shift = transform(pose, _KNUCKLES_M) - transform(exact, _KNUCKLES_M)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), 1e3 * float(np.linalg.norm(shift))


def _pose(rig: RigCalibration) -> Float:
    return np.array(rig.T_camera_palm, dtype=np.float64)
