"""One recording of kind `both`: everything on one clock, and the truth of both sensors of one hand."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.imu.csv_table import read_imu
from common.recording.frame_recording import Illumination, open_recording
from common.sim.motion import HandMotion, HandState
from common.sim.scene import Scene
from common.sim.wrist.record import record_both
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene

CALIB = Path(__file__).resolve().parents[4] / "calib_json"
DESK = load(CALIB / "rigs/desk.json", RigCalibration)
WRIST = load(CALIB / "rigs/wrist.json", RigCalibration)
CAMERAS = {
    name: load(CALIB / f"cameras/{name}.json", CameraCalibration) for name in (*DESK.cameras, *WRIST.cameras)
}
HAND = load(CALIB / f"hands/{WRIST.hand}.json", HandProfile)
SEEN = Scene.standard(DESK, CAMERAS, HAND, 5)
START_S, SECONDS = 20.5, 0.07


@dataclass(frozen=True)
class FlexedWrist:
    """A motion with a wrist that bends."""

    motion: HandMotion
    period_s: float = 60.0

    def at(self, t_s: float) -> HandState:
        return replace(self.motion.at(t_s), wrist_angles_rad=np.array([0.2 * np.sin(t_s), 0.1]))


def scenes() -> tuple[Scene, WristScene]:
    motion = FlexedWrist(SEEN.motion)
    return replace(SEEN, motion=motion), WristScene(WRIST, CAMERAS, SEEN.model, motion, "dark", 5)


def test_a_recording_of_both_has_all_frames_on_one_clock_and_both_truths(tmp_path: Path) -> None:
    seen, device = scenes()
    assert record_both(tmp_path / "r", seen, device, SECONDS, START_S, step=4) == (4, 2)
    recording = open_recording(tmp_path / "r")
    manifest = recording.manifest
    assert manifest.kind == "both"
    assert manifest.marker_rig() == DESK
    assert manifest.wrist_rig() == WRIST
    assert manifest.rig_named(None) == DESK
    assert set(manifest.cameras) == {"left", "right", "wrist"}
    assert set(manifest.clicks) == {"left", "right"}
    stamps = [row.t_ns for row in recording.rows]
    assert stamps == sorted(stamps)
    cycles = recording.frames_of("wrist")
    assert [row.illumination.value for row in cycles] == ["ambient", "laser", "led"] * 2
    assert cycles[0].t_ns == recording.frames_of("left")[0].t_ns == 21_500_000_000
    image = cv2.imread(str(tmp_path / "r" / cycles[4].file), cv2.IMREAD_UNCHANGED)
    drawn = WristRenderer(device, "wrist", 4).render(START_S + 4 / 90, Illumination.LASER)
    np.testing.assert_array_equal(image, drawn)

    truth = np.load(tmp_path / "r/truth.npz")
    at_s = float(truth["t_ref"][1])
    np.testing.assert_array_equal(truth["flexion"][1], seen.motion.at(at_s).wrist_angles_rad)
    np.testing.assert_array_equal(truth["T_palm"][1], seen.truth(at_s).T_rig_palm)
    assert truth["wrist_t_ns"].tolist() == [cycles[1].t_ns, cycles[4].t_ns]
    of_wrist = device.truth(START_S + 4 / 90)
    np.testing.assert_array_equal(truth["wrist_laser_uv"][1], of_wrist.laser_uv)
    np.testing.assert_array_equal(truth["wrist_flexion"][1], of_wrist.wrist_angles_rad)
    meta = msgspec.json.decode((tmp_path / "r/truth_meta.json").read_bytes())
    assert meta["markers"] == list(DESK.markers)
    assert meta["wrist"]["groups"][0] == "palm"

    samples = read_imu(tmp_path / "r", "imu")
    assert samples[0].t_ns < stamps[0] - 1_900_000_000  # a filter has to settle
    assert samples[-1].t_ns > stamps[-1]


def test_a_late_clock_moves_the_stamps_of_the_wrist_camera_alone(tmp_path: Path) -> None:
    seen, device = scenes()
    record_both(tmp_path / "right", seen, device, 0.02, START_S, step=4, imu=False)
    record_both(tmp_path / "late", seen, device, 0.02, START_S, step=4, imu=False, wrist_late_ns=7_000_000)
    right, late = (open_recording(tmp_path / name) for name in ("right", "late"))
    for camera, by_ns in (("left", 0), ("right", 0), ("wrist", 7_000_000)):
        for before, after in zip(right.frames_of(camera), late.frames_of(camera), strict=True):
            assert after.t_ns - before.t_ns == by_ns
            assert (right.folder / before.file).read_bytes() == (late.folder / after.file).read_bytes()
    truths = [np.load(folder / "truth.npz")["wrist_t_ns"] for folder in (right.folder, late.folder)]
    assert (truths[1] - truths[0]).tolist() == [7_000_000]
    assert not (tmp_path / "late/imu.csv").exists()


def test_scenes_of_two_hands_or_motions_are_refused(tmp_path: Path) -> None:
    seen, device = scenes()
    with pytest.raises(ValueError, match=r"move differently at 20\.5 s"):
        record_both(tmp_path / "r", SEEN, device, SECONDS, START_S)
    left = load(CALIB / "hands/default-left.json", HandProfile)
    other = Scene.of_motion(DESK, CAMERAS, left, seen.motion)
    with pytest.raises(ValueError, match="hands differ"):
        record_both(tmp_path / "r", other, device, SECONDS, START_S)
    assert not (tmp_path / "r").exists()
