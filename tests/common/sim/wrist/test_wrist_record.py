"""Recordings of simulated wrist frames: form and truth."""

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import RecordingError
from common.recording.frame_recording import Illumination, open_recording
from common.sim.wrist.record import record_wrist
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene

CALIB = Path(__file__).resolve().parents[4] / "calib_json"
SCENE = WristScene.by_name(
    "standard",
    load(CALIB / "rigs/wrist.json", RigCalibration),
    {"wrist": load(CALIB / "cameras/wrist.json", CameraCalibration)},
    load(CALIB / "hands/default-right.json", HandProfile),
    5,
)


def test_a_recording_has_cycles_in_order_and_their_truth(tmp_path: Path) -> None:
    assert record_wrist(tmp_path / "r", SCENE, 0.1, start_s=8.0, step=2) == 3
    recording = open_recording(tmp_path / "r")
    assert recording.manifest.continuous
    assert recording.manifest.wrist_rig() == SCENE.rig
    rows = recording.frames_of("wrist")
    assert [row.illumination.value for row in rows] == ["ambient", "laser", "led"] * 3
    assert np.diff([row.t_ns for row in rows]) == pytest.approx(1e9 / 90, abs=1)
    truth = np.load(tmp_path / "r/truth.npz")
    meta = msgspec.json.decode((tmp_path / "r/truth_meta.json").read_bytes())
    assert meta["groups"][0] == "palm"
    assert len(meta["angles"]) == truth["angles"].shape[1] == 21
    assert truth["joints"].shape == (3, 25, 3)
    for k in range(3):
        laser, led = SCENE.truth(8.0 + (3 * k + 1) / 90), SCENE.truth(8.0 + (3 * k + 2) / 90)
        assert truth["t_ns"][k] == rows[3 * k + 1].t_ns
        np.testing.assert_array_equal(truth["laser_uv"][k], laser.laser_uv)
        np.testing.assert_array_equal(truth["tip_uv"][k], led.tip_uv)
        assert np.abs(laser.tip_uv - led.tip_uv).max() > 1e-6  # the hand moves within a triple
    image = cv2.imread(str(tmp_path / "r" / rows[4].file), cv2.IMREAD_UNCHANGED)
    drawn = WristRenderer(SCENE, "wrist").render(8.0 + 4 / 90, Illumination.LASER)
    np.testing.assert_array_equal(image, drawn)
    with pytest.raises(RecordingError, match="holds something already"):
        record_wrist(tmp_path / "r", SCENE, 0.1)


def test_in_a_recording_of_poses_the_hand_stands_still_within_a_cycle(tmp_path: Path) -> None:
    assert record_wrist(tmp_path / "r", SCENE, poses_s=[2.0, 30.0], step=2) == 2
    assert not open_recording(tmp_path / "r").manifest.continuous
    truth = np.load(tmp_path / "r/truth.npz")
    for k, t_s in enumerate((2.0, 30.0)):
        np.testing.assert_array_equal(truth["laser_uv"][k], SCENE.truth(t_s).laser_uv)
        np.testing.assert_array_equal(truth["tip_uv"][k], SCENE.truth(t_s).tip_uv)
