"""Simulated session of a participant before the camera.

Every block has the six poses in an order of its own, each pose made anew.

From one pose to the next the fingers go within half a second, then hold for a fifth of one: a trial is what is held.
Nobody makes a pose twice alike: each trial has its own posture, near the pose, and drifts slowly as hands do
(`common.sim.wrist.motion.Stations`). The truth is kept for every strobe cycle; trials.csv states which are held.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.calibration import CameraCalibration
from common.errors import RecordingError
from common.hand.model import HandModel
from common.sim.motion import POSES, REST
from common.sim.record import FIRST_NS
from common.sim.wrist.motion import SUBJECT_S, GuidedSubject, Stations
from common.sim.wrist.record import record_wrist
from common.sim.wrist.scene import WristScene
from master.study.participant import Participant

TRIALS = "trials.csv"
COLUMNS = ("block", "pose", "from_ns", "to_ns")
TRIAL_S = 0.7  # the way there and the hold
_HELD = 0.72  # of a trial, after which its pose is held
_REST_S = 0.2  # before the first trial
_STREAM = 62


@dataclass(frozen=True, slots=True)
class Held:
    """One trial: its pose, its block and its time interval.

    Blocks are numbered 1, 2, ...; the interval in which the pose was held is in [ns], ends included.
    """

    block: int
    pose: str
    from_ns: int
    to_ns: int


def orders(blocks: int, seed: int) -> tuple[tuple[str, ...], ...]:
    """The poses of each block in the order in which they are asked for."""
    rng = np.random.default_rng([seed, _STREAM])
    names = np.array(list(POSES))
    return tuple(tuple(str(name) for name in rng.permutation(names)) for _ in range(blocks))


def record_trials(
    folder: Path,
    who: Participant,
    camera: CameraCalibration,
    blocks: int,
    step: int,
    trial_s: float = TRIAL_S,
) -> None:
    """Render all trials of a participant as a recording.

    Its truth and trials.csv are written with it.

    Args:
        folder: New or empty.
        who: Whose.
        camera: That of the device.
        blocks: How often the six poses are made.
        step: Pixels between the rays that shade skin.
        trial_s: How long each trial takes [s].

    Raises:
        RecordingError: The folder cannot be written.
        CalibrationError: The rig lacks what a simulated device needs.
    """
    order = orders(blocks, who.seed)
    names = [(block + 1, pose) for block, poses in enumerate(order) for pose in poses]
    model = HandModel.of(who.hand)
    postures = (REST, *(POSES[pose] for _, pose in names))
    motion = Stations(model, postures, who.seed, period_s=trial_s * len(postures))
    scene = WristScene(who.rig, {camera.name: camera}, model, motion, "indoor", who.seed, who.reflectance)
    begin_s = max(trial_s - _REST_S, 0.0)
    record_wrist(folder, scene, trial_s * len(postures) - begin_s, start_s=begin_s, step=step)

    def stamp(scene_s: float) -> int:
        return FIRST_NS + round(1e9 * (scene_s - begin_s))

    held = [
        Held(block, pose, stamp(trial_s * (k + 1 + _HELD)), stamp(trial_s * (k + 2)))
        for k, (block, pose) in enumerate(names)
    ]
    write_trials(folder / TRIALS, held)


def record_guided(folder: Path, who: Participant, camera: CameraCalibration, count: int, step: int) -> None:
    """Render the guided motion of `calibrate wrist subject`.

    It is rendered in `count` strobe cycles, evenly spread over it; arguments as above.

    The motion is slow: within a strobe cycle the hand is taken to stand still.

    Raises:
        RecordingError, CalibrationError: As of `record_trials`.
    """
    model = HandModel.of(who.hand)
    motion = GuidedSubject(model, who.seed)
    scene = WristScene(who.rig, {camera.name: camera}, model, motion, "indoor", who.seed, who.reflectance)
    epochs: list[float] = (np.arange(count) * (SUBJECT_S / count)).tolist()
    record_wrist(folder, scene, poses_s=epochs, step=step)


def write_trials(path: Path, held: list[Held]) -> None:
    """Write trials.csv.

    Raises:
        RecordingError: It cannot be written.
    """
    try:
        with path.open("w", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(COLUMNS)
            rows.writerows((one.block, one.pose, one.from_ns, one.to_ns) for one in held)
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror}") from error
