"""Without hardware: each simulated camera of a hand recorded by a command, none of them in a hurry, joined into one."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.imu.csv_table import read_imu
from common.recording.frame_recording import open_recording
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from slave.__main__ import main

TREE = Path(__file__).resolve().parents[2] / "calib_json"
FIRST_NS, FRAMES = 5_000_000_000, 4


def record(folder: Path, name: str, rig: str, *more: str) -> int:
    command = ["record", "--name", name, "--rig", rig, "--calibration", str(TREE), "--scene", "grasp"]
    command += ["--frames", str(FRAMES), "--reserve-mb", "0", "-o", str(folder / name), *more]
    return main(command)


def test_marker_camera_and_wrist_device_see_one_hand_at_the_same_times(tmp_path: Path) -> None:
    simulated = ["--camera", "synthetic", "--every-frame", "--scene-epoch-ns", str(FIRST_NS)]
    assert record(tmp_path, "left", "desk", *simulated) == 0
    assert record(tmp_path, "wrist", "wrist", *simulated, "--imu") == 0
    parts = [str(tmp_path / name) for name in ("left", "wrist")]
    assert main(["record", "--join", *parts, "-o", str(tmp_path / "both")]) == 0
    both = open_recording(tmp_path / "both")
    assert both.manifest.kind == "both"
    assert both.manifest.marker_rig().name == "desk"
    assert both.manifest.wrist_rig().name == "wrist"
    for name, rate_hz in (("left", 60.0), ("wrist", 90.0)):
        rows = both.frames_of(name)
        assert [row.seq for row in rows] == list(range(FRAMES))  # none was lost, however slow this machine is
        np.testing.assert_allclose(
            [row.t_ns - FIRST_NS for row in rows], 1e9 / rate_hz * np.arange(FRAMES), atol=1.0
        )
    assert read_imu(both.folder, "imu")[0].t_ns == FIRST_NS
    laser = both.frames_of("wrist")[1]
    rig = load(TREE / "rigs/wrist.json", RigCalibration)
    cameras = {"wrist": load(TREE / "cameras/wrist.json", CameraCalibration)}
    scene = WristScene.by_name("grasp", rig, cameras, load(TREE / f"hands/{rig.hand}.json", HandProfile))
    drawn = WristRenderer(scene, "wrist").render((laser.t_ns - FIRST_NS) * 1e-9, laser.illumination)
    image = cv2.imread(str(both.folder / laser.file), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, drawn)


def test_a_real_camera_does_not_wait(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert record(tmp_path, "left", "desk", "--camera", f"replay:{tmp_path}", "--every-frame") == 1
    assert "--every-frame: only a synthetic camera can wait" in capsys.readouterr().err
    assert not (tmp_path / "left").exists()
