"""The live master with a wrist device: triples in, poses and figures out; its files may change while it tracks."""

import json
from contextlib import ExitStack
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load, save
from common.clock import SystemClock
from common.errors import CalibrationError
from master.outputs.poses import Poses
from master.rig.setup import RigFiles, load_setup
from master.run.app import StageTimes
from master.run.tuning import LivePipeline, RigTuning
from tests.master.run.live_master import LiveMaster
from tests.network_helpers import detections, until
from tests.wrist_run import exact_cycle, wrist_scene


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


def send_cycles(live: LiveMaster, count: int, first: int = 0) -> None:
    """Send so many triples at 100 a second, of a hand that opens and closes."""
    (setup,) = live.setups
    scene, clock = wrist_scene(setup, "curl"), SystemClock()
    for k in range(first, first + count):
        live.send(exact_cycle(setup, scene.truth(0.02 * k), k, clock.now_ns() - 15_000_000))
        live.stop.wait(0.01)


def test_a_master_tracks_a_wrist_device_and_says_how_it_is(
    stack: ExitStack, root: Path, tmp_path: Path
) -> None:
    live = LiveMaster(stack, RigFiles(root / "calib_json", ("wrist",)), ("wrist",), tmp_path)
    send_cycles(live, 40)
    live.send(detections("wrist", 1, 400))  # a wrist's camera that speaks of markers
    assert until(lambda: live.counts().get("refused.impostor") == 1)
    assert until(lambda: "cameras: wrist" in live.lines)
    report = live.ask("report")
    assert report.counts["wrist.received"] == 40
    assert "wrist.lost" not in report.counts  # nothing was
    assert report.counts["poses"] > 30
    assert report.metrics["wrist.clock_sigma_us"] >= 0.0
    assert not [name for name in report.metrics if "phase" in name or "residual" in name]
    live.end()
    summary = json.loads((tmp_path / "live.json").read_text())
    poses = Poses.load(tmp_path / "poses.npz")
    assert len(poses) == summary["poses"] > 30
    assert summary["lost"] == summary["skipped"] == 0
    assert summary["camera_hz"]["wrist"] == pytest.approx(3.0 * summary["received_hz"]["wrist"], rel=0.1)
    assert np.isfinite(poses.laser_m).any(axis=(1, 2)).all()
    assert (poses.latency_ns > 0).all()


def test_a_changed_palm_pose_is_used_while_it_tracks(stack: ExitStack, tree: Path, tmp_path: Path) -> None:
    live = LiveMaster(stack, RigFiles(tree, ("wrist",)), ("wrist",), tmp_path)
    send_cycles(live, 20)
    save(tree / "rigs" / "wrist.json", raised(live.setups[0].rig, 0.005))
    live.ask("reload")
    send_cycles(live, 20, 20)
    assert until(lambda: live.counts()["wrist.received"] == 40)
    assert live.counts()["reload.applied"] == 1
    live.end()
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
