"""Videos and pictures of others become a recording: whose they are, when, what is broken, and what is refused."""

from collections.abc import Callable
from pathlib import Path

import pytest

from common.errors import PhalanxError, RecordingError
from common.recording.frame_recording import FrameRecording, open_recording
from common.recording.pictures import FramePictures
from slave.foreign.importing import import_pictures
from slave.foreign.sources import read_times
from tests.slave.foreign.foreign_videos import (
    COUNT,
    SIZE,
    break_frame,
    number_of,
    write_pictures,
    write_tree,
    write_video,
)

MS = 1_000_000


def imported(tmp_path: Path, *paths: Path, **options: object) -> tuple[FrameRecording, str]:
    """The recording, and all that was said."""
    output: list[str] = []
    tree = tmp_path / "calib"
    if not tree.exists():
        write_tree(tree)
    import_pictures(tree, tmp_path / "out", output.append, paths, **options)  # type: ignore[arg-type]
    return open_recording(tmp_path / "out"), "\n".join(output)


def shown(recording: FrameRecording, camera: str) -> list[int]:
    """The numbers of the frames that a camera's rows show."""
    pictures = FramePictures(recording.folder, SIZE)
    return [number_of(pictures.read(row.file)) for row in recording.frames_of(camera)]


@pytest.mark.parametrize("ending", [".avi", ".mp4", ".mkv"])
def test_videos_named_as_cameras_are_a_recording_with_their_own_times(tmp_path: Path, ending: str) -> None:
    left, right = (write_video(tmp_path / f"{name}{ending}") for name in ("left", "right"))
    recording, output = imported(tmp_path, right, left)
    for camera in ("left", "right"):
        rows = recording.frames_of(camera)
        assert shown(recording, camera) == list(range(COUNT))
        assert [row.seq for row in rows] == list(range(COUNT))
        assert all(abs(row.t_ns - 40 * MS * row.seq) <= MS for row in rows)  # Matroska counts in milliseconds
    assert "first frames of all cameras are taken as simultaneous" in output
    assert f"left: {left}: 12 frames in 0.44 s (time stamps of the video)" in output
    assert recording.manifest.marker_rig().cameras == ("left", "right")


def test_pictures_come_in_the_order_of_their_numbers_at_the_rate_of_the_camera_file(tmp_path: Path) -> None:
    take = tmp_path / "take"
    write_pictures(take / "left")
    write_pictures(take / "right", ".jpg")
    recording, output = imported(tmp_path, take)
    for camera in ("left", "right"):
        assert shown(recording, camera) == list(range(COUNT))
        assert [row.t_ns for row in recording.frames_of(camera)] == [20 * MS * k for k in range(COUNT)]
    assert "50 frames per second, as the camera file states" in output


def test_frames_are_read_again_in_any_order(tmp_path: Path) -> None:
    recording, _ = imported(tmp_path, *(write_video(tmp_path / f"{name}.mp4") for name in ("left", "right")))
    pictures, rows = FramePictures(recording.folder, SIZE), recording.frames_of("left")
    assert [number_of(pictures.read(rows[k].file)) for k in (7, 2, 2, 11, 0)] == [7, 2, 2, 11, 0]
    with pytest.raises(RecordingError, match=r"left\.mp4: has no frame 12"):
        pictures.read("left.mp4/000012")


def test_names_of_no_camera_go_in_the_order_of_the_rig_and_the_mapping_is_said(tmp_path: Path) -> None:
    take = tmp_path / "take"
    for k, count in ((2, 5), (10, 7)):
        write_video(take / f"camera_{k}.mp4", count=count)
    recording, output = imported(tmp_path, take)
    assert [len(recording.frames_of(camera)) for camera in ("left", "right")] == [5, 7]
    assert f"left = {take / 'camera_2.mp4'}, right = {take / 'camera_10.mp4'}" in output


def test_cameras_can_be_named_and_the_rig_keeps_those_that_there_are(tmp_path: Path) -> None:
    write_tree(tmp_path / "calib", ("left", "right", "top"))
    named = {"top": write_video(tmp_path / "a.avi", count=3), "left": write_video(tmp_path / "b.avi")}
    recording, output = imported(tmp_path, named=named)
    assert recording.manifest.marker_rig().cameras == ("left", "top")
    assert len(recording.frames_of("top")) == 3
    assert "rig 'desk' has right, too, of which there is nothing" in output


@pytest.mark.parametrize("sidecar", [False, True])
def test_a_table_of_times_is_kept_to_the_nanosecond_and_frames_without_one_are_left_out(
    tmp_path: Path, sidecar: bool
) -> None:
    left, right = (write_video(tmp_path / f"{name}.avi") for name in ("left", "right"))
    base = 1_760_000_000_000_000_000  # since 1970, beyond what a float keeps
    taken = {"left": [base + 33_333_333 * k for k in range(COUNT)]}
    taken["right"] = [t + 8_000_001 for t in taken["left"]][:9]
    lines = {
        name: [f"{k},{t // 10**9}.{t % 10**9:09d}" for k, t in enumerate(own)] for name, own in taken.items()
    }
    table = None
    if sidecar:
        for name, own in lines.items():
            (tmp_path / f"{name}.csv").write_text("\n".join(["frame,time", *own]))
    else:
        table = tmp_path / "times.csv"
        rows = [f"{name},{line}" for name, own in lines.items() for line in own]
        table.write_text("\n".join(["camera,frame,time", *rows]))
    recording, output = imported(tmp_path, left, right, times=table)
    for name, own in taken.items():
        assert [row.t_ns for row in recording.frames_of(name)] == [t - base for t in own]
    assert "simultaneous" not in output
    assert "3 frames without one left out" in output


def test_frames_that_cannot_be_decoded_are_counted_and_the_others_keep_number_and_time(
    tmp_path: Path,
) -> None:
    left = write_video(tmp_path / "left.avi")
    break_frame(left, 4)
    right = write_pictures(tmp_path / "right")
    (right / "frame7.png").write_bytes((right / "frame7.png").read_bytes()[:60])
    recording, output = imported(tmp_path, left, right)
    assert shown(recording, "left") == [k for k in range(COUNT) if k != 4]
    assert [row.t_ns for row in recording.frames_of("left")] == [40 * MS * k for k in range(COUNT) if k != 4]
    assert shown(recording, "right") == [k for k in range(COUNT) if k != 7]
    assert "1 frames between them cannot be decoded" in output
    assert "1 pictures cannot be decoded" in output


def test_a_video_that_was_cut_says_how_much_is_missing(tmp_path: Path) -> None:
    left, right = (write_video(tmp_path / f"{name}.avi") for name in ("left", "right"))
    data = left.read_bytes()
    left.write_bytes(data[: data.find(b"movi") + (len(data) - data.find(b"movi")) // 2])
    recording, output = imported(tmp_path, left, right)
    count = len(recording.frames_of("left"))
    assert 2 <= count < COUNT
    assert shown(recording, "left") == list(range(count))
    assert f"it ends {COUNT - count} frames before the {COUNT}" in output


def test_importing_again_replaces_the_import_and_nothing_else(tmp_path: Path) -> None:
    left, right = (write_video(tmp_path / f"{name}.avi") for name in ("left", "right"))
    before = left.read_bytes()
    imported(tmp_path, left, right)
    recording, _ = imported(tmp_path, left, right)
    assert len(recording.rows) == 2 * COUNT
    assert left.read_bytes() == before
    (tmp_path / "out" / "recording.json").write_text("{}")
    with pytest.raises(PhalanxError):
        imported(tmp_path, left, right)
    assert (tmp_path / "out" / "left.avi").exists()


def _small(tmp_path: Path) -> list[Path]:
    return [write_video(tmp_path / f"{name}.avi", size=(64, 48)) for name in ("left", "right")]


def _one_strange(tmp_path: Path) -> list[Path]:
    return [write_video(tmp_path / f"{name}.avi") for name in ("left", "centre")]


def _three(tmp_path: Path) -> list[Path]:
    return [write_video(tmp_path / f"{name}.avi", count=2) for name in "abc"]


def _twice(tmp_path: Path) -> list[Path]:
    return [write_video(tmp_path / folder / "left.avi", count=2) for folder in "ab"]


def _junk(tmp_path: Path) -> list[Path]:
    (tmp_path / "left.mp4").write_bytes(b"#EXTM3U\nhttp://127.0.0.1/video.ts\n")
    return [tmp_path / "left.mp4"]


def _cut_index(tmp_path: Path) -> list[Path]:
    video = write_video(tmp_path / "left.mp4")
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    return [video]


def _empty(tmp_path: Path) -> list[Path]:
    (tmp_path / "left.mp4").write_bytes(b"")
    return [tmp_path / "left.mp4"]


def _no_pictures(tmp_path: Path) -> list[Path]:
    (tmp_path / "left").mkdir()
    return [tmp_path / "left"]


def _broken_pictures(tmp_path: Path) -> list[Path]:
    (tmp_path / "left").mkdir()
    (tmp_path / "left" / "a.png").write_bytes(b"no picture")
    return [tmp_path / "left"]


def _absent(tmp_path: Path) -> list[Path]:
    return [tmp_path / "absent.mp4"]


def _text(tmp_path: Path) -> list[Path]:
    (tmp_path / "notes.txt").write_text("x")
    return [tmp_path / "notes.txt"]


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (
            _small,
            r"left\.avi: is of 64 x 48 px, the calibration .*cameras/left\.json of 96 x 64: .*calibrate cameras stereo",
        ),
        (
            _one_strange,
            r"centre\.avi: rig 'desk' has no camera 'centre', but left, right; .*--camera NAME=PATH",
        ),
        (_three, r"3 videos or folders, none named as a camera, for the 2 cameras .*--camera NAME=PATH"),
        (_twice, r"two are of one camera"),
        (_junk, r"left\.mp4: is no video in MP4"),
        (_cut_index, r"left\.mp4: cannot be decoded: its end or its index is missing.*ffmpeg"),
        (_empty, r"left\.mp4: is no video .*it is empty"),
        (_no_pictures, r"left: no recording\.json, no video and no picture"),
        (_broken_pictures, r"left: not one of its 1 pictures can be decoded"),
        (_absent, r"absent\.mp4: no such file or folder"),
        (_text, r"notes\.txt: is no video"),
    ],
)
def test_what_cannot_be_used_is_refused_by_name_with_the_fix(
    tmp_path: Path, make: Callable[[Path], list[Path]], expected: str
) -> None:
    with pytest.raises(RecordingError, match=expected):
        imported(tmp_path, *make(tmp_path))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("frame;time\n0;1\n", "the header must have frame and time"),
        ("frame,time\n0,1.0\n0,2.0\n", "line 3: frame 0 of 'left' is there twice"),
        ("frame,time\n0,soon\n", "line 2: time: 'soon' is no time"),
        ("frame,time\n0.5,1\n", "line 2: frame: '0.5' is no number from 0"),
        ("frame,time\n0,1.0\n1,0.5\n", "frame 1: its time is not after that of the frame before"),
        ("camera,frame,time\nright,0,1.0\n", "no time of camera 'left'"),
        ("frame,time\n" + "".join(f"{k},{k}\n" for k in range(1, COUNT + 1)), "frames are counted from 0"),
        ("frame,time\n90,1.0\n", "no time of any of the 12 frames"),
        ("frame,time\n0,nan\n", "line 2: time: 'nan' is no time"),
    ],
)
def test_a_table_that_is_of_no_use_is_refused_by_line(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "left.csv").write_text(text)
    left, right = (write_video(tmp_path / f"{name}.avi") for name in ("left", "right"))
    with pytest.raises(RecordingError, match=expected):
        imported(tmp_path, left, right)


def test_a_table_for_one_of_two_cameras_is_refused(tmp_path: Path) -> None:
    (tmp_path / "left.csv").write_text("frame,time\n0,0.0\n1,0.1\n")
    left, right = (write_video(tmp_path / f"{name}.avi") for name in ("left", "right"))
    with pytest.raises(RecordingError, match=r"right\.avi: no table of times, but others have one"):
        imported(tmp_path, left, right)


def test_times_may_be_nanoseconds(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("note,frame,t_ns\na,0,5\nb,1,1760000000000000007\n")
    assert read_times(tmp_path / "t.csv", "left") == {0: 5, 1: 1_760_000_000_000_000_007}


def test_which_rig_is_meant_is_asked_where_several_could_be(tmp_path: Path) -> None:
    tree = write_tree(tmp_path / "calib")
    write_tree(tree, rig="other")
    videos = [write_video(tmp_path / f"{name}.avi") for name in ("left", "right")]
    with pytest.raises(RecordingError, match=r"which rig\? --rig desk or other"):
        imported(tmp_path, *videos)
    recording, _ = imported(tmp_path, *videos, rig_name="other")
    assert recording.manifest.marker_rig().name == "other"


def test_a_video_in_a_recording_leads_nowhere_else(tmp_path: Path) -> None:
    recording, _ = imported(tmp_path, *(write_video(tmp_path / f"{name}.avi") for name in ("left", "right")))
    (recording.folder / "left.avi").unlink()
    (recording.folder / "left.avi").symlink_to(tmp_path / "left.avi")
    with pytest.raises(RecordingError, match="outside the recording's folder"):
        FramePictures(recording.folder, SIZE).read("left.avi/000000")
    with pytest.raises(RecordingError, match="VIDEO/NUMBER"):
        FramePictures(recording.folder, SIZE).read("right.avi/one")
