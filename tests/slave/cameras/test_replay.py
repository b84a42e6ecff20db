import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.clock import Clock
from common.errors import CameraError
from common.recording.frame_recording import Illumination
from slave.cameras.replay import ReplayCamera

CAMERA = {
    "version": 1,
    "name": "left",
    "width_px": 32,
    "height_px": 24,
    "frame_rate_hz": 60.0,
    "exposure_us": 5000,
    "analogue_gain": 1.0,
    "colour_gains": [1.0, 1.0],
    "row_time_us": 0.0,
}


class StepClock(Clock):
    """A clock that a sleep cannot move: every look at it costs 1 ms."""

    def __init__(self, t_ns: int) -> None:
        self.t_ns = t_ns

    def now_ns(self) -> int:
        self.t_ns += 1_000_000
        return self.t_ns


def recording(folder: Path, count: int = 3) -> Path:
    (folder / "left").mkdir()
    manifest = {"version": 1, "kind": "markers", "cameras": {"left": CAMERA}}
    (folder / "recording.json").write_text(json.dumps(manifest))
    lines = ["camera,seq,t_ns,illumination,file"]
    for k in range(count):
        cv2.imwrite(str(folder / f"left/{k}.png"), np.full((24, 32, 3), 10 * k, np.uint8))
        lines.append(f"left,{2 * k},{1_000_000_000 + 4_000_000 * k},none,left/{k}.png")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_unpaced_it_gives_every_frame_with_the_times_of_the_recording(tmp_path: Path) -> None:
    camera = ReplayCamera(recording(tmp_path), "left", paced=False, clock=StepClock(0))
    frames = [f for _ in range(3) if (f := camera.read()) is not None]
    assert camera.read() is None
    assert [f.seq for f in frames] == [0, 2, 4]
    assert [f.t_ns for f in frames] == [f.ready_t_ns for f in frames] == [10**9, 1_004_000_000, 1_008_000_000]
    assert [int(f.image[0, 0, 0]) for f in frames] == [0, 10, 20]


def test_frames_of_a_wrist_device_are_grey_as_written(tmp_path: Path) -> None:
    recording(tmp_path)
    rig = {"version": 1, "name": "w", "kind": "wrist", "cameras": ["left"], "hand": "h"}
    manifest = {"version": 1, "kind": "wrist", "cameras": {"left": CAMERA}, "rig": rig}
    (tmp_path / "recording.json").write_text(json.dumps(manifest))
    image = np.arange(24 * 32, dtype=np.uint32).reshape(24, 32).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "left/0.png"), image)
    (tmp_path / "frames.csv").write_text(
        (tmp_path / "frames.csv").read_text().replace("none,left/0", "laser,left/0")
    )
    camera = ReplayCamera(tmp_path, "left", paced=False, clock=StepClock(0))
    first, second = camera.read(), camera.read()
    assert first is not None
    assert second is not None
    assert first.illumination is Illumination.LASER
    np.testing.assert_array_equal(first.image, image)
    np.testing.assert_array_equal(second.image, np.full((24, 32), 10))  # three equal channels are one


def test_paced_the_times_are_the_slaves_and_no_frame_comes_before_its_time(tmp_path: Path) -> None:
    camera = ReplayCamera(recording(tmp_path), "left", paced=True, clock=StepClock(50 * 10**9))
    frames = [f for _ in range(3) if (f := camera.read()) is not None]
    assert [f.t_ns - frames[0].t_ns for f in frames] == [0, 4_000_000, 8_000_000]
    assert frames[0].t_ns > 50 * 10**9
    assert all(f.ready_t_ns >= f.t_ns for f in frames)


def test_closed_it_ends(tmp_path: Path) -> None:
    camera = ReplayCamera(recording(tmp_path), "left", paced=False, clock=StepClock(0))
    assert camera.read() is not None
    camera.close()
    camera.close()
    assert camera.read() is None


def broken(folder: Path, how: str) -> None:
    file = folder / "left/1.png"
    if how == "missing":
        file.unlink()
    elif how == "empty":
        file.write_bytes(b"")
    elif how == "cut":
        file.write_bytes(file.read_bytes()[:40])
    elif how == "junk":
        file.write_bytes(b"not a picture" * 9)
    else:
        cv2.imwrite(str(file), np.zeros((12, 16, 3), np.uint8))


@pytest.mark.parametrize("how", ["missing", "empty", "cut", "junk", "16x12"])
def test_a_broken_frame_is_an_error_that_names_its_file(tmp_path: Path, how: str) -> None:
    broken(recording(tmp_path), how)
    camera = ReplayCamera(tmp_path, "left", paced=False, clock=StepClock(0))
    assert camera.read() is not None
    with pytest.raises(CameraError, match=r"1\.png.*" + ("16x12" if how == "16x12" else "")):
        camera.read()


def test_what_cannot_be_opened_is_a_camera_error(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"recording\.json"):
        ReplayCamera(tmp_path / "none", "left", paced=False, clock=StepClock(0))
    recording(tmp_path)
    with pytest.raises(CameraError, match="no camera 'up'; it has left"):
        ReplayCamera(tmp_path, "up", paced=False, clock=StepClock(0))
    (tmp_path / "frames.csv").write_text("camera,seq,t_ns,illumination,file\n")
    with pytest.raises(CameraError, match="no frame of camera 'left'"):
        ReplayCamera(tmp_path, "left", paced=False, clock=StepClock(0))
