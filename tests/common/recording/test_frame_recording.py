"""Recordings of frames: what is wrong is said with file and line."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

from common.errors import RecordingError
from common.recording.frame_recording import FrameRow, Illumination, open_recording

HEADER = "camera,seq,t_ns,illumination,file"
ROWS = ("right,0,1005,none,right/0.png", "left,1,2000,none,left/1.png", "left,0,1000,none,left/0.png")
IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def camera(name: str) -> dict[str, Any]:
    return {
        "version": 1,
        "name": name,
        "width_px": 640,
        "height_px": 480,
        "frame_rate_hz": 90.0,
        "exposure_us": 6000,
        "analogue_gain": 1.25,
        "colour_gains": [0.83, 1.24],
        "row_time_us": 0,
    }


def rig(kind: str = "markers", cameras: tuple[str, ...] = ("left", "right")) -> dict[str, Any]:
    poses = {name: [[1, 0, 0, 0.1 * i], *IDENTITY[1:]] for i, name in enumerate(cameras)}
    return {"version": 1, "name": kind, "kind": kind, "cameras": cameras, "T_rig_camera": poses, "hand": "me"}


def write(folder: Path, *, rows: tuple[str, ...] = ROWS, header: str = HEADER, **manifest: object) -> Path:
    content = {
        "version": 1,
        "kind": "markers",
        "cameras": {"left": camera("left"), "right": camera("right")},
        "rig": rig(),
    } | manifest
    (folder / "recording.json").write_bytes(msgspec.json.encode(content))
    (folder / "frames.csv").write_text("\n".join((header, *rows)) + "\n")
    return folder


def test_rows_keep_the_order_of_the_file_and_come_by_time_per_camera(tmp_path: Path) -> None:
    recording = open_recording(write(tmp_path))
    assert [row.file for row in recording.rows] == ["right/0.png", "left/1.png", "left/0.png"]
    assert recording.frames_of("left") == (
        FrameRow("left", 0, 1000, Illumination.NONE, "left/0.png"),
        FrameRow("left", 1, 2000, Illumination.NONE, "left/1.png"),
    )


def test_defaults_continuous_without_clicks(tmp_path: Path) -> None:
    manifest = open_recording(write(tmp_path)).manifest
    assert manifest.continuous
    assert manifest.clicks == {}


def test_a_recording_without_frames_is_empty_not_broken(tmp_path: Path) -> None:
    assert open_recording(write(tmp_path, rows=())).frames_of("left") == ()


@pytest.mark.parametrize(
    ("row", "output"),
    [
        ("left,0,5,none", "columns"),
        ("left,0,5,none,", "columns"),
        (",0,5,none,x.png", "columns"),
        ("left,0,5,none,x.png,more", "columns"),
        ("left,x,5,none,x.png", "seq: 'x'"),
        ("left,0,1.5,none,x.png", "t_ns: '1.5'"),
        ("left,0,nan,none,x.png", "t_ns: 'nan'"),
        ("left,0,99999999999999999999,none,x.png", "t_ns"),
        ("left,0,5,none,../x.png", "file: '../x.png' is outside"),
        ("left,0,5,none,left/../../x.png", "is outside the recording's folder"),
        ("left,0,5,none,/etc/x.png", "is outside the recording's folder"),
        ("left,0,5,dark,x.png", "illumination: 'dark' is none of none, ambient, laser, led"),
    ],
)
def test_a_broken_row_is_named_by_file_and_line(row: str, output: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=rf"frames\.csv: line 5: .*{output}"):
        open_recording(write(tmp_path, rows=(*ROWS, row)))


def test_lines_are_counted_as_an_editor_counts_them(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="line 4: seq"):
        open_recording(write(tmp_path, rows=(ROWS[0], "", "left,x,5,none,x.png")))


@pytest.mark.parametrize("header", ["", "camera,seq", "seq,camera,t_ns,illumination,file", HEADER + ",more"])
def test_a_wrong_header_says_the_right_one(header: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=rf"frames\.csv: header must be {HEADER}"):
        open_recording(write(tmp_path, header=header))


@pytest.mark.parametrize(
    "junk", [b"\xff\xfe\x00", HEADER.encode() + b"\nleft,0,\xff,none,x\n", b"\x89PNG\r\n\x1a\n\0"]
)
def test_a_frame_table_that_is_no_text_is_said(junk: bytes, tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "frames.csv").write_bytes(junk)
    with pytest.raises(RecordingError, match=r"frames\.csv"):
        open_recording(tmp_path)


@pytest.mark.parametrize("file", ["recording.json", "frames.csv"])
def test_a_missing_file_is_named(file: str, tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / file).unlink()
    with pytest.raises(RecordingError, match=rf"{file}: cannot read: No such file"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("manifest", "output"),
    [
        ({"versoin": 1}, "versoin"),
        ({"version": 2}, "version"),
        ({"kind": "video"}, "kind"),
        ({"cameras": {"left": camera("left")}}, "cameras: 'right' of rig 'markers' is missing"),
        ({"rig": rig(cameras=("left", "left"))}, "cameras: a name stands twice"),
        ({"rig": rig() | {"depth_model": "power_law"}}, "power_law"),
        ({"clicks": {"left": {"thumb": [1]}}}, "clicks"),
    ],
)
def test_a_broken_manifest_is_named_by_file_and_key(
    manifest: dict[str, Any], output: str, tmp_path: Path
) -> None:
    with pytest.raises(RecordingError, match=rf"recording\.json: .*{output}"):
        open_recording(write(tmp_path, **manifest))


def test_a_table_cut_anywhere_opens_up_to_the_cut(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path)
    (tmp_path / "right").mkdir()
    (tmp_path / "right/0.png").write_bytes(b"")
    table = tmp_path / "frames.csv"
    whole_text = table.read_text()
    for length in range(len(HEADER) + 1, len(whole_text) - 1):
        text = whole_text[:length]
        table.write_text(text)
        caplog.clear()
        recording = open_recording(tmp_path)
        whole = text.count("\n") - 1
        # The line feed of the first row is missing, but its file is there.
        assert len(recording.rows) == whole + text.endswith(ROWS[0]), length
        left_out = len(recording.rows) < len(text.splitlines()) - 1
        assert ("is cut, left out" in caplog.text) == left_out, length


def test_a_cut_header_or_a_cut_line_with_others_behind_it_is_no_cut_recording(tmp_path: Path) -> None:
    write(tmp_path, rows=(ROWS[0], ROWS[1][:-12], ROWS[2]))
    with pytest.raises(RecordingError, match="line 3: expected the 5 columns"):
        open_recording(tmp_path)
    (tmp_path / "frames.csv").write_text(HEADER[:-3])
    with pytest.raises(RecordingError, match="header must be"):
        open_recording(tmp_path)


def test_a_frame_of_an_unknown_camera_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"frames\.csv: camera 'top' is not in recording\.json"):
        open_recording(write(tmp_path, rows=("top,0,5,none,x.png",)))


def test_asking_for_an_unknown_camera_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no camera 'top'; it has left, right"):
        open_recording(write(tmp_path)).frames_of("top")


def test_the_marker_rig_is_found_among_several(tmp_path: Path) -> None:
    folder = write(tmp_path, rig=None, rigs=[rig("wrist", ("left",)), rig()])
    assert open_recording(folder).manifest.marker_rig().kind == "markers"


def test_a_recording_without_marker_rig_says_so(tmp_path: Path) -> None:
    folder = write(tmp_path, rig=rig("wrist", ("left",)))
    with pytest.raises(RecordingError, match="no rig of kind 'markers'"):
        open_recording(folder).manifest.marker_rig()


def test_recordings_of_the_data_sets_open_whole(datasets: Path) -> None:
    folders = sorted(path.parent for path in datasets.glob("*/*/recording.json"))
    assert folders
    for folder in folders:
        recording = open_recording(folder)
        assert recording.rows
        for name in recording.manifest.cameras:
            times = [row.t_ns for row in recording.frames_of(name) if row.illumination is Illumination.NONE]
            assert times == sorted(set(times)), f"{folder.name}: two frames of {name} at one instant"
        assert all((folder / row.file).is_file() for row in recording.rows)


def test_frames_of_one_camera_at_one_time_are_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    open_recording(write(tmp_path))
    assert "the time of another" not in caplog.text
    open_recording(write(tmp_path, rows=(*ROWS, "left,2,2000,none,left/2.png")))
    assert "camera left: frames with the time of another one: 1;" in caplog.text
