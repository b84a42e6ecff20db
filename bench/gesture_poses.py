"""The six study poses, as the master tells them: simulated people, rendered frames, hands that others recorded.

**People, held markers**: twelve people of the study, each with bones as a calibration measures them, go through the
study's poses before cameras that see all tips, 1 mm of noise. **Rigs**: people before each rig through rendered frames,
where hands turn and hide their fingers (`gesture_rigs`). **Wrist**: trials of the study, rendered, detected by the
slave as a process, solved. A frame is right if the pose held in truth is the one that is told, from the third frame
after it was formed on; an episode is right if it is told by then. **handy_poses**: seven static hands, both sides,
markers with 1 mm of noise. flat is an open palm, point is pointing (whatever the thumb does), fist the end of a small
grasp; horns and shaka are none. vulcan and relax are told but not judged: one is an open palm where its
fingers are straight (left) and none where they are bent (right), the other a straight hand (left) and a bent one.
**leapjs**: an event is wrong if the recorded joints contradict it by a rule of their own: which fingers are stretched
(bends below 50 degrees together) and which are bent (above 85), and where thumb and index are.
"""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from bench.gesture_recorded import leap_rows, static_rows
from bench.gesture_rigs import rows as rigs
from bench.hand_draws import MARKERS
from bench.recognised_poses import RecognisedPoses, pose_of, recognised_in
from bench.row import Row, median_us
from bench.solved_hand import PointHand
from common.calibration import CameraCalibration, FilterCalibration, HandProfile, RigCalibration, load
from common.calibration.gesture_settings import default_gestures
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandModel
from common.messages import HandPose
from common.sim.poses import StudyPoses
from master.estimator.smooth import HandOneEuro
from master.fabrik.one_euro import OneEuroParameters
from master.gestures.features import FeatureExtractor
from master.gestures.poses import PoseRecogniser
from master.outputs.files import load_poses
from master.study.one import TRIALS, Task, run_participant
from master.study.participant import participant
from master.study.session import TRIAL_S, Held
from master.study.session import TRIALS as TRIALS_FILE
from master.study.trials import read_trials

CALIBRATION = Path(__file__).parent.parent / "calib_json"
SIGMA_M = 1e-3
_PERIOD_NS = 16_666_667
_SEED, _PEOPLE, _WRIST_PEOPLE = 31, 12, 3


def rows() -> Iterator[Row]:
    """All parts; a row that says so where the data are absent."""
    yield from people(range(1, _PEOPLE + 1)).rows("12 people, all markers seen")
    yield from rigs()
    yield from wrist_device(range(1, _WRIST_PEOPLE + 1)).rows(f"wrist device, {_WRIST_PEOPLE} people")
    yield from static_rows()
    yield from leap_rows()
    yield _cost()


def people(numbers: Sequence[int] | range, seconds: float = 15.0) -> RecognisedPoses:
    """People of the study before cameras that see all markers: own bones, a measured model, 1 mm of noise."""
    out = RecognisedPoses()
    wrist, typical = load(CALIBRATION / "rigs/wrist.json", RigCalibration), _hand("right")
    for number in numbers:
        who = participant(_SEED, number, wrist, typical)
        true, known = HandModel.of(who.hand), HandModel.of(who.measured)
        motion = StudyPoses(true, np.array([0.0, 0.0, 0.5]), _SEED + number)
        solver = PointHand(known, MARKERS)
        smooth = HandOneEuro(known, MARKERS, OneEuroParameters.of(FilterCalibration()))
        rng = np.random.default_rng([_SEED, number])
        poses: list[HandPose] = []
        for t_ns in range(0, round(1e9 * seconds), _PERIOD_NS):
            state = motion.at(1e-9 * t_ns)
            caps = true.marker_points(true.forward(state.T_rig_palm, state.angles_rad), MARKERS)
            caps = caps + rng.normal(0.0, SIGMA_M, caps.shape)
            cov = np.tile(SIGMA_M**2 * np.eye(3), (len(MARKERS), 1, 1))
            back_normal = -state.T_rig_palm[:3, 3] / np.linalg.norm(state.T_rig_palm[:3, 3])
            solved = smooth.push(t_ns, solver.push(t_ns, caps, cov, back_normal), cov).solution
            assert solved is not None
            place, orientation = solved.joints.position_m, matrix_to_quaternion(solved.joints.rotation)
            poses.append(pose_of(known, t_ns, place, orientation, solved.angles_rad))
        out.add([motion.held(1e-9 * pose.t_ns) for pose in poses], recognised_in(poses, known))
    return out


def wrist_device(numbers: Sequence[int] | range) -> RecognisedPoses:
    """Trials of the study: rendered, detected by the slave, calibrated and solved as everybody's."""
    rig = load(CALIBRATION / "rigs/wrist.json", RigCalibration)
    camera = load(CALIBRATION / "cameras/wrist.json", CameraCalibration)
    out = RecognisedPoses()
    with tempfile.TemporaryDirectory() as folder:
        task = Task(
            rig=rig,
            camera=camera,
            hand=_hand("right"),
            seed=_SEED,
            blocks=1,
            conditions=(("calibrated", "detected"),),
            solver_mode=None,
            step=2,
            guided=96,
            out=Path(folder),
            resume=None,
            keep=False,
            trial_s=TRIAL_S,
        )
        for number in numbers:
            run_participant(task, number)
            own = Path(folder) / f"participant-{number:02d}"
            poses = load_poses(own / "calibrated-detected" / "poses.npz")
            model = HandModel.of(load(own / "calibrated" / "hand.json", HandProfile))
            messages = [poses.pose(k) for k in range(len(poses))]
            held = read_trials(own / TRIALS / TRIALS_FILE)
            out.add([_held_at(held, pose.t_ns) for pose in messages], recognised_in(messages, model))
    return out


def _held_at(trials: Sequence[Held], t_ns: int) -> str | None:
    return next((trial.pose for trial in trials if trial.from_ns <= t_ns <= trial.to_ns), None)


def _cost() -> Row:
    """Processor time of a pose of the hand."""
    model = HandModel.of(_hand("right"))
    joints = model.forward(np.eye(4), np.zeros((5, 4)))
    pose = pose_of(model, 0, joints.position_m, matrix_to_quaternion(joints.rotation), np.zeros((5, 4)))
    extractor, recogniser = FeatureExtractor(model), PoseRecogniser(default_gestures())
    t_ns = 0

    def step() -> None:
        nonlocal t_ns
        t_ns += _PERIOD_NS
        features = extractor.of(msgspec.structs.replace(pose, t_ns=t_ns))
        assert features is not None
        recogniser.push(features)

    middle, spread = median_us(step)
    return Row(
        "a pose of the hand: features and poses",
        middle,
        "us",
        f"half of the quartiles' distance {spread:.0f}",
    )


def _hand(side: str) -> HandProfile:
    return load(CALIBRATION / "hands" / f"default-{side}.json", HandProfile)
