"""Simulated participants, and what the real line makes of what they do before the camera.

Each has a hand with its own bones, a device a little askew, darker or brighter skin. Known of somebody are bones as a
hand calibration measures them, and what `master.calibrate.wrist.subject` makes of the guided motion of this person.
Every block has the six poses in an order of its own; a trial is the fifth of a second for which one is held. Frames are
rendered, detected by `phalanx-slave run -o` and solved as a replay is.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from msgspec import convert
from msgspec.structs import replace

from bench.report import detect
from common.arrays import Bool, Float
from common.calibration import CameraCalibration, HandProfile, RestJoint, RigCalibration, save
from common.calibration.files import Matrix4
from common.errors import FitError
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.model import FINGER_JOINTS, FINGERS, JOINTS, HandModel
from common.recording.frame_recording import MANIFEST, open_recording
from common.sim.motion import POSES, REST
from common.sim.record import FIRST_NS
from common.sim.wrist.motion import SUBJECT_S, GuidedSubject, Stations
from common.sim.wrist.record import record_wrist
from common.sim.wrist.scene import WristScene
from master.calibrate.tree_files import provenance
from master.calibrate.wrist.subject import calibrate_subject
from master.evaluation.wrist_score import WristTruth, at_rows, clear_line, load_wrist_truth, rows_at
from master.outputs.poses import Poses
from master.replay.offline import solve
from master.replay.recorded import recorded_cycles
from master.rig.setup import RigSetup

ROTATION_RAD, SHIFT_M = np.radians(3.0), 2e-3  # of the device, about and along each axis, either way
# What `calibrate hand` reaches at 1 mm of noise (docs/calibrate.md): fingers from knuckle to cap, and bones alone.
FINGER_SIGMA_M, BONE_SIGMA_M = 0.43e-3, 0.9e-3


@dataclass(frozen=True, slots=True, eq=False)
class Participant:
    """One person with a device on the wrist."""

    number: int  # 1, 2, ..
    seed: int  # of flesh, skin, room, noise and motion
    hand: HandProfile  # the exact hand
    measured: HandProfile  # the same hand as a hand calibration would have it
    rig: RigCalibration  # the device as it really sits
    reflectance: float  # of the skin, 1 is usual

    @property
    def name(self) -> str:
        """As folders and tables call this person."""
        return f"participant-{self.number:02d}"


def participant(study_seed: int, number: int, rig: RigCalibration, hand: HandProfile) -> Participant:
    """Draw participant `number` of a study around a rig file with a palm pose, and the usual hand.

    Fingers bend as the Digits paper states (preset D), up to how people deviate from it.
    """
    rng = np.random.default_rng([study_seed, 61, number])
    typical = replace(hand, couplings="D", limits_rad="D")
    bone_share = 0.08  # of each bone's length, either way
    bones = 1.0 + rng.uniform(-bone_share, bone_share, (5, 3))
    palm = 1.0 + float(rng.uniform(-bone_share, bone_share))
    rotation, shift = rng.uniform(-ROTATION_RAD, ROTATION_RAD, 3), rng.uniform(-SHIFT_M, SHIFT_M, 3)
    reflectance_share = 0.2
    reflectance = 1.0 + float(rng.uniform(-reflectance_share, reflectance_share))
    wrong = _bone_errors(rng) / _lengths(typical)
    palm_sigma = 0.01  # of the palm's length, by a ruler: 1 mm of 9 cm
    known = with_bones(typical, palm * (1.0 + palm_sigma * float(rng.normal())), bones + wrong)
    hands = with_bones(typical, palm, bones), _measured(known)
    return Participant(number, 1000 * study_seed + number, *hands, rotated(rig, rotation, shift), reflectance)


def about(rig: RigCalibration) -> RigCalibration:
    """Return the rig file with what its maker knows: how differently people wear the device."""
    known = {
        "rotation_sigma_deg": round(float(np.degrees(ROTATION_RAD) / np.sqrt(3.0)), 4),
        "shift_sigma_mm": round(float(1e3 * SHIFT_M / np.sqrt(3.0)), 4),
    }
    how = provenance("study", (), known, "how the device sits on the wrists of people")
    return replace(rig, provenance=rig.provenance | {"T_camera_palm": how})


def with_bones(hand: HandProfile, palm: float, bones: Float) -> HandProfile:
    """Return the hand with palm and radii times `palm`, phalanges times `bones` (5, 3)."""
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
    """Return the rig, its device turned (3,) [rad] about the wrist joint and moved (3,) [m], camera axes."""
    pose = np.array(rig.T_camera_palm, dtype=np.float64)
    pose[:3, :3] = rotation_vector_to_matrix(rotation_rad) @ pose[:3, :3]
    pose[:3, 3] += shift_m
    return replace(rig, T_camera_palm=convert(pose.tolist(), Matrix4))


def _measured(hand: HandProfile) -> HandProfile:
    """The hand with the provenance that `calibrate hand` gives to fingers whose length it measured."""
    sigma = {"finger_sigma_mm": 1e3 * FINGER_SIGMA_M, "bone_sigma_mm": 1e3 * BONE_SIGMA_M}
    how = {name: provenance("calibrate hand", ("study",), sigma) for name in FINGERS[1:]}
    return replace(hand, provenance=hand.provenance | how)


def _lengths(hand: HandProfile) -> Float:
    """Bone lengths (5, 3) [m], three for each finger, of the thumb with its metacarpal."""
    place = [[hand.rest_joints[JOINTS[j]].position_m for j in chain[-4:]] for chain in FINGER_JOINTS]
    return np.linalg.norm(np.diff(np.array(place), axis=1), axis=2)


def _bone_errors(rng: np.random.Generator) -> Float:
    """Errors (5, 3) [m] of measured bones: one alone has BONE_SIGMA_M, the sum of a finger FINGER_SIGMA_M."""
    whole = rng.normal(0.0, FINGER_SIGMA_M, (5, 1)) / 3.0
    # Without their mean, three numbers keep two thirds of their variance.
    alone = rng.normal(0.0, np.sqrt(1.5 * (BONE_SIGMA_M**2 - FINGER_SIGMA_M**2 / 9.0)), (5, 3))
    return whole + alone - alone.mean(axis=1, keepdims=True)


def _at(joint: RestJoint, position: Float) -> RestJoint:
    x, y, z = (float(value) for value in position)
    return replace(joint, position_m=(x, y, z))


SolverMode = Literal["fk", "ik", "auto"]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A study as one participant needs it: the device as its file has it, its camera, and the usual hand."""

    rig: RigCalibration
    camera: CameraCalibration
    hand: HandProfile
    seed: int  # of the study
    blocks: int  # how often the six poses are made
    solver_mode: SolverMode | None = None  # of the master; None: that of the rig file
    step: int = 2  # pixels between the rays that shade skin
    guided: int = 96  # triples of the guided motion
    trial_s: float = 0.7  # the way there and the hold


@dataclass(frozen=True, slots=True)
class Held:
    """One trial: which pose of which block (1, 2, ...), and when it was held [ns], ends included."""

    block: int
    pose: str
    from_ns: int
    to_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Performed:
    """The trials of one participant: poses by the line, truth, and when each pose was held."""

    name: str  # of the participant
    hand: HandProfile  # as it is known
    held: list[Held]  # the trials
    poses: Poses
    truth: WristTruth
    refused: bool  # whether the calibration was, so that the rig file's mounting was used


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One pose that one participant held once; arrays (5,) thumb ... little.

    `pip_deg`: median over its triples in which the finger was tracked; if it was in none, of those where there is an
    angle; NaN: no angle at all. Of the thumb the MCP.
    """

    participant: str
    block: int
    pose: str
    pip_deg: Float
    truth_deg: Float  # mean true angle over the same triples
    tracked: Bool  # in at least half of its triples the finger was
    seen: Bool  # in at least half of its triples 2 mm of laser line, or the tip, are in sight


def orders(blocks: int, seed: int) -> tuple[tuple[str, ...], ...]:
    """Return the poses of each block in the order in which they are asked for."""
    rng = np.random.default_rng([seed, 62])
    names = np.array(list(POSES))
    return tuple(tuple(str(name) for name in rng.permutation(names)) for _ in range(blocks))


def performed(task: Task, number: int, folder: Path) -> Performed:
    """Render, calibrate, detect and solve one participant; files go into `folder`."""
    who, camera = participant(task.seed, number, task.rig, task.hand), task.camera.name
    trials = folder / "trials"
    held = _record_trials(trials, who, task)
    rig, hand, refused = _known(task, who, folder)
    _detect(trials, camera, rig, hand)
    recording = open_recording(trials)
    rig = rig if task.solver_mode is None else replace(rig, solver_mode=task.solver_mode)
    solve(recording, [RigSetup.of(rig, recording.manifest.cameras, HandModel.of(hand))], trials, trials)
    truth = load_wrist_truth(recording, camera)
    assert truth is not None
    return Performed(who.name, hand, held, Poses.load(trials / "poses.npz"), truth, refused)


def _known(task: Task, who: Participant, folder: Path) -> tuple[RigCalibration, HandProfile, bool]:
    """Rig and hand as they are known of a participant, and whether a calibration was refused."""
    rig, guided = about(task.rig), folder / "guided"
    model = HandModel.of(who.hand)
    scene = _scene(who, task, GuidedSubject(model, who.seed), model)
    times = np.arange(task.guided) * (SUBJECT_S / task.guided)
    # The motion is slow: within a triple the hand is taken to stand still.
    record_wrist(guided, scene, poses_s=times.tolist(), step=task.step)
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
    rest_s = 0.2  # before the first trial
    begin_s = max(trial_s - rest_s, 0.0)
    record_wrist(folder, scene, trial_s * len(postures) - begin_s, start_s=begin_s, step=task.step)

    def stamp(scene_s: float) -> int:
        return FIRST_NS + round(1e9 * (scene_s - begin_s))

    held = 0.72  # of a trial, after which its pose is held
    spans = [(stamp(trial_s * (k + 1 + held)), stamp(trial_s * (k + 2))) for k in range(len(names))]
    return [Held(*name, *span) for name, span in zip(names, spans, strict=True)]


def _scene(who: Participant, task: Task, motion: Stations | GuidedSubject, model: HandModel) -> WristScene:
    cameras = {task.camera.name: task.camera}
    return WristScene(who.rig, cameras, model, motion, "indoor", who.seed, who.reflectance)


def _detect(folder: Path, camera: str, rig: RigCalibration, hand: HandProfile) -> None:
    """Detect in a recording taken for one of this device and hand."""
    save(folder / MANIFEST, replace(open_recording(folder).manifest, rig=rig))
    save(folder / "hand.json", hand)
    detect(folder, camera, folder / f"detections_{camera}.npz", "--hand", folder / "hand.json")


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
