"""What a participant does before the camera, and what the real line makes of it.

Before the trials comes the guided motion of `calibrate wrist subject`. Every block has the six poses in an order of
its own: from one pose to the next the fingers go within half a second, then hold for a fifth of one; a trial is what is
held. Each trial has its own posture, near the pose, and drifts slowly as hands do (`common.sim.wrist.motion.Stations`).
Frames are rendered, detected by `phalanx-slave run -o` and solved as a replay is.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from msgspec.structs import replace

from bench.report import command
from bench.study.people import Known, Participant, about, participant
from common.arrays import Bool, Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, save
from common.errors import FitError
from common.hand.model import FINGER_JOINTS, HandModel
from common.recording.frame_recording import MANIFEST, open_recording
from common.sim.motion import POSES, REST
from common.sim.record import FIRST_NS
from common.sim.wrist.motion import SUBJECT_S, GuidedSubject, Stations
from common.sim.wrist.record import record_wrist
from common.sim.wrist.scene import WristScene
from master.calibrate.wrist.subject import calibrate_subject
from master.evaluation.wrist_score import WristTruth, at_rows, clear_line, load_wrist_truth, rows_at
from master.outputs.poses import Poses, load_poses
from master.replay.offline import solve
from master.replay.recorded import recorded_cycles
from master.rig.setup import RigSetup

SolverMode = Literal["fk", "ik", "auto"]
TRIAL_S = 0.7  # the way there and the hold
_HELD = 0.72  # of a trial, after which its pose is held
_REST_S = 0.2  # before the first trial
_STREAM = 62


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A study as one participant needs it.

    Attributes:
        rig, camera, hand: The device as its file says, its camera, and the usual hand.
        seed: Of the study.
        blocks: How often the six poses are made.
        known: What is known of bones and mounting (`bench.study.people`).
        solver_mode: Of the master; None: what the rig file says.
        step: Pixels between the rays that shade skin.
        guided: Triples of the guided motion.
        trial_s: How long each trial takes [s].
    """

    rig: RigCalibration
    camera: CameraCalibration
    hand: HandProfile
    seed: int
    blocks: int
    known: Known = "calibrated"
    solver_mode: SolverMode | None = None
    step: int = 2
    guided: int = 96
    trial_s: float = TRIAL_S


@dataclass(frozen=True, slots=True)
class Held:
    """One trial: which pose of which block (1, 2, ...), and when it was held [ns], ends included."""

    block: int
    pose: str
    from_ns: int
    to_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Performed:
    """The trials of one participant: poses by the line, truth, and when each pose was held.

    Attributes:
        name: Of the participant.
        hand: As it is known.
        held: The trials.
        poses, truth: Solved, and exact.
        refused: Whether the calibration was, so that the rig file's mounting was used.
    """

    name: str
    hand: HandProfile
    held: list[Held]
    poses: Poses
    truth: WristTruth
    refused: bool


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One pose that one participant held once; arrays (5,) thumb ... little.

    Attributes:
        pip_deg: Median over its triples in which the finger was tracked; if it was in none, of those where there is
            an angle. Of the thumb the MCP. NaN: no angle at all.
        truth_deg: Mean true angle over the same triples.
        tracked: In at least half of its triples the finger was.
        seen: In at least half of its triples 2 mm of laser line, or the fingertip, are in sight by the truth.
    """

    participant: str
    block: int
    pose: str
    pip_deg: Float
    truth_deg: Float
    tracked: Bool
    seen: Bool


def orders(blocks: int, seed: int) -> tuple[tuple[str, ...], ...]:
    """Return the poses of each block in the order in which they are asked for."""
    rng = np.random.default_rng([seed, _STREAM])
    names = np.array(list(POSES))
    return tuple(tuple(str(name) for name in rng.permutation(names)) for _ in range(blocks))


def performed(task: Task, number: int, folder: Path) -> Performed:
    """Render, calibrate, detect and solve one participant; files go into `folder`.

    Raises:
        PhalanxError: Files cannot be written.
        subprocess.CalledProcessError: The slave ended with an error.
    """
    who, camera, trials = (
        participant(task.seed, number, task.rig, task.hand),
        task.camera.name,
        folder / "trials",
    )
    held = _record_trials(trials, who, task)
    rig, hand, refused = _known(task, who, folder)
    _detect(trials, camera, rig, hand)
    recording = open_recording(trials)
    rig = rig if task.solver_mode is None else replace(rig, solver_mode=task.solver_mode)
    solve(recording, RigSetup.of(rig, recording.manifest.cameras, HandModel.of(hand)), trials, trials)
    truth = load_wrist_truth(recording, camera)
    assert truth is not None
    return Performed(who.name, hand, held, load_poses(trials / "poses.npz"), truth, refused)


def _known(task: Task, who: Participant, folder: Path) -> tuple[RigCalibration, HandProfile, bool]:
    """Rig and hand as they are known of a participant, and whether a calibration was refused."""
    if task.known == "all":
        return who.rig, who.hand, False
    if task.known == "nothing":
        return task.rig, task.hand, False
    rig, guided = about(task.rig), folder / "guided"
    model = HandModel.of(who.hand)
    scene = _scene(who, task, GuidedSubject(model, who.seed), model)
    # The motion is slow: within a triple the hand is taken to stand still.
    record_wrist(
        guided, scene, poses_s=(np.arange(task.guided) * (SUBJECT_S / task.guided)).tolist(), step=task.step
    )
    _detect(guided, task.camera.name, rig, who.measured)
    cycles = list(recorded_cycles(guided, task.camera.name))
    try:
        found = calibrate_subject(cycles, rig, task.camera, who.measured)
    except FitError:
        return rig, who.measured, True
    return found.rig, found.hand, False


def _record_trials(folder: Path, who: Participant, task: Task) -> list[Held]:
    names = [(block, pose) for block, poses in enumerate(orders(task.blocks, who.seed), 1) for pose in poses]
    model, trial_s = HandModel.of(who.hand), task.trial_s
    postures = (REST, *(POSES[pose] for _, pose in names))
    scene = _scene(who, task, Stations(model, postures, who.seed, period_s=trial_s * len(postures)), model)
    begin_s = max(trial_s - _REST_S, 0.0)
    record_wrist(folder, scene, trial_s * len(postures) - begin_s, start_s=begin_s, step=task.step)

    def stamp(scene_s: float) -> int:
        return FIRST_NS + round(1e9 * (scene_s - begin_s))

    spans = [(stamp(trial_s * (k + 1 + _HELD)), stamp(trial_s * (k + 2))) for k in range(len(names))]
    return [Held(*name, *span) for name, span in zip(names, spans, strict=True)]


def _scene(who: Participant, task: Task, motion: Stations | GuidedSubject, model: HandModel) -> WristScene:
    cameras = {task.camera.name: task.camera}
    return WristScene(who.rig, cameras, model, motion, "indoor", who.seed, who.reflectance)


def _detect(folder: Path, camera: str, rig: RigCalibration, hand: HandProfile) -> None:
    """Detect in a recording whose device and hand are believed to be these."""
    save(folder / MANIFEST, replace(open_recording(folder).manifest, rig=rig))
    save(folder / "hand.json", hand)
    target = folder / f"detections_{camera}.npz"
    of = ("--name", camera, "--camera", f"replay:{folder}", "--hand", folder / "hand.json")
    command("slave", "run", *of, "-o", target)


def trials_of(done: Performed) -> list[Trial]:
    """Return the trials of a participant, each by the triples in which its pose was held."""
    poses, truth = done.poses, done.truth
    row = rows_at(truth.t_ns, poses.t_ns)
    angle, exact = at_rows(np.degrees(poses.angles_rad[:, :, 2]), row), np.degrees(truth.pip_rad)
    joints = np.stack([poses.tracked[:, list(chain[1:])].any(axis=1) for chain in FINGER_JOINTS], axis=1)
    tracked = (at_rows(joints.astype(np.float64), row) == 1.0) & np.isfinite(angle)
    line = clear_line(truth)
    out: list[Trial] = []
    for one in done.held:
        own = (truth.t_ns >= one.from_ns) & (truth.t_ns <= one.to_ns)
        used = np.where(tracked[own].any(axis=0), tracked[own], np.isfinite(angle[own]))
        known = used.any(axis=0)
        pip, true = np.full(5, np.nan), exact[own].mean(axis=0)
        for f in np.flatnonzero(known):
            pip[f], true[f] = np.median(angle[own, f][used[:, f]]), exact[own, f][used[:, f]].mean()
        seen = _most(line[own]) | _most(truth.tip_visible[own])
        out.append(Trial(done.name, one.block, one.pose, pip, true, _most(tracked[own]), seen))
    return out


def _most(flags: Bool) -> Bool:
    """(5,) whether at least half of (n, 5) are set."""
    return np.asarray(2 * flags.sum(axis=0) >= len(flags))
