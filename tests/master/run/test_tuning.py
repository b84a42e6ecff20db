"""A master that changes its geometry while it tracks: poses follow the new files, and a bad file changes nothing."""

import threading
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import FilterCalibration, ImuCalibration, RigCalibration, save
from common.errors import BusError, CalibrationError
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandJoints
from common.messages import HandPose
from master.rig.setup import RigFiles, RigSetup
from master.run.app import StageTimes
from master.run.tuning import LivePipeline, RigTuning
from tests.hand_helpers import MARKERS, RIGHT, camera_file, cap_bias_px, rig_file
from tests.hand_helpers import detections as seen
from tests.master.run.live_master import LiveMaster
from tests.network_helpers import until
from tests.synthetic_run import SyntheticRun, hand_at, setup_of, synthetic_run

ASIDE_M = 0.1


@pytest.fixture(scope="module")
def exact_run() -> SyntheticRun:
    return synthetic_run(60)


def aside(rig: RigCalibration, dx_m: float = ASIDE_M) -> RigCalibration:
    """The same rig, its frame `dx_m` further along -x: everything is seen as far along +x."""
    poses = {name: rig.camera_pose(name) for name in rig.cameras}
    for T in poses.values():
        T[0, 3] += dx_m
    moved = {name: tuple(tuple(float(v) for v in row) for row in T) for name, T in poses.items()}
    return msgspec.structs.replace(rig, T_rig_camera=moved)


def palm_x(pose: HandPose) -> float:
    return float(pose.position_m[0, 0])


def with_change(run: SyntheticRun, setup: RigSetup, at: int) -> tuple[list[HandPose], LivePipeline]:
    """All poses of the run, the setup changed before message number `at` while messages go on."""
    pipeline = LivePipeline(run.setup, StageTimes())
    builder = threading.Thread(target=lambda: pipeline.prepare(setup)())
    poses: list[HandPose] = []
    for number, message in enumerate(run.messages):
        if number == at:
            builder.start()
        if number == at + 10:
            builder.join()
        poses += [one.pose for one in pipeline.push(message)]
    return poses, pipeline


def test_poses_go_on_without_a_gap_when_the_pipeline_changes(exact_run: SyntheticRun) -> None:
    plain = LivePipeline(exact_run.setup, StageTimes())
    expected = [one.pose for message in exact_run.messages for one in plain.push(message)]
    same = setup_of(msgspec.structs.replace(exact_run.setup.rig, filter=FilterCalibration(beta=100.0)))
    poses, pipeline = with_change(exact_run, same, 60)
    assert [pose.t_ns for pose in poses] == [pose.t_ns for pose in expected], "none is lost, none comes twice"
    assert pipeline.counts["poses"] == plain.counts["poses"] == len(poses)
    truth = [hand_at(pose.t_ns * 1e-9).position_m for pose in poses]
    error_mm = [
        1e3 * np.linalg.norm(p.position_m - t, axis=1).mean() for p, t in zip(poses, truth, strict=True)
    ]
    assert max(error_mm[3:]) < 6.0, "also right after the change"


def test_poses_follow_the_new_geometry(exact_run: SyntheticRun) -> None:
    poses, _ = with_change(exact_run, setup_of(aside(exact_run.setup.rig)), 60)
    off = np.array([palm_x(pose) - hand_at(pose.t_ns * 1e-9).position_m[0, 0] for pose in poses[3:]])
    assert abs(off[:20]).max() < 5e-3
    assert abs(off[-15:] - ASIDE_M).max() < 5e-3
    assert not ((off > 0.01) & (off < ASIDE_M - 0.01)).any(), "no pose is of both"


def test_an_imu_goes_on_in_the_new_pipeline_and_into_the_same_counts(exact_run: SyntheticRun) -> None:
    same = (1.0, 0.0, 0.0, 0.0)
    setup = setup_of(
        msgspec.structs.replace(exact_run.setup.rig, imu=ImuCalibration(q_palm_imu=same, q_rig_world=same))
    )
    pipeline = LivePipeline(setup, StageTimes())
    for number, message in enumerate(exact_run.messages[:60]):
        if number == 30:
            pipeline.prepare(aside_setup := setup_of(aside(setup.rig)))()
            assert aside_setup.imus == ("imu",)
        palm = hand_at(message.t_ns * 1e-9).T_rig_palm[:3, :3]
        pipeline.push_orientation(message.t_ns, matrix_to_quaternion(palm))
        pipeline.push(message)
    counts = pipeline.counts
    assert counts["poses"] - 4 <= counts["orientation.used"] <= counts["poses"]


def test_stages_are_measured_once(exact_run: SyntheticRun) -> None:
    stages, count = StageTimes(), 0
    pipeline = LivePipeline(exact_run.setup, stages)
    for message in exact_run.messages[:40]:
        count += len(pipeline.push(message))
    before = stages("filter").count
    pipeline.prepare(exact_run.setup)()
    assert stages("filter").count == before == count


def tree(folder: Path, rig: RigCalibration | None = None) -> RigFiles:
    """A calib_json tree of the made rig."""
    for part in ("cameras", "rigs", "hands"):
        (folder / part).mkdir(parents=True)
    save(folder / "rigs/bench.json", rig or rig_file())
    save(folder / "hands/made-right.json", RIGHT.profile)
    for name in ("left", "right"):
        save(folder / f"cameras/{name}.json", camera_file(name))
    return RigFiles(folder, ("bench",))


class LiveTuning:
    """A `RigTuning` on files of its own, and what it said."""

    def __init__(self, folder: Path) -> None:
        self.files = tree(folder)
        self.lines: list[str] = []
        [setup] = self.files.load()
        self.pipeline = LivePipeline(setup, StageTimes())
        self.tuning = RigTuning(self.files, [setup], [self.pipeline], self.lines.append)
        self.rig_path = folder / "rigs/bench.json"

    @property
    def upcoming(self) -> bool:
        return bool(self.pipeline._next)


@pytest.fixture
def live(tmp_path: Path) -> LiveTuning:
    return LiveTuning(tmp_path)


def test_a_filter_is_tried_without_its_file_and_gone_with_a_reload(live: LiveTuning) -> None:
    live.tuning.try_filter('{"rig": "bench", "filter": {"beta": 30.0}}')
    assert live.upcoming
    assert live.tuning.setups[0].rig.filter == FilterCalibration(beta=30.0)
    for body in ('{"rig": "other", "filter": {}}', '{"rig": "bench", "filter": {"beta": -1}}', "{}"):
        with pytest.raises(CalibrationError, match=r"filter"):
            live.tuning.try_filter(body)
    assert live.tuning.setups[0].rig.filter.beta == 30.0, "what is refused changes nothing"
    live.tuning.reload()
    assert live.tuning.setups[0].rig.filter.beta != 30.0


def test_the_first_look_does_not_take_a_trial_back_and_a_change_does(live: LiveTuning) -> None:
    live.tuning.try_filter('{"rig": "bench", "filter": {"beta": 30.0}}')
    live.tuning.look()
    assert live.tuning.setups[0].rig.filter.beta == 30.0
    content = msgspec.json.decode(live.rig_path.read_bytes())
    live.rig_path.write_bytes(msgspec.json.encode(content | {"stamp_offset_us": {"right": 8000.0}}))
    live.tuning.look()
    assert live.tuning.setups[0].rig.filter.beta != 30.0


def test_files_that_say_the_same_are_no_change(live: LiveTuning) -> None:
    live.tuning.look()
    live.tuning.reload()
    live.rig_path.write_bytes(live.rig_path.read_bytes() + b"\n")
    live.tuning.look()
    assert live.lines == []
    assert live.tuning.counts() == {"reload.applied": 0, "reload.refused": 0}


@pytest.mark.parametrize("part", ["rigs/bench.json", "cameras/right.json", "hands/made-right.json"])
def test_every_file_of_the_rig_is_followed(part: str, live: LiveTuning) -> None:
    live.tuning.look()
    path = live.files.calibration / part
    content = msgspec.json.decode(path.read_bytes())
    match part:
        case "rigs/bench.json":
            content["stamp_offset_us"] = {"right": 8000.0}
        case "cameras/right.json":
            content["intrinsics"]["fx_px"] = 501.0
        case _:
            content["markers"]["thumb"]["painted_m"] = 0.017
    path.write_bytes(msgspec.json.encode(content))
    live.tuning.look()
    assert live.lines == ["changed files are in use"]
    assert live.upcoming
    assert live.tuning.counts() == {"reload.applied": 1, "reload.refused": 0}


def test_a_broken_file_is_said_once_and_the_old_pipeline_stays(live: LiveTuning) -> None:
    live.tuning.look()
    live.rig_path.write_text('{"version": 1,')
    live.tuning.look()
    live.tuning.look()
    assert len(live.lines) == 1
    assert live.lines[0].startswith("changed files are not used: ")
    assert "bench.json: Input data was truncated" in live.lines[0]
    assert not live.upcoming
    assert live.tuning.counts() == {"reload.applied": 0, "reload.refused": 1}


def test_another_rate_of_a_camera_is_followed(live: LiveTuning) -> None:
    path = live.files.calibration / "cameras/left.json"
    content = msgspec.json.decode(path.read_bytes())
    path.write_bytes(msgspec.json.encode(content | {"frame_rate_hz": 30.0}))
    live.tuning.reload()
    assert live.upcoming
    assert live.tuning.setups[0].cameras["left"].frame_rate_hz == 30.0


@pytest.mark.parametrize(
    ("part", "key", "value", "expected"),
    [
        ("rigs/bench.json", "markers", ["thumb", "index", "back"], "markers: thumb, index, .* cannot become"),
        ("rigs/bench.json", "cameras", ["right", "left"], "cameras: left, right cannot become right, left"),
        ("rigs/bench.json", "cameras", ["left"], "two or more are needed"),
        (
            "rigs/bench.json",
            "imu",
            {"name": "palm"},
            "imu.name: none cannot become palm .*: restart the master",
        ),
        ("rigs/bench.json", "depth_model", "power_law", "the key 'power_law' is missing"),
        (
            "cameras/left.json",
            "width_px",
            800,
            "'left': width_px: 640 cannot become 800 .*: give all processes of the rig the same files, then restart",
        ),
        (
            "hands/made-right.json",
            "name",
            "other",
            "hand: made-right cannot become other .*: restart the master",
        ),
    ],
)
def test_what_needs_a_restart_is_refused_with_the_reason(
    part: str, key: str, value: object, expected: str, live: LiveTuning
) -> None:
    path = live.files.calibration / part
    content = msgspec.json.decode(path.read_bytes())
    content[key] = value
    path.write_bytes(msgspec.json.encode(content))
    with pytest.raises(CalibrationError, match=expected):
        live.tuning.reload()
    assert not live.upcoming


class Master:
    """A live master on files of its own, two slaves that send a hand, and somebody on the bus.

    Attributes:
        hand: The true hand at a time [ns]; at rest at first.
        sigma_px: Standard deviation of the noise of its centroids.
    """

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.hand: Callable[[int], HandJoints] = lambda _t_ns: hand_at(0.0)
        self.sigma_px = 0.0
        self.files = tree(folder / "calib")
        self.live = LiveMaster(stack, self.files, ("left", "right"), folder)
        self.poses = self.live.bus.subscribe("hand")
        sender = threading.Thread(target=self._send)
        sender.start()
        stack.callback(sender.join)
        stack.callback(self.live.stop.set)

    def _send(self) -> None:
        rng, seq, (setup,) = np.random.default_rng(1), 0, self.live.setups
        while not self.live.stop.wait(0.015):
            t_ns = time.monotonic_ns()
            joints = self.hand(t_ns)
            points = RIGHT.marker_points(joints, MARKERS)
            bias = cap_bias_px(joints, points, tuple(setup.models.values()))
            for c, (name, camera) in enumerate(setup.models.items()):
                uv = camera.project(points) + bias[c] + rng.normal(0.0, self.sigma_px, (len(MARKERS), 2))
                self.live.send(seen(name, seq, t_ns, uv))
            seq += 1

    def pose_near(self, x_m: float) -> bool:
        """Whether poses come whose wrist is within 1 cm of `x_m`."""

        def near() -> bool:
            pose = self.poses.get(0.5)
            return (
                isinstance(pose, HandPose)
                and bool(np.isfinite(palm_x(pose)))
                and abs(palm_x(pose) - x_m) < 0.01
            )

        return until(near)


@contextmanager
def master(folder: Path) -> Generator[Master, None, None]:
    with ExitStack() as stack:
        yield Master(stack, folder)


def test_a_running_master_follows_its_files_and_survives_a_broken_one(tmp_path: Path) -> None:
    home_m: Float = hand_at(0.0).position_m[0]
    with master(tmp_path) as running:
        assert running.pose_near(float(home_m[0]))
        path = running.files.calibration / "rigs/bench.json"
        save(path, aside(rig_file()))
        assert running.pose_near(float(home_m[0]) + ASIDE_M)
        path.write_text("{")
        assert until(lambda: running.live.counts()["reload.refused"] == 1)
        with pytest.raises(
            BusError, match=r"'master' refused 'reload': .*bench\.json: Input data was truncated"
        ):
            running.live.ask("reload")
        assert running.pose_near(float(home_m[0]) + ASIDE_M), "the old geometry stays"
        save(path, rig_file())
        assert running.live.ask("reload").counts["reload.applied"] == 2
        assert running.pose_near(float(home_m[0]))
    with np.load(tmp_path / "poses.npz") as poses:
        steps_ms = np.diff(poses["t_ns"]) * 1e-6
    assert (steps_ms > 0).all()
