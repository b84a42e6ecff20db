"""The recorder never makes the camera wait, keeps what it took to the last bit, and ends with a whole recording."""

import io
import json
import math
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import msgspec
import numpy as np
import pytest

from common.calibration import ImuCalibration, RigCalibration, load, save
from common.clock import SystemClock
from common.errors import CameraError, RecordingError
from common.imu.csv_table import read_imu
from common.recording.frame_recording import Illumination, Manifest, open_recording
from slave.__main__ import main
from slave.cameras.replay import ReplayCamera
from slave.commands.offline import detect_recording
from slave.markers.detector import MarkerDetector
from slave.recorder import Length, Progress, ProgressDisplay, Recorder, clock_of, feed, progress_text
from slave.sources import Frame
from tests.common.recording.test_frame_writing import check_whole, small_disk
from tests.network_helpers import until
from tests.slave.painted import NAMES, camera, hand, render

ROOT = Path(__file__).resolve().parents[2]
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
RIG = RigCalibration(
    version=1,
    name="desk",
    kind="markers",
    cameras=("left",),
    hand="default-right",
    T_rig_camera={"left": POSE},
)
SMALL = camera(32, 24)
PERIOD_NS = 16_666_667
PLENTY = 10**12


def manifest(model: object = SMALL) -> Manifest:
    return Manifest(version=1, kind="markers", cameras={"left": msgspec.convert(model, type(SMALL))}, rig=RIG)


def frames(count: int, first: int = 0, shape: tuple[int, ...] = (24, 32, 3)) -> list[Frame]:
    """Frames of pure noise, which no encoder makes smaller."""
    rng = np.random.default_rng(5)
    images = [rng.integers(0, 256, shape, np.uint8) for _ in range(count)]
    times = [10**12 + PERIOD_NS * k for k in range(first, first + count)]
    return [Frame(first + k, t, t + 1, image) for k, (t, image) in enumerate(zip(times, images, strict=True))]


class ListCamera:
    """A camera that gives the frames of a list and then ends, or dies."""

    def __init__(self, content: Sequence[Frame], dies: bool = False) -> None:
        self._left: Iterator[Frame] = iter(content)
        self._dies = dies
        self.given = 0

    def read(self) -> Frame | None:
        frame = next(self._left, None)
        if frame is None and self._dies:
            raise CameraError("left: unplugged")
        self.given += frame is not None
        return frame

    def close(self) -> None:
        pass


class Gate:
    """Free space of a disk that does not answer before it is opened."""

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.opened = threading.Event()

    def __call__(self, folder: Path) -> int:
        if threading.current_thread().name.endswith("_write_all"):
            self.asked.set()
            self.opened.wait()
        return PLENTY


def run(
    folder: Path,
    source: ListCamera,
    length: Length | None = None,
    free: Callable[[Path], int] = lambda _folder: PLENTY,
    reserve: int = 0,
) -> Recorder:
    recorder = Recorder(
        folder, manifest(), "left", length or Length(), reserve_bytes=reserve, free_bytes=free
    )
    try:
        feed(source, recorder, threading.Event())
    finally:
        recorder.close()
    return recorder


def test_it_replays_with_the_same_bits_and_times(tmp_path: Path) -> None:
    given = frames(40, first=7)
    given[3] = msgspec.structs.replace(given[3], illumination=Illumination.LASER)
    done = run(tmp_path / "wave", ListCamera(given)).progress()
    assert (done.frames, done.dropped, done.lost) == (40, 0, 0)
    assert done.written_bytes == sum(p.stat().st_size for p in (tmp_path / "wave").rglob("*.png"))
    replayed = ReplayCamera(tmp_path / "wave", "left", paced=False, clock=SystemClock())
    for frame in given:
        again = replayed.read()
        assert again is not None
        assert (again.seq, again.t_ns, again.illumination) == (frame.seq, frame.t_ns, frame.illumination)
        np.testing.assert_array_equal(again.image, frame.image)
    assert replayed.read() is None


def test_grey_frames_replay_as_grey(tmp_path: Path) -> None:
    given = frames(2, shape=(24, 32))
    run(tmp_path, ListCamera(given))
    again = ReplayCamera(tmp_path, "left", paced=False, clock=SystemClock()).read()
    assert again is not None
    np.testing.assert_array_equal(again.image, np.repeat(given[0].image[..., None], 3, axis=2))


def test_detections_of_the_recording_are_those_of_the_live_camera(tmp_path: Path) -> None:
    model = camera()
    detector = MarkerDetector(model, NAMES)
    given = [
        Frame(k, PERIOD_NS * k, PERIOD_NS * k, render(hand(300.0 + 4.0 * k), noise=2.0, seed=k))
        for k in range(6)
    ]
    recorder = Recorder(tmp_path, manifest(model), "left", Length(), reserve_bytes=0)
    live = []
    for frame in given:
        recorder.offer(frame)
        live.append(detector.push(frame.image, frame.t_ns))
    recorder.close()
    found = detect_recording(tmp_path, "left")
    assert np.isfinite(found.uv).all()
    np.testing.assert_array_equal(found.uv, [d.uv for d in live])
    np.testing.assert_array_equal(found.area_px2, [d.area for d in live])
    np.testing.assert_array_equal(found.quality, [d.quality for d in live])
    np.testing.assert_array_equal(found.t_ns, [frame.t_ns for frame in given])


def test_a_disk_that_stands_still_costs_frames_and_no_time(tmp_path: Path) -> None:
    gate = Gate()
    raw = 32 * 24 * 3
    recorder = Recorder(
        tmp_path, manifest(), "left", Length(), reserve_bytes=0, queue_bytes=5 * raw, free_bytes=gate
    )
    given = frames(30)
    recorder.offer(given[0])
    assert gate.asked.wait(60.0)  # the writer holds frame 0; five more may wait
    for frame in given[1:20]:
        recorder.offer(frame)  # comes back, although nothing moves behind it
        assert recorder.progress().waiting <= 5
    assert recorder.progress().dropped == 14
    gate.opened.set()
    assert until(lambda: recorder.progress().frames == 6, 60.0)
    for frame in given[20:]:
        recorder.offer(frame)
        assert until(lambda: recorder.progress().waiting == 0, 60.0)
    recorder.close()
    rows = open_recording(tmp_path).rows
    assert [row.seq for row in rows] == [0, 1, 2, 3, 4, 5, *range(20, 30)]  # the gap is in plain sight
    assert [row.t_ns for row in rows] == [given[row.seq].t_ns for row in rows]
    assert check_whole(tmp_path) == 16


def test_what_the_camera_lost_is_distinguished_from_what_was_dropped(tmp_path: Path) -> None:
    given = frames(10)
    done = run(tmp_path, ListCamera([*given[:3], *given[5:7], given[9]])).progress()
    assert (done.frames, done.dropped, done.lost) == (6, 0, 4)


def test_seconds_are_those_of_the_camera(tmp_path: Path) -> None:
    source = ListCamera(frames(30))
    done = run(tmp_path, source, Length(seconds=10 * PERIOD_NS * 1e-9)).progress()
    assert done.frames == 10
    assert done.left_s == 0.0
    assert source.given == 11  # the first frame after the end says that it is the end


def test_frames_are_those_recorded_and_not_one_more_is_read(tmp_path: Path) -> None:
    source = ListCamera(frames(30))
    assert run(tmp_path, source, Length(frames=4)).progress().frames == 4
    assert source.given == 4
    source = ListCamera(frames(30))
    assert run(tmp_path / "both", source, Length(seconds=1.0, frames=3)).progress().frames == 3


def test_too_little_room_for_what_is_asked_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    frame_bytes = 2400  # 32x24 of noise
    recorder = run(
        tmp_path / "wave", ListCamera(frames(300)), Length(seconds=3.0), lambda _: 100 * frame_bytes
    )
    with pytest.raises(
        RecordingError, match=r"180 frames of 0\.0 MB need 0\.4 MB, 0\.2 MB are free.*make room"
    ):
        raise recorder.failure or AssertionError
    assert recorder.progress().frames == 0
    assert not (tmp_path / "wave").exists()
    assert (
        run(tmp_path / "wave", ListCamera(frames(50)), Length(frames=30), lambda _: 100 * frame_bytes).failure
        is None
    )
    assert check_whole(tmp_path / "wave") == 30


def test_it_ends_at_the_reserve_of_the_disk(tmp_path: Path) -> None:
    def free(folder: Path) -> int:
        return 50_000 - sum(p.stat().st_size for p in folder.rglob("*.png"))

    recorder = run(tmp_path, ListCamera(frames(300)), free=free, reserve=20_000)
    count = recorder.progress().frames
    with pytest.raises(
        RecordingError, match=rf"ended after {count} frames: 0\.0 MB are free .* stay free \(--reser"
    ):
        raise recorder.failure or AssertionError
    assert check_whole(tmp_path) == count
    assert 20_000 <= free(tmp_path) < 20_000 + 2500


def test_a_disk_that_is_pulled_is_said(tmp_path: Path) -> None:
    calls = iter(range(100))

    def free(_folder: Path) -> int:
        if threading.current_thread().name.endswith("_write_all") and next(calls) == 5:
            raise OSError(5, "Input/output error")
        return PLENTY

    recorder = run(tmp_path, ListCamera(frames(20)), free=free)
    with pytest.raises(RecordingError, match="the disk is gone: Input/output error"):
        raise recorder.failure or AssertionError
    done = recorder.progress()
    assert check_whole(tmp_path) == done.frames == 5


def test_a_camera_that_dies_leaves_a_whole_recording(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="unplugged"):
        run(tmp_path, ListCamera(frames(12), dies=True))
    assert check_whole(tmp_path) == 12


def test_an_image_of_another_size_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="gives 16x12 px of uint8, its file says 32x24 px"):
        run(tmp_path / "wave", ListCamera(frames(3, shape=(12, 16, 3))))
    assert not (tmp_path / "wave").exists()


def test_closed_twice_and_offered_after_the_end(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, manifest(), "left", Length(frames=2), reserve_bytes=0)
    for frame in frames(6):
        recorder.offer(frame)
    recorder.close()
    recorder.close()
    assert check_whole(tmp_path) == 2
    assert not [t for t in threading.enumerate() if t.name.startswith("left ")]


PROGRESS = Progress(532, 3, 0, 7, 138, 10**8, 38.14e6, 74_200_000_000, 8.9, 7.4, math.inf)


def test_the_line_says_what_a_person_wants_to_know() -> None:
    assert progress_text(PROGRESS) == "532 frames, 3 dropped, queue 7/138, 38.1 MB/s, 74.2 GB free, 7 s left"
    assert progress_text(replace(PROGRESS, lost=2, left_s=None, disk_s=99.0, free_bytes=5 * 10**8)) == (
        "532 frames, 3 dropped, 2 lost by the camera, queue 7/138, 38.1 MB/s, 500.0 MB free, disk full in 99 s"
    )
    assert progress_text(replace(PROGRESS, disk_s=3.0)).endswith("disk full in 3 s")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Torn(io.StringIO):
    def write(self, _text: str) -> int:
        raise BrokenPipeError


def test_a_terminal_is_written_in_place_and_a_file_line_by_line() -> None:
    terminal, file = Terminal(), io.StringIO()
    for stream in (terminal, file, Torn()):
        display = ProgressDisplay("left", stream)
        for _ in range(11):
            display.show(PROGRESS)
        display.end(PROGRESS)
    assert terminal.getvalue().count("\r") == 12
    assert terminal.getvalue().count("\n") == 1
    lines = file.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[-1] == "left: 532 frames in 8.90 s, 3 dropped, 0 lost by the camera, 100.0 MB"


def test_the_clock_is_named_and_lies_as_the_wall_clock_says() -> None:
    clock, again, other = clock_of(SystemClock()), clock_of(SystemClock()), clock_of(SystemClock(), " +3 ms")
    assert clock is not None
    assert again is not None
    assert other is not None
    assert clock.id == again.id != other.id
    assert abs(clock.wall_ahead_ns - (time.time_ns() - time.monotonic_ns())) < 10**9


def tree(folder: Path, count: int = 240, rate_hz: float = 1000.0) -> list[str]:
    """A calibration tree and a recording of noise in it; the arguments that record from it."""
    model = msgspec.structs.replace(SMALL, frame_rate_hz=rate_hz)
    for name in ("rigs", "cameras"):
        (folder / name).mkdir()
    save(folder / "rigs/desk.json", RIG)
    save(folder / "cameras/left.json", model)
    given = [
        msgspec.structs.replace(frame, t_ns=round(k * 1e9 / rate_hz)) for k, frame in enumerate(frames(count))
    ]
    run(folder / "given", ListCamera(given))
    return [
        "record",
        "--name",
        "left",
        "--calibration",
        str(folder),
        "--camera",
        f"replay:{folder / 'given'}",
    ]


def same_images(one: Path, other: Path) -> int:
    """Compare the frames of `one` with those of the same `seq` of `other`; how many there are."""
    files = {row.seq: (other / row.file).read_bytes() for row in open_recording(other).rows}
    rows = open_recording(one).rows
    for row in rows:
        assert (one / row.file).read_bytes() == files[row.seq]
    return len(rows)


def test_the_command_records_what_the_camera_gives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = tree(tmp_path, 30)
    out = tmp_path / "recordings/wave"
    before = signal.getsignal(signal.SIGINT)
    assert (
        main([*arguments, "-o", str(out), "--note", "two hands", "--seconds", "60", "--reserve-mb", "0"]) == 0
    )
    assert signal.getsignal(signal.SIGINT) is before
    assert same_images(out, tmp_path / "given") == check_whole(out) == 30
    recorded = open_recording(out).manifest
    assert recorded.note == "two hands"
    assert recorded.rig == RIG
    assert recorded.clock is not None
    output = capsys.readouterr()
    assert f"left: recorded in {out}" in output.out
    assert "left: 30 frames in 0.03 s, 0 dropped, 0 lost by the camera" in output.err


def test_the_command_records_the_simulated_camera(tmp_path: Path) -> None:
    calibration = ["--rig", "desk", "--calibration", str(ROOT / "calib_json"), "--reserve-mb", "0"]
    out = tmp_path / "wave"
    arguments = ["record", "--name", "left", "--camera", "synthetic", "--frames", "3", "-o", str(out)]
    assert main([*arguments, *calibration]) == 0
    assert check_whole(out) == 3
    assert set(open_recording(out).manifest.cameras) == {"left", "right"}
    assert np.isfinite(detect_recording(out, "left").uv[..., 0]).any(axis=1).all()


def test_the_command_records_the_simulated_imu_on_the_clock_of_the_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = tmp_path / "calib_json"
    copytree(ROOT / "calib_json", files)
    arguments = [
        "record",
        "--name",
        "left",
        "--calibration",
        str(files),
        "--reserve-mb",
        "0",
        "--frames",
        "6",
    ]
    arguments += ["--imu", "--clock-offset-ms", "7000", "--camera"]
    assert main([*arguments, "synthetic", "-o", str(tmp_path / "none")]) == 1
    assert "rig 'desk': imu: missing" in capsys.readouterr().err
    imu = ImuCalibration(name="palm", q_palm_imu=(1.0, 0.0, 0.0, 0.0), q_rig_world=(0.6, 0.8, 0.0, 0.0))
    rig = load(files / "rigs" / "desk.json", RigCalibration)
    save(files / "rigs" / "desk.json", msgspec.structs.replace(rig, imu=imu))
    out = tmp_path / "wave"
    assert main([*arguments, "synthetic", "-o", str(out)]) == 0
    frames, samples = open_recording(out).rows, read_imu(out, "palm")
    assert samples[0].t_ns <= frames[0].t_ns
    assert samples[-1].t_ns >= frames[-1].t_ns
    assert np.diff([one.t_ns for one in samples]) == pytest.approx(1e9 / imu.rate_hz, abs=2)
    assert main([*arguments, "replay:nowhere", "-o", str(tmp_path / "no")]) == 1
    assert "--imu: only a hand before a synthetic camera" in capsys.readouterr().err
    assert main([*arguments, "synthetic", "--scene", "board", "-o", str(tmp_path / "no")]) == 1
    assert not (tmp_path / "no").exists()


def test_the_command_refuses_what_it_should_not_touch(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = tree(tmp_path, 3)
    assert main([*arguments, "-o", str(tmp_path / "given")]) == 1
    assert "given: holds something already" in capsys.readouterr().err
    assert check_whole(tmp_path / "given") == 3
    assert main([*arguments, "-o", str(tmp_path / "wave"), "--reserve-mb", "1e12"]) == 1
    assert "stay free (--reserve-mb)" in capsys.readouterr().err
    assert not (tmp_path / "wave").exists()
    assert main([*arguments[:-1], "replay:nowhere", "-o", str(tmp_path / "wave")]) == 1
    assert not (tmp_path / "wave").exists()
    for bad in (["--seconds", "0"], ["--seconds", "nan"], ["--frames", "0"], ["--queue-mb", "-1"]):
        with pytest.raises(SystemExit, match="2"):
            main([*arguments, "-o", str(tmp_path / "wave"), *bad])


def start(arguments: Sequence[str], limit: int | None = None) -> "subprocess.Popen[str]":
    """The command as a process, with files of at most `limit` bytes."""

    def restrict() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.Popen(
        [sys.executable, "-m", "slave", *arguments],
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=restrict,
    )


def test_a_full_disk_ends_the_command_with_a_whole_recording(tmp_path: Path) -> None:
    arguments = tree(tmp_path)
    with small_disk(tmp_path / "disk", "200k") as disk:
        process = start([*arguments, "-o", str(disk / "wave"), "--reserve-mb", "0"])
        _, output = process.communicate(timeout=120.0)
        assert process.returncode == 1, output
        assert "frames.csv: cannot write: No space left" in output or "stay free (--reserve-mb)" in output
        assert 20 < same_images(disk / "wave", tmp_path / "given") == check_whole(disk / "wave") < 50


@pytest.mark.parametrize(("limit", "count"), [(2300, 0), (6000, 100)])
def test_a_limit_of_the_system_ends_the_command_with_a_whole_recording(
    limit: int, count: int, tmp_path: Path
) -> None:
    arguments = tree(tmp_path)
    process = start([*arguments, "-o", str(tmp_path / "wave"), "--reserve-mb", "0"], limit)
    _, output = process.communicate(timeout=120.0)
    assert process.returncode == 1, output
    assert "cannot write: File too large" in output
    if count:
        assert same_images(tmp_path / "wave", tmp_path / "given") == check_whole(tmp_path / "wave") > count
    else:
        assert not (tmp_path / "wave").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_stopped_by_hand_or_killed_there_is_a_recording(number: signal.Signals, tmp_path: Path) -> None:
    arguments = tree(tmp_path, rate_hz=5.0)
    out = tmp_path / "wave"
    process = start([*arguments, "-o", str(out), "--reserve-mb", "0"])
    begun = until(lambda: (out / "left/000002.png").exists(), 60.0)
    os.kill(process.pid, number)
    output_text, output = process.communicate(timeout=120.0)
    assert begun, output
    if number == signal.SIGKILL:
        assert process.returncode == -9
        assert 2 <= same_images(out, tmp_path / "given")
    else:
        assert process.returncode == 0, output
        assert f"recorded in {out}" in output_text
        assert 3 <= same_images(out, tmp_path / "given") == check_whole(out) < 240
    assert json.loads((out / "recording.json").read_text())["cameras"]["left"]["frame_rate_hz"] == 5.0
