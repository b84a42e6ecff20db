import json
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.calibration import save
from common.errors import CalibrationError, RecordingError
from common.recording.frame_recording import open_recording
from slave.__main__ import main
from slave.commands.offline import camera_of, detect_recording, save_detections
from tests.slave.painted import CENTRES, NAMES, RANGES, camera, hand, render

IDENTITY = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]


def recording(folder: Path, coloured: bool = True) -> Path:
    """Three frames of a painted hand that moves by 10 px."""
    model = camera(ranges=RANGES) if coloured else msgspec.structs.replace(camera(), markers=None)
    rig = {
        "version": 1,
        "name": "desk",
        "kind": "markers",
        "cameras": ["left"],
        "hand": "default-right",
        "T_rig_camera": {"left": IDENTITY},
    }
    clicks = {n: [300.0 + x, 200.0 + y] for n, (x, y) in zip(NAMES, CENTRES.tolist(), strict=True)}
    manifest = {
        "version": 1,
        "kind": "markers",
        "cameras": {"left": json.loads(msgspec.json.encode(model))},
        "rig": rig,
        "clicks": {"left": clicks},
    }
    (folder / "recording.json").write_text(json.dumps(manifest))
    lines = ["camera,seq,t_ns,illumination,file"]
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), render(hand(300.0 + 10.0 * k)))
        lines.append(f"left,{k},{16_000_000 * k},none,{k}.png")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_shapes_and_content_are_those_of_the_format(tmp_path: Path) -> None:
    found = detect_recording(recording(tmp_path), "left")
    save_detections(tmp_path / "d.npz", found)
    with np.load(tmp_path / "d.npz") as data:
        assert {k: data[k].shape for k in data} == {
            "t_ns": (3,),
            "seq": (3,),
            "uv": (3, 6, 2),
            "area_px2": (3, 6),
            "quality": (3, 6),
            "sigma_px": (3, 6),
            "alt_uv": (3, 6, 2),
        }
        assert (data["sigma_px"] > 0.0).all()
        assert np.isnan(data["alt_uv"]).all()
        assert data["t_ns"].tolist() == [0, 16_000_000, 32_000_000]
        for k in range(3):
            np.testing.assert_allclose(data["uv"][k], CENTRES + np.array([300.0 + 10.0 * k, 200.0]), atol=0.3)


def test_two_runs_of_the_command_write_the_same_bytes(tmp_path: Path) -> None:
    folder = recording(tmp_path)
    for name in ("a.npz", "b.npz"):
        assert (
            main(["run", "--name", "left", "--camera", f"replay:{folder}", "-o", str(tmp_path / name)]) == 0
        )
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_colours_come_from_the_tree_and_the_rest_from_the_recording(tmp_path: Path) -> None:
    folder = recording(tmp_path, coloured=False)
    (tmp_path / "cameras").mkdir()
    save(tmp_path / "cameras/left.json", msgspec.structs.replace(camera(), exposure_us=9.0))
    model = camera_of(open_recording(folder), "left", tmp_path)
    assert model.markers == RANGES
    assert model.exposure_us == 5000.0


def test_without_colours_the_error_names_file_key_and_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recording(tmp_path, coloured=False)
    with pytest.raises(
        CalibrationError, match=r"recording\.json: cameras\.left\.markers: missing; give --calib"
    ):
        detect_recording(folder, "left")
    assert main(["run", "--name", "left", "--camera", f"replay:{folder}", "-o", str(tmp_path / "d.npz")]) == 1
    assert "phalanx-slave colours" in capsys.readouterr().err
    (tmp_path / "cameras").mkdir()
    save(tmp_path / "cameras/left.json", msgspec.structs.replace(camera(), markers=None))
    with pytest.raises(CalibrationError, match=r"cameras/left\.json: markers: missing"):
        detect_recording(folder, "left", tmp_path)


def test_wrong_camera_broken_frame_and_unwritable_file(tmp_path: Path) -> None:
    folder = recording(tmp_path)
    with pytest.raises(RecordingError, match="no camera 'up'; it has left"):
        detect_recording(folder, "up")
    with pytest.raises(RecordingError, match=r"0\.png: cannot make the folder"):
        save_detections(folder / "0.png/d.npz", detect_recording(folder, "left"))
    with pytest.raises(RecordingError, match="cannot write"):
        save_detections(tmp_path, detect_recording(folder, "left"))
    (folder / "1.png").write_bytes(b"junk")
    with pytest.raises(RecordingError, match=r"1\.png: is no JPEG or PNG"):
        detect_recording(folder, "left")


def test_the_colours_command_writes_what_detect_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recording(tmp_path, coloured=False)
    out = str(tmp_path / "cameras/left.json")
    assert main(["colours", str(folder), "--camera", "left", "-o", out]) == 0
    assert "no collisions" in capsys.readouterr().out
    found = detect_recording(folder, "left", tmp_path)
    np.testing.assert_allclose(found.uv[0], CENTRES + np.array([300.0, 200.0]), atol=0.3)


@pytest.mark.parametrize("driver", ["picamera3", "usb:0", "synthetic:7", "replay:", "replay"])
def test_a_driver_that_does_not_exist_names_those_that_do(
    driver: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PHALANX_RIG_KEY", "00" * 32)
    (tmp_path / "rigs").mkdir()
    (tmp_path / "cameras").mkdir()
    manifest = json.loads((recording(tmp_path) / "recording.json").read_text())
    (tmp_path / "rigs/desk.json").write_text(json.dumps(manifest["rig"]))
    save(tmp_path / "cameras/left.json", camera())
    arguments = ["run", "--name", "left", "--calibration", str(tmp_path), "--bind", "127.0.0.1"]
    assert main([*arguments, "--camera", driver]) == 1
    assert "synthetic | replay:FOLDER" in capsys.readouterr().err
    assert main(["run", "--name", "up", "--calibration", str(tmp_path), "--camera", driver]) == 1
    assert "no camera 'up'" in capsys.readouterr().err
