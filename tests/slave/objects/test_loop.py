"""The loop of a tracker's slave, the synthetic tracker, and what its command says of what is missing."""

import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from common.calibration import RigCalibration, load, save
from common.calibration.object_profile import ObjectProfile
from common.clock import SkewedClock, SystemClock
from common.errors import CalibrationError
from common.geometry.transforms import matrix_to_rotation_vector, quaternion_to_matrix
from common.messages import TrackerPose
from common.sim.sensors import SET_UP_TRACKER, SET_UP_TRACKING, SimulatedTracker
from slave.__main__ import main
from slave.commands.simulated import TRACKER_HZ, SyntheticSensor, poses_of, tracker_of
from slave.report import pose_counters
from slave.sender import PosePipeline, run, skip_one, wait_for_start
from slave.sources import Reporting
from tests.slave.stand_ins import Listed, Wire

CALIB = Path(__file__).resolve().parents[3] / "calib_json"
KEY = "11" * 32


def pose(seq: int, known: bool = True) -> TrackerPose:
    place, quaternion = (
        (np.zeros(3), np.array([1.0, 0, 0, 0])) if known else (np.full(3, np.nan), np.full(4, np.nan))
    )
    return TrackerPose("tracker", 0, seq, 10_000_000 * seq, place, quaternion)


class Tracker(Listed[TrackerPose], Reporting):
    """A tracker that has more to tell."""

    def counts(self) -> dict[str, int]:
        return {"lost": 2}

    def metrics(self) -> dict[str, float]:
        return {"away_s": 0.5}


def test_every_pose_is_sent_in_the_name_of_this_process_and_counted() -> None:
    source = Tracker([pose(0), pose(1, known=False), pose(4)])
    wire, counters = Wire(TrackerPose), pose_counters(source)
    run(source, PosePipeline(77, wire.send, counters), threading.Event())
    assert [(one.session, one.seq) for one in wire.sent] == [(77, 0), (77, 1), (77, 4)]
    assert counters.counts() == {"poses": 3, "skipped": 2, "failed": 0, "nowhere": 1, "lost": 2}
    assert counters.summary() == "3 poses, 1 of them nowhere"
    metrics = counters.metrics()
    assert metrics.pop("rate_hz") > 0.0
    assert metrics == {"tracked": 1.0, "away_s": 0.5}


@pytest.mark.parametrize("recorded", [False, True])
def test_poses_before_the_start_are_forgotten_but_of_a_recording_nothing_is_missed(recorded: bool) -> None:
    source, wire = Tracker([pose(k) for k in range(9)]), Wire(TrackerPose, waits=3)
    pipeline = PosePipeline(77, wire.send, pose_counters(source))
    skip = None if recorded else partial(skip_one, source, pipeline)
    assert wait_for_start(wire.wait_for_start, threading.Event(), skip=skip)
    assert len(source.items) == (9 if recorded else 6)
    source.items = []
    wire.waits = 3
    ended = wait_for_start(wire.wait_for_start, threading.Event(), skip=skip)
    assert ended == recorded, "a source that has ended is waited for no longer"


def tree(folder: Path) -> Path:
    """A calibration tree whose cube has a tracker that is not registered yet."""
    (folder / "objects").mkdir()
    for kind in ("rigs", "cameras", "hands"):
        (folder / kind).symlink_to(CALIB / kind)
    cube = load(CALIB / "objects" / "cube.json", ObjectProfile)
    save(folder / "objects" / "cube.json", replace(cube, tracker="tracker", T_object_tracker=None))
    return folder


def test_a_synthetic_tracker_is_where_the_object_is_in_a_frame_of_its_own(tmp_path: Path) -> None:
    folder = tree(tmp_path)
    rig = load(folder / "rigs" / "desk-cube.json", RigCalibration)
    profile = load(folder / "objects" / "cube.json", ObjectProfile)
    tracker = tracker_of(folder, rig, "object", 3, profile)
    off: list[np.ndarray] = []
    lost = 0
    for t_s in np.arange(0.0, 40.0, 0.25):
        matrix = tracker.pose(float(t_s))
        if matrix is None:
            lost += 1
            continue
        found = SET_UP_TRACKING @ matrix @ np.linalg.inv(SET_UP_TRACKER)
        truth = tracker.scene.truth(float(t_s)).objects["cube"]
        quaternion = matrix_to_rotation_vector(found[:3, :3] @ truth[:3, :3].T)
        off.append(np.array([np.linalg.norm(found[:3, 3] - truth[:3, 3]), np.linalg.norm(quaternion)]))
    worst = np.max(off, axis=0)
    assert 0 < lost < 20  # some half seconds behind something
    assert 2e-4 < worst[0] < 4e-3
    assert np.radians(0.02) < worst[1] < np.radians(0.4)
    again = SimulatedTracker.of(tracker.scene, profile, 3).pose(1.5)
    np.testing.assert_array_equal(again, tracker.pose(1.5))
    np.testing.assert_allclose(SET_UP_TRACKING[:3, 1], [0.0, -1.0, 0.0], atol=1e-12)


def test_in_real_time_its_stamps_are_on_the_slaves_clock(tmp_path: Path) -> None:
    folder = tree(tmp_path)
    rig = load(folder / "rigs" / "desk-cube.json", RigCalibration)
    profile = load(folder / "objects" / "cube.json", ObjectProfile)
    tracker = tracker_of(folder, rig, "object", 3, profile)
    true_clock = SystemClock()
    epoch_ns = true_clock.now_ns()
    clock = SkewedClock(5_000_000_000, 40.0, true_clock)
    source = SyntheticSensor(poses_of("tracker", tracker), TRACKER_HZ, epoch_ns, clock, threading.Event())
    poses = [one for one in (source.read() for _ in range(12)) if one is not None]
    source.close()
    assert source.read() is None
    assert len(poses) == 12
    for one in poses:
        assert one.t_ns <= clock.now_ns()
        truth = tracker.pose((clock.to_true(one.t_ns) - epoch_ns) * 1e-9)
        if truth is not None:
            np.testing.assert_allclose(one.position_m, truth[:3, 3], atol=1e-12)
            np.testing.assert_allclose(quaternion_to_matrix(one.orientation_wxyz), truth[:3, :3], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "device", "code", "text"),
    [
        ("tracker", "survive", 1, "cannot start"),
        ("tracker", "survive:nowhere.rec", 1, "nowhere.rec: cannot read"),
        ("tracker", "magic", 1, "no such driver; there are openvr | survive | survive:FILE | synthetic"),
        ("somebody", "survive", 1, "no object has the tracker 'somebody'; there is 'tracker' on cube"),
    ],
)
def test_the_command_says_in_one_line_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str, device: str,
    code: int, text: str,
) -> None:  # fmt: skip
    monkeypatch.setenv("PHALANX_RIG_KEY", KEY)
    arguments = [
        "run",
        "--name",
        name,
        "--rig",
        "desk-cube",
        "--calibration",
        str(tree(tmp_path)),
        "--tracker",
        device,
    ]
    assert main([*arguments, "--program", str(tmp_path / "survive-cli"), "--bind", "127.0.0.1"]) == code
    [line] = capsys.readouterr().err.splitlines()
    assert text in line


def test_an_object_without_a_tracker_is_said_to_have_none() -> None:
    from slave.commands.devices import object_with

    rig = load(CALIB / "rigs" / "desk-wand.json", RigCalibration)
    with pytest.raises(CalibrationError, match="no object has the tracker 'tracker'; there is none"):
        object_with(CALIB, rig, "tracker")
