"""A recording can be read whatever ended it: a full disk, a limit, a kill. Every row has its whole file."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.arrays import Image
from common.calibration import CameraCalibration, RigCalibration
from common.errors import RecordingError
from common.recording.frame_recording import Illumination, Manifest, RecordedClock, open_recording
from common.recording.frame_writing import RecordingWriter, encode_png
from tests.network_helpers import until
from tests.programs import needs

CAMERA = CameraCalibration(
    version=1,
    name="left",
    width_px=32,
    height_px=24,
    frame_rate_hz=60.0,
    exposure_us=5000.0,
    analogue_gain=1.0,
    colour_gains=(1.0, 1.0),
    row_time_us=0.0,
)
MANIFEST = Manifest(
    version=1,
    kind="markers",
    cameras={"left": CAMERA, "right": msgspec.structs.replace(CAMERA, name="right")},
    clock=RecordedClock(id="this", wall_ahead_ns=1_700_000_000_123_456_789),
)
NONE = Illumination.NONE


def noise(seed: int, *shape: int) -> Image:
    return np.random.default_rng(seed).integers(0, 256, shape or (24, 32, 3), np.uint8)


def check_whole(folder: Path) -> int:
    """Every row has its whole file, and there is no file without a row; the number of rows."""
    rows = open_recording(folder).rows
    for row in rows:
        assert cv2.imread(str(folder / row.file)) is not None, row
    assert {row.file for row in rows} == {str(p.relative_to(folder)) for p in folder.rglob("*.png")}
    assert (folder / "frames.csv").read_bytes().endswith(b"\n")
    return len(rows)


def add_until_it_fails(writer: RecordingWriter, png: bytes) -> None:
    for k in range(1000):
        writer.add("left", k, k, NONE, png)


@contextmanager
def file_size_limit(size: int) -> Generator[None, None, None]:
    """The kernel refuses any file of this process beyond `size` bytes, with EFBIG after a short write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


@contextmanager
def small_disk(folder: Path, size: str) -> Generator[Path, None, None]:
    """A file system of its own that really gets full."""
    needs("mount")
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "phalanx-test", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("mounting a small disk needs the rights of root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_what_was_written_is_read_back_to_the_last_bit(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "new" / "wave", MANIFEST)
    images = {"left": noise(1), "right": noise(2, 24, 32)}
    for k in range(3):
        for camera, image in images.items():
            writer.add(camera, 7 * k, 10**18 + k, Illumination.LASER, encode_png(image))
    writer.close()
    writer.close()
    recording = open_recording(tmp_path / "new" / "wave")
    assert recording.manifest == MANIFEST
    assert [(r.camera, r.seq, r.t_ns) for r in recording.rows] == [
        (camera, 7 * k, 10**18 + k) for k in range(3) for camera in images
    ]
    assert {row.illumination for row in recording.rows} == {Illumination.LASER}
    for row in recording.rows:
        read = cv2.imread(str(recording.folder / row.file), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(read, images[row.camera])
    assert check_whole(recording.folder) == 6


@pytest.mark.parametrize("content", ["recording.json", "notes.txt", "left/000000.png"])
def test_a_folder_that_holds_something_is_refused_and_left_alone(content: str, tmp_path: Path) -> None:
    (tmp_path / content).parent.mkdir(exist_ok=True)
    (tmp_path / content).write_text("mine")
    with pytest.raises(RecordingError, match="holds something already; give a new or an empty folder"):
        RecordingWriter(tmp_path, MANIFEST)
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [tmp_path / content]
    assert (tmp_path / content).read_text() == "mine"


def test_a_file_is_no_folder_and_nothing_can_be_made_in_it(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(RecordingError, match="give a new or an empty folder"):
        RecordingWriter(tmp_path / "file", MANIFEST)
    with pytest.raises(RecordingError, match="file/below: cannot"):
        RecordingWriter(tmp_path / "file/below", MANIFEST)


def test_a_manifest_that_contradicts_itself_leaves_nothing_behind(tmp_path: Path) -> None:
    pose = ((1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0))
    rig = RigCalibration(
        version=1, name="desk", kind="markers", cameras=("up",), hand="me", T_rig_camera={"up": pose}
    )
    with pytest.raises(RecordingError, match=r"recording\.json: cameras: 'up' of rig 'desk' is missing"):
        RecordingWriter(tmp_path / "x", msgspec.structs.replace(MANIFEST, rig=rig))
    assert not (tmp_path / "x").exists()


def test_a_stranger_among_the_cameras_is_the_callers_mistake(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path, MANIFEST)
    with pytest.raises(ValueError, match="up"):
        writer.add("up", 0, 0, NONE, b"")
    writer.close()


def test_a_recording_without_frames_can_be_taken_back_and_one_with_frames_not(tmp_path: Path) -> None:
    empty = RecordingWriter(tmp_path / "empty", MANIFEST)
    empty.discard()
    empty.discard()
    assert not (tmp_path / "empty").exists()
    (tmp_path / "given").mkdir()
    RecordingWriter(tmp_path / "given", MANIFEST).discard()
    assert not any((tmp_path / "given").iterdir())
    full = RecordingWriter(tmp_path / "full", MANIFEST)
    full.add("left", 0, 0, NONE, encode_png(noise(0)))
    full.discard()
    assert check_whole(tmp_path / "full") == 1


def test_an_image_that_is_none_is_said() -> None:
    with pytest.raises(RecordingError, match="cannot be encoded"):
        encode_png(np.zeros((0, 0, 3), np.uint8))


def test_a_frame_that_does_not_fit_leaves_no_trace_and_the_next_one_may(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path, MANIFEST)
    small, large = encode_png(np.zeros((24, 32, 3), np.uint8)), encode_png(noise(0))
    writer.add("left", 0, 0, NONE, small)
    with file_size_limit(len(large) - 1), pytest.raises(RecordingError, match=r"000001\.png: cannot write"):
        writer.add("left", 1, 1, NONE, large)
    assert check_whole(tmp_path) == 1
    writer.add("left", 2, 2, NONE, large)
    writer.close()
    assert check_whole(tmp_path) == 2
    assert [row.seq for row in open_recording(tmp_path).rows] == [0, 2]


def test_a_row_that_does_not_fit_takes_its_file_away_and_leaves_whole_lines(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path, MANIFEST)
    png = encode_png(np.zeros((24, 32, 3), np.uint8))
    table = tmp_path / "frames.csv"
    with file_size_limit(1000), pytest.raises(RecordingError, match=r"frames\.csv: cannot write: File too"):
        add_until_it_fails(writer, png)
    count = check_whole(tmp_path)
    assert 10 < count < 100
    assert 1000 - 40 < table.stat().st_size <= 1000
    writer.add("left", 1000, 1000, NONE, png)  # somebody made room
    writer.close()
    assert check_whole(tmp_path) == count + 1


def test_a_full_disk_leaves_a_whole_recording(tmp_path: Path) -> None:
    # A page of 4 KiB per tiny file, and one for about 125 rows: the disk ends in a file or in the table.
    ended: set[str] = set()
    png = encode_png(np.zeros((24, 32, 3), np.uint8))
    for kib in (100, *range(480, 560, 4)):
        with small_disk(tmp_path / str(kib), f"{kib}k") as disk:
            writer = RecordingWriter(disk / "wave", MANIFEST)
            with pytest.raises(RecordingError, match="cannot write: No space left on device") as full:
                add_until_it_fails(writer, png)
            ended.add(Path(str(full.value).split(":")[0]).suffix)
            writer.close()
            assert 0 < check_whole(disk / "wave") < kib // 4
    assert ended == {".png", ".csv"}


def test_a_full_disk_takes_no_new_recording_and_keeps_nothing_of_it(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "16k") as disk:
        (disk / "full").write_bytes(bytes(16 * 1024))
        with pytest.raises(RecordingError, match="No space left"):
            RecordingWriter(disk / "wave", MANIFEST)
        (disk / "full").write_bytes(bytes(12 * 1024))
        with pytest.raises(RecordingError, match="No space left"):
            RecordingWriter(disk / "wave", MANIFEST)
        assert [p.name for p in disk.iterdir()] == ["full"]


ENDLESS = """
import sys
from pathlib import Path
from common.recording.frame_writing import RecordingWriter, encode_png
from tests.common.recording.test_frame_writing import MANIFEST, NONE, noise
writer = RecordingWriter(Path(sys.argv[1]), MANIFEST)
png = encode_png(noise(0, 200, 200, 3))
for k in range(10**9):
    writer.add("left", k, k, NONE, png)
"""


@pytest.mark.parametrize("after", [1, 150])
def test_killed_at_any_moment_it_opens_up_to_the_cut(after: int, tmp_path: Path) -> None:
    folder = tmp_path / "wave"
    root = Path(__file__).resolve().parents[3]
    process = subprocess.Popen([sys.executable, "-c", ENDLESS, str(folder)], cwd=root)
    try:
        until(lambda: (folder / f"left/{after:06d}.png").exists())
    finally:
        process.kill()
        process.wait()
    rows = open_recording(folder).rows
    assert [row.seq for row in rows] == list(range(len(rows)))
    assert len(rows) >= after
    for row in rows:
        np.testing.assert_array_equal(cv2.imread(str(folder / row.file)), noise(0, 200, 200, 3))
