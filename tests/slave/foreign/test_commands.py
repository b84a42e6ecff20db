"""`phalanx-slave record --from` and `colours` of videos: what a stranger types, and what it says."""

import json
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, load, save
from slave.__main__ import main
from slave.commands.offline import detect_recording
from tests.slave.foreign.foreign_videos import COUNT, write_tree, write_video
from tests.slave.painted import CENTRES, NAMES, camera, hand, render

SHIFT = np.array([300.0, 200.0])


@pytest.fixture
def painted(tmp_path: Path) -> Path:
    """A tree whose camera has no colours, and a video of a painted hand that moves by 10 px a frame."""
    model = msgspec.structs.replace(camera(), markers=None)
    for folder in ("cameras", "rigs"):
        (tmp_path / "calib" / folder).mkdir(parents=True)
    save(tmp_path / "calib/cameras/left.json", model)
    rig = {
        "version": 1,
        "name": "desk",
        "kind": "markers",
        "cameras": ["left"],
        "hand": "default-right",
        "markers": list(NAMES),
        "T_rig_camera": {"left": np.eye(4).tolist()},
    }
    (tmp_path / "calib/rigs/desk.json").write_text(json.dumps(rig))
    size = (model.width_px, model.height_px)
    writer = cv2.VideoWriter(str(tmp_path / "left.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 60.0, size)
    for k in range(3):
        writer.write(render(hand(300.0 + 10.0 * k)))
    writer.release()
    return tmp_path


def test_colours_of_a_video_by_clicks_find_its_markers(
    painted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tree, video, made = str(painted / "calib"), str(painted / "left.avi"), painted / "made/cameras/left.json"
    assert main(["record", "--from", video, "--calibration", tree, "-o", str(painted / "recording")]) == 0
    fix = ["run", "--name", "left", "--camera", f"replay:{painted / 'recording'}", "--calibration", tree]
    assert main([*fix, "-o", str(painted / "d.npz")]) == 1
    output = capsys.readouterr().err
    assert "cameras/left.json: markers: missing; make them: phalanx-slave colours" in output
    assert all(f"--click {name}=U,V" in output for name in NAMES)
    clicks = [
        text
        for name, (u, v) in zip(NAMES, CENTRES + SHIFT, strict=True)
        for text in ("--click", f"{name}={u:.0f},{v:.0f}")
    ]
    assert main(["colours", video, "--camera", "left", "--calibration", tree, *clicks, "-o", str(made)]) == 0
    assert set(load(made, CameraCalibration).markers or {}) == set(NAMES)
    found = detect_recording(painted / "recording", "left", painted / "made")
    np.testing.assert_allclose(found.t_ns, [0, 1e9 / 60, 2e9 / 60], atol=1e6)
    for k in range(3):  # JPEG halves the colour's resolution
        np.testing.assert_allclose(found.uv[k], CENTRES + SHIFT + [10.0 * k, 0.0], atol=0.7)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], "of a video or pictures give --calibration DIR, whose cameras/left.json they are of"),
        (["--calibration", "TREE", "--click", "nose=1,2"], "rig 'desk' has no marker 'nose'; it has thumb"),
    ],
)
def test_colours_of_a_video_say_what_is_missing(
    painted: Path, options: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [text.replace("TREE", str(painted / "calib")) for text in options]
    target = str(painted / "made.json")
    assert main(["colours", str(painted / "left.avi"), "--camera", "left", *options, "-o", target]) == 1
    assert expected in capsys.readouterr().err


def test_a_click_that_is_none_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["colours", "left.avi", "--camera", "left", "--click", "thumb=1", "-o", "made.json"])
    assert ended.value.code == 2
    assert "expected MARKER=U,V, such as thumb=312,204" in capsys.readouterr().err


def test_import_says_what_it_made_of_what(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tree, out = write_tree(tmp_path / "calib"), tmp_path / "out"
    first, second = (write_video(tmp_path / name) for name in ("GOPR0012.mp4", "GOPR0944.mp4"))
    named = [f"right={first}", f"left={second}"]
    assert main(["record", "--from", *named, "--calibration", str(tree), "-o", str(out)]) == 0
    output = capsys.readouterr().out
    assert f"right: {first}: {COUNT} frames in 0.44 s" in output
    assert f"recording in {out}" in output
    with pytest.raises(SystemExit):
        main(["record", "--calibration", str(tree), "-o", str(out), "--from"])
    assert "argument --from: expected at least one argument" in capsys.readouterr().err
