"""The live master with a wrist device: triples in, poses and figures out; its files may change while it tracks."""

import json
import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.bus.keys import new_key
from common.bus.zenoh_bus import ZenohBus
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load, save
from common.clock import SystemClock
from common.errors import CalibrationError
from common.messages import Command, Health
from master.outputs.poses import Poses
from master.rig.setup import RigFiles, RigSetup, load_setup
from master.run.app import StageTimes
from master.run.live import LiveSettings, run_live
from master.run.tuning import LivePipeline, RigTuning
from slave.uplink import Uplink
from tests.network_helpers import detections, free_endpoint, free_udp_port, until
from tests.wrist_run import exact_cycle, wrist_scene, wrist_setup


@pytest.fixture
def tree(root: Path, tmp_path: Path) -> Path:
    """A calib_json tree of the shipped wrist rig, for a test to change."""
    shipped, own = root / "calib_json", tmp_path / "calib_json"
    for part, name, kind in (
        ("rigs", "wrist", RigCalibration),
        ("cameras", "wrist", CameraCalibration),
        ("hands", "default-right", HandProfile),
    ):
        (own / part).mkdir(parents=True)
        save(own / part / f"{name}.json", load(shipped / part / f"{name}.json", kind))
    return own


def raised(rig: RigCalibration, by_m: float) -> RigCalibration:
    """The same rig with its palm `by_m` nearer to the camera."""
    assert rig.T_camera_palm is not None
    palm = [list(row) for row in rig.T_camera_palm]
    palm[1][3] -= by_m
    return msgspec.structs.replace(rig, T_camera_palm=tuple(tuple(row) for row in palm))


@dataclass
class Running:
    """A live master, its camera, somebody who asks, and what the master said."""

    setup: RigSetup
    camera: Uplink
    asker: ZenohBus
    stop: threading.Event
    lines: list[str] = field(default_factory=list[str])
    sent: int = 0

    def send(self, count: int) -> None:
        """Send so many triples at 100 a second, of a hand that opens and closes."""
        scene, clock = wrist_scene(self.setup, "curl"), SystemClock()
        for _ in range(count):
            now = scene.truth(0.02 * self.sent)
            cycle = exact_cycle(self.setup, now, self.sent, clock.now_ns() - 15_000_000)
            self.camera.send(msgspec.structs.replace(cycle, session=self.camera.session))
            self.sent += 1
            self.stop.wait(0.01)

    def ask(self, verb: str) -> Health:
        return self.asker.ask(Command("master", verb), 10.0)


@contextmanager
def running(setup: RigSetup, out: Path, files: RigFiles) -> Generator[Running, None, None]:
    """A live master with one slave; both end with the block, and the results are in `out`."""
    key = bytes.fromhex(new_key())
    beacon, bus = free_udp_port(), free_endpoint()
    settings = LiveSettings(
        ("127.255.255.255", beacon), ("127.0.0.1", 0), bus, files, 2.0, out / "poses.npz", out / "live.json"
    )
    stop, lines = threading.Event(), list[str]()
    master = threading.Thread(target=run_live, args=((setup,), key, settings, stop, lines.append))
    master.start()
    camera = Uplink("wrist", key, SystemClock(), beacon, "127.0.0.1")
    asker = ZenohBus(None, bus)
    try:
        assert camera.wait_for_start(60.0)
        yield Running(setup, camera, asker, stop, lines)
    finally:
        stop.set()
        master.join(60.0)
        for end in (camera, asker):
            end.close()
    assert not master.is_alive()


def test_a_master_tracks_a_wrist_device_and_says_how_it_is(root: Path, tmp_path: Path) -> None:
    with running(wrist_setup(root), tmp_path, RigFiles(root / "calib_json", ("wrist",))) as run:
        run.send(40)
        run.camera.send(
            detections("wrist", run.camera.session, 400)
        )  # a wrist's camera that speaks of markers
        assert until(lambda: run.ask("report").counts.get("refused.impostor") == 1)
        assert until(lambda: "cameras: wrist" in run.lines)
        report = run.ask("report")
        assert report.counts["wrist.received"] == 40
        assert "wrist.lost" not in report.counts  # nothing was
        assert report.counts["poses"] > 30
        assert report.metrics["wrist.clock_sigma_us"] >= 0.0
        assert not [name for name in report.metrics if "phase" in name or "residual" in name]
    summary = json.loads((tmp_path / "live.json").read_text())
    poses = Poses.load(tmp_path / "poses.npz")
    assert len(poses) == summary["poses"] > 30
    assert summary["lost"] == summary["skipped"] == 0
    assert summary["camera_hz"]["wrist"] == pytest.approx(3.0 * summary["received_hz"]["wrist"], rel=0.1)
    assert np.isfinite(poses.laser_m).any(axis=(1, 2)).all()
    assert (poses.latency_ns > 0).all()


def test_a_changed_palm_pose_is_used_while_it_tracks(tree: Path, tmp_path: Path) -> None:
    setup = load_setup(tree, "wrist")
    with running(setup, tmp_path, RigFiles(tree, ("wrist",))) as run:
        run.send(20)
        save(tree / "rigs" / "wrist.json", raised(setup.rig, 0.005))
        run.ask("reload")
        run.send(20)
        assert until(lambda: run.ask("report").counts["wrist.received"] == 40)
        assert run.ask("report").counts["reload.applied"] == 1
    poses = Poses.load(tmp_path / "poses.npz")
    assert (np.diff(poses.t_ns) > 0).all()
    wrist_y = poses.position_m[:, 1, 1]
    assert wrist_y[-1] == pytest.approx(wrist_y[0] - 0.005, abs=1e-6)


def test_a_rig_does_not_become_one_of_another_kind(root: Path, tree: Path) -> None:
    setup = load_setup(tree, "wrist")
    pipeline = LivePipeline(setup, StageTimes())
    tuning = RigTuning(RigFiles(tree, ("wrist",)), [setup], [pipeline], lambda _line: None)
    desk = load(root / "calib_json" / "rigs" / "desk.json", RigCalibration)
    save(tree / "rigs" / "wrist.json", msgspec.structs.replace(desk, name="wrist"))
    for name in desk.cameras:
        camera = load(root / "calib_json" / "cameras" / f"{name}.json", CameraCalibration)
        save(tree / "cameras" / f"{name}.json", camera)
    with pytest.raises(CalibrationError, match="kind: wrist cannot become markers while it runs"):
        tuning.reload()
    assert tuning.counts() == {"reload.applied": 0, "reload.refused": 1}


def test_a_rig_without_its_laser_plane_is_refused_and_the_old_one_stays(tree: Path) -> None:
    setup = load_setup(tree, "wrist")
    pipeline = LivePipeline(setup, StageTimes())
    tuning = RigTuning(RigFiles(tree, ("wrist",)), [setup], [pipeline], lambda _line: None)
    save(tree / "rigs" / "wrist.json", msgspec.structs.replace(setup.rig, laser_plane=None))
    with pytest.raises(CalibrationError, match="laser_plane is missing"):
        tuning.reload()
    assert tuning.setups == (setup,)
