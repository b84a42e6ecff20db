"""Recordings of simulated wrist frames: form, truth, and order spoilt on purpose."""

from collections import Counter
from itertools import pairwise
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import RecordingError
from common.recording.frame_recording import Illumination, open_recording
from common.sim.wrist.record import Shot, record_wrist, with_faults
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


def test_faults_leave_gaps_and_take_frames_but_time_goes_on(tmp_path: Path) -> None:
    def spoilt(shots: list[Shot]) -> list[Shot]:
        return [shots[0], shots[0], shots[2], shots[1], *shots[4:]]

    record_wrist(tmp_path / "r", SCENE, 0.07, step=2, faults=spoilt)
    rows = open_recording(tmp_path / "r").rows
    assert [row.illumination.value for row in rows] == ["ambient", "ambient", "led", "laser", "laser", "led"]
    assert [row.seq for row in rows] == [0, 1, 2, 3, 5, 6]
    assert (np.diff([row.t_ns for row in rows]) > 0).all()


@given(st.integers(0, 10**6), st.floats(0.0, 0.3), st.floats(0.0, 0.3), st.floats(0.0, 0.3))
def test_faults_lose_double_and_swap_and_invent_nothing(
    seed: int, drop: float, double: float, swap: float
) -> None:
    frames = list(range(60))
    out = with_faults(frames, np.random.default_rng(seed), drop, double, swap)
    assert out == with_faults(frames, np.random.default_rng(seed), drop, double, swap)
    assert set(out) <= set(frames)
    assert max(Counter(out).values(), default=0) <= 2
    assert all(b >= a - 1 for a, b in pairwise(out))


def test_faults_come_as_often_as_was_asked() -> None:
    frames = list(range(6000))
    rng = np.random.default_rng(1)
    assert with_faults(frames, rng) == frames
    assert with_faults(frames, rng, drop=1.0) == []
    assert with_faults(frames[:2], rng, double=1.0) == [0, 0, 1, 1]
    assert with_faults(frames[:5], rng, swap=1.0) == [1, 0, 3, 2, 4]
    assert 1.0 - len(with_faults(frames, rng, drop=0.05)) / 6000 == pytest.approx(0.05, abs=0.01)
    out = np.array(with_faults(frames, rng, swap=0.05))
    assert (np.diff(out) < 0).mean() == pytest.approx(0.05, abs=0.01)
