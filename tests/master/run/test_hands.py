"""Several hands behind one push, each with its own messages, samples and poses file; and a joined hand that changes."""

from collections import Counter
from math import nan
from pathlib import Path
from shutil import copytree

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import ImuCalibration, RigCalibration, load, save
from common.errors import CalibrationError
from common.messages import Detections, ImuSample, MarkerDetections
from master.estimator.pipeline import SolvedPose
from master.monitor.clocks import ClockMonitor
from master.outputs.poses import Poses, RunFiles
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigFiles, load_setup
from master.run.app import StageTimes
from master.run.dispatcher import Dispatcher
from master.run.tuning import LivePipeline, RigTuning, refuse_restart
from tests.hand_helpers import MARKERS
from tests.master.outputs.test_outputs_files import random_pose
from tests.master.rig.test_rig_merge import setups, two_hands
from tests.synthetic_run import SyntheticRun, setup_of, synthetic_run
from tests.wrist_run import CYCLE_NS, START_NS, exact_cycle, wrist_scene, wrist_setup


class RecordingPipeline:
    """A line that only remembers."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.messages: list[Detections] = []
        self.samples: list[int] = []

    def push(self, message: Detections) -> list[SolvedPose]:
        self.messages.append(message)
        self.counts["pushed"] += 1
        return []

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        del orientation_wxyz, heading_sigma_rad
        self.samples.append(t_ns)

    def flush(self) -> list[SolvedPose]:
        return []


def sample(source: str, t_ns: int) -> ImuSample:
    return ImuSample(source, 1, t_ns, t_ns, np.zeros(3), np.zeros(3), np.full(3, nan), np.eye(4)[0])


@pytest.fixture(scope="module")
def short_run() -> SyntheticRun:
    return synthetic_run(8)


def with_left_markers(message: MarkerDetections) -> MarkerDetections:
    """The message of a rig whose second six markers are those of a left hand, seen where the right ones are."""
    twice = {
        name: np.concatenate([getattr(message, name)] * 2)
        for name in ("uv", "area", "quality", "sigma_px", "alt_uv")
    }
    return msgspec.structs.replace(message, **twice)


def test_cameras_that_watch_two_hands_solve_both(short_run: SyntheticRun) -> None:
    markers = (*MARKERS, *(f"l-{name}" for name in MARKERS))
    rig = msgspec.structs.replace(
        short_run.setup.rig, markers=markers, other_hands=("made-left",), stamp_offset_us={}
    )
    both = setups(rig)
    hands = Dispatcher(
        both, [pipeline_of(setup, StageTimes()) for setup in both], StageTimes(), gestures=False
    )
    results = [one for message in short_run.messages for one in hands.push(with_left_markers(message))]
    poses = [one.pose for one in results if isinstance(one, SolvedPose)]
    of = {name: [pose for pose in poses if pose.hand == name] for name in ("made-right", "made-left")}
    assert len(of["made-right"]) == len(of["made-left"]) >= 6
    assert hands.counts["made-left.poses"] == len(of["made-left"])
    assert all(pose.markers_m.shape == (6, 3) for pose in poses)
    alone = pipeline_of(both[0], StageTimes())
    expected = [one.pose for message in short_run.messages for one in alone.push(message)]
    for pose, other in zip(of["made-right"], expected, strict=True):
        np.testing.assert_array_equal(pose.position_m, other.position_m)


def test_messages_and_samples_go_to_their_own_hand(short_run: SyntheticRun, root: Path) -> None:
    imu = ImuCalibration(name="palm")
    right = setup_of(msgspec.structs.replace(short_run.setup.rig, imu=imu))
    left = load_setup(root / "calib_json", "wrist-left")
    lines = RecordingPipeline(), RecordingPipeline()
    hands = Dispatcher((right, left), lines, StageTimes())
    seen = exact_cycle(left, wrist_scene(left).truth(0.5), 0)
    samples = [sample(source, t_ns) for source, t_ns in (("palm", 1), (left.imus[0], 2), ("another", 3))]
    for message in (short_run.messages[0], seen, *samples):
        assert not list(hands.push(message))
    assert [line.messages for line in lines] == [[short_run.messages[0]], [seen]]
    assert [line.samples for line in lines] == [[1], [2]]
    assert hands.counts == {"made-right.pushed": 1, "default-left.pushed": 1}


def test_each_hand_has_a_poses_file(tmp_path: Path) -> None:
    files = RunFiles(tmp_path / "poses.npz", {"a": 6, "b": 0})
    for hand, markers in (("b", 0), ("a", 6), ("b", 0)):
        files.write(random_pose(0, markers, hand))
    with pytest.raises(ValueError, match="'c' does not fit, opened for a, b"):
        files.write(random_pose(0, 6, "c"))
    files.close()
    files.close()
    found = {hand: Poses.load(tmp_path / name) for hand, name in (("a", "poses.npz"), ("b", "poses-b.npz"))}
    assert {hand: (len(poses), poses.hand) for hand, poses in found.items()} == {"a": (1, "a"), "b": (2, "b")}


def both_files(root: Path, folder: Path) -> RigFiles:
    """The shipped desk and wrist device in a tree that a test may change."""
    copytree(root / "calib_json", folder)
    return RigFiles(folder, ("desk", "wrist"))


def test_a_joined_hand_follows_all_its_files(root: Path, tmp_path: Path) -> None:
    files = both_files(root, tmp_path / "calib")
    [setup] = files.load()
    names = {path.relative_to(files.calibration).as_posix() for path in files.paths([setup])}
    assert names == {
        *("rigs/desk.json", "rigs/wrist.json", "hands/default-right.json"),
        *(f"cameras/{name}.json" for name in ("left", "right", "wrist")),
        "gestures/default.json",
    }
    lines: list[str] = []
    pipeline = LivePipeline(setup, StageTimes())
    tuning = RigTuning(files, [setup], [pipeline], lines.append)
    scene = wrist_scene(wrist_setup(root))
    for k in range(6):
        pipeline.push_orientation(START_NS + k * CYCLE_NS - 1, np.eye(4)[0])
        pipeline.push(exact_cycle(wrist_setup(root), scene.truth(0.1 * k), k))
    path = files.calibration / "rigs/wrist.json"
    rig = load(path, RigCalibration)
    save(path, msgspec.structs.replace(rig, solver_mode="fk"))
    tuning.reload()
    assert lines == ["changed files are in use"]
    [new] = tuning.setups
    assert new.wrist is not None
    assert new.wrist.solver_mode == "fk"
    pipeline.push(exact_cycle(wrist_setup(root), scene.truth(0.6), 6))
    save(path, msgspec.structs.replace(rig, hand="default-left"))
    with pytest.raises(
        CalibrationError, match="hand: default-right cannot become default-right, default-left"
    ):
        tuning.reload()
    assert tuning.setups == (new,)


def test_markers_of_two_hands_keep_their_rows() -> None:
    old = setups(two_hands())[0]
    new = setups(two_hands(markers=("thumb", "l-thumb", "index", "l-back", "cube")))[0]
    assert old.markers == new.markers
    with pytest.raises(CalibrationError, match="markers: cannot stand in another order"):
        refuse_restart(old, new)


def test_cameras_that_watch_two_hands_are_measured_once(short_run: SyntheticRun) -> None:
    watch = ClockMonitor(setups(two_hands()))
    for message in short_run.messages:
        watch.push(message)
    assert watch.look() == []
    assert [machines.setup.hand.profile.name for machines in watch._now] == ["made-right"]
