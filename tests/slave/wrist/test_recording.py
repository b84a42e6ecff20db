"""Recordings of a wrist device: written by `record`, read back, detected offline into the same bytes on every run."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from common.calibration import load, save
from common.clock import SystemClock
from common.errors import CalibrationError, RecordingError
from common.recording.frame_recording import Illumination, Manifest, open_recording
from common.recording.frame_writing import RecordingWriter, encode_png
from slave.__main__ import main
from slave.cameras.replay import ReplayCamera
from slave.sources import Frame
from slave.wrist.detector import WristDetector
from slave.wrist.offline import detect_wrist_recording
from tests.slave.wrist.wrist_frames import CAMERA, HAND, RIG, ROOT, VIEW, strobed

TREE = ROOT / "calib_json"
HAND_FILE = TREE / f"hands/{RIG.hand}.json"
ROWS = {
    "t_ns": (),
    "seq": (),
    "laser_uv": (5, 2),
    "laser_sigma_px": (5,),
    "laser_px": (5,),
    "tip_uv": (5, 2),
    "tip_sigma_px": (5,),
    "tip_depth": (5,),
}


def recording(folder: Path, frames: tuple[Frame, ...] | list[Frame]) -> Path:
    manifest = Manifest(version=1, kind="wrist", cameras={"wrist": CAMERA}, rig=RIG)
    writer = RecordingWriter(folder, manifest)
    for frame in frames:
        writer.add("wrist", frame.seq, frame.t_ns, frame.illumination, encode_png(frame.image))
    writer.close()
    return folder


@pytest.fixture(scope="module")
def curl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recording(tmp_path_factory.mktemp("curl") / "rec", strobed("curl", 10))


def test_there_is_a_row_for_every_cycle_and_it_is_what_a_live_slave_sends(curl: Path, tmp_path: Path) -> None:
    command = ["run", "--name", "wrist", "--camera", f"replay:{curl}", "--calibration", str(TREE)]
    for name in ("a.npz", "b.npz"):
        assert main([*command, "-o", str(tmp_path / name)]) == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    machine = WristDetector(VIEW, CAMERA.frame_rate_hz)
    sent = [
        found.message("wrist", 0)
        for frame in strobed("curl", 10)
        if (found := machine.push(frame)) is not None
    ]
    with np.load(tmp_path / "a.npz") as data:
        assert {key: data[key].shape for key in data} == {key: (len(sent), *row) for key, row in ROWS.items()}
        assert data["seq"].tolist() == [message.seq for message in sent]
        assert data["t_ns"].tolist() == [message.t_ns for message in sent]
        for key in ("laser_uv", "laser_sigma_px", "laser_px", "tip_uv", "tip_sigma_px", "tip_depth"):
            np.testing.assert_array_equal(data[key], [getattr(message, key) for message in sent])
        assert np.isfinite(data["laser_uv"]).all(axis=2).mean() > 0.8


def test_frames_without_a_hand_make_no_cycle_and_no_row(tmp_path: Path) -> None:
    frames = strobed("curl", 10)
    gone = [replace(frame, image=np.full_like(frame.image, 2)) for frame in frames[15:24]]
    given = recording(tmp_path / "rec", [*frames[:15], *gone, *frames[24:]])
    found = detect_wrist_recording(given, "wrist", hand_file=HAND_FILE)
    assert found.frames == 30
    assert [seq for seq in found.detections.seq.tolist() if 14 <= seq < 24] == []
    assert len(found.detections.t_ns) >= 5


def test_labels_that_disagree_are_counted_and_said_and_change_nothing(
    curl: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lying = [
        replace(frame, illumination=Illumination.LED if frame.seq == 16 else frame.illumination)
        for frame in strobed("curl", 10)
    ]
    folder = recording(tmp_path / "rec", lying)
    command = ["run", "--name", "wrist", "--camera", f"replay:{folder}", "--hand", str(HAND_FILE), "-o"]
    assert main([*command, str(tmp_path / "d.npz")]) == 0
    assert "1 frames lit otherwise than frames.csv says" in capsys.readouterr().err
    honest = detect_wrist_recording(curl, "wrist", TREE)
    assert honest.mislabelled == 0
    with np.load(tmp_path / "d.npz") as data:
        np.testing.assert_array_equal(data["laser_uv"], honest.detections.laser_uv)


def test_without_a_hand_the_error_names_the_fix(
    curl: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", "--name", "wrist", "--camera", f"replay:{curl}", "-o", str(tmp_path / "d.npz")]
    assert main(command) == 1
    error = capsys.readouterr().err
    assert "recording.json" in error
    assert f"give --hand FILE, or --calibration DIR with DIR/hands/{RIG.hand}.json" in error
    assert main([*command, "--calibration", str(tmp_path)]) == 1
    assert (
        f"{tmp_path}/hands/{RIG.hand}.json: no such hand profile: give --hand FILE" in capsys.readouterr().err
    )
    assert main([*command, "--hand", str(tmp_path / "nobody.json")]) == 1
    assert "nobody.json: cannot read" in capsys.readouterr().err


def test_what_is_not_calibrated_is_named_with_its_file(curl: Path, tmp_path: Path) -> None:
    manifest = json.loads((curl / "recording.json").read_text())
    manifest["rig"]["laser_plane"] = None
    (tmp_path / "recording.json").write_text(json.dumps(manifest))
    (tmp_path / "frames.csv").write_text((curl / "frames.csv").read_text())
    with pytest.raises(CalibrationError, match=r"recording\.json with .*json: .*laser_plane"):
        detect_wrist_recording(tmp_path, "wrist", TREE)


def test_a_camera_of_no_wrist_rig_is_refused(curl: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no camera 'left'; it has wrist"):
        detect_wrist_recording(curl, "left", TREE)
    (tmp_path / "recording.json").write_text((curl / "recording.json").read_text())
    (tmp_path / "frames.csv").write_text("camera,seq,t_ns,illumination,file\n")
    with pytest.raises(RecordingError, match="no frame of camera 'wrist'"):
        detect_wrist_recording(tmp_path, "wrist", TREE)


def test_frames_recorded_by_the_command_are_read_back_as_they_were(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "rec"
    command = ["record", "--name", "wrist", "--rig", "wrist", "--calibration", str(TREE), "--frames", "12"]
    sensor = ["--camera", "synthetic", "--scene", "curl", "--lights", "camera"]
    assert main([*command, *sensor, "-o", str(out)]) == 0
    recorded = open_recording(out)
    assert recorded.manifest.kind == "wrist"
    assert recorded.manifest.wrist_rig() == RIG
    rows = recorded.frames_of("wrist")
    lit = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)
    assert [row.illumination for row in rows] == [lit[row.seq % 3] for row in rows]
    written = cv2.imread(str(out / rows[0].file), cv2.IMREAD_UNCHANGED)
    assert written is not None
    assert written.shape == (400, 640)
    camera = ReplayCamera(out, "wrist", paced=False, clock=SystemClock())
    frame = camera.read()
    assert frame is not None
    np.testing.assert_array_equal(frame.image, written)
    found = detect_wrist_recording(out, "wrist", TREE)
    assert found.frames == 12
    assert len(found.detections.t_ns) >= 3
    assert "12 frames" in capsys.readouterr().err


def test_hand_is_an_option_of_wrist_cameras_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = load(TREE / "rigs/desk.json", type(RIG))
    cameras = {name: load(TREE / f"cameras/{name}.json", type(CAMERA)) for name in rig.cameras}
    save(tmp_path / "recording.json", Manifest(version=1, kind="markers", cameras=cameras, rig=rig))
    command = [
        "run",
        "--name",
        "left",
        "--camera",
        f"replay:{tmp_path}",
        "--hand",
        str(HAND_FILE),
        "-o",
        "d.npz",
    ]
    assert main(command) == 1
    assert "only a wrist camera knows a hand" in capsys.readouterr().err
    assert HAND.name == RIG.hand


def test_another_hand_than_that_of_the_recording_is_reported(
    curl: Path, caplog: pytest.LogCaptureFixture
) -> None:
    detect_wrist_recording(curl, "wrist", hand_file=HAND_FILE)
    assert not caplog.records
    detect_wrist_recording(curl, "wrist", hand_file=TREE / "hands/default-left.json")
    assert "default-left" in caplog.text
    assert RIG.hand in caplog.text
