"""Raw frames are kept while the slave detects, on command; whatever ends that, the loop goes on and they are whole."""

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree
from typing import cast

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, RigCalibration, load
from common.clock import SystemClock
from common.errors import BusError, CalibrationError
from common.messages import Command, Health, MarkerDetections
from common.messages.command_bodies import RawRequest, raw_name
from common.recording.frame_recording import open_recording
from slave import raw
from slave.__main__ import main
from slave.commands.join import join_recordings
from slave.commands.offline import detect_recording
from slave.markers.detector import Detections
from slave.raw import RawFrames, RawProbe, RawSettings
from slave.report import DetectionCounters, Reporter
from slave.sender import MarkerPipeline, run
from slave.sources import Frame
from slave.tuning import CameraFiles
from slave.uplink import Uplink
from tests.common.recording.test_frame_writing import check_whole
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until
from tests.slave.stand_ins import Wire
from tests.slave.test_recorder import ListCamera

PLENTY = 10**12
PERIOD_NS = 16_666_667


class Slave:
    """One slave whose camera gives what it is told to, and its end of the bus."""

    def __init__(self, calibration: Path, name: str, folder: Path | None, bus: LoopbackBus) -> None:
        self.name, self.bus = name, bus
        paths = calibration / "cameras" / f"{name}.json", calibration / "rigs" / "desk.json"
        camera, rig = load(paths[0], CameraCalibration), load(paths[1], RigCalibration)
        self.files = CameraFiles(*paths, msgspec.structs.replace(camera, exposure_us=1234.0), rig)
        self.free, self.here, self.probe = PLENTY, True, None
        settings = None if folder is None else RawSettings(folder, 1000)
        self.raw = RawFrames(
            name, settings, lambda: self.files, SystemClock(), lambda: self.here, lambda _: self.free
        )
        self.counters = DetectionCounters(rig.markers)
        self.reporter = Reporter(
            name,
            cast(Uplink, Wire(MarkerDetections, "tcp/127.0.0.1:1")),
            self.counters,
            SystemClock(),
            lambda _: bus.join(),
            lambda: None,
            0.01,
            parts=(self.raw,),
        )
        assert until(lambda: name in bus.alive())

    def read(self, given: list[Frame]) -> None:
        """The loop, over these frames."""
        source = self.probe = RawProbe(ListCamera(given), self.raw.offer)
        run(
            source,
            MarkerPipeline(
                self.name,
                77,
                Wire(MarkerDetections, "tcp/127.0.0.1:1").send,
                lambda _image, _t_ns: Detections.none(6),
                self.counters,
            ),
            threading.Event(),
        )

    def ask(self, verb: str, body: str = "") -> Health:
        return self.bus.ask(Command(self.name, verb, body), 10.0)

    def begin(self, name: str, lease_s: float = 0.0) -> Health:
        return self.ask("raw", RawRequest(name=name, lease_s=lease_s).body())

    def close(self) -> None:
        self.reporter.close()
        self.raw.close()


@contextmanager
def slave(
    calibration: Path, folder: Path | None, name: str = "left", bus: LoopbackBus | None = None
) -> Generator[Slave, None, None]:
    started = Slave(calibration, name, folder, bus or LoopbackBus())
    try:
        yield started
    finally:
        started.close()


@pytest.fixture
def calibration(root: Path) -> Path:
    return root / "calib_json"


def frames(count: int, first: int = 0, late_ns: int = 0) -> list[Frame]:
    """Frames of the rig's size, each other than all others."""
    image = np.zeros((480, 640, 3), np.uint8)
    images = [np.full_like(image, 7 * k % 251) for k in range(first, first + count)]
    times = [10**12 + PERIOD_NS * k + late_ns for k in range(first, first + count)]
    return [Frame(first + k, t, t + 1, image) for k, (t, image) in enumerate(zip(times, images, strict=True))]


def test_frames_between_the_commands_are_kept_to_the_last_bit_and_join(
    calibration: Path, tmp_path: Path
) -> None:
    bus, folder = LoopbackBus(), tmp_path / "raw"
    folder.mkdir()
    with slave(calibration, folder, "left", bus) as left, slave(calibration, folder, "right", bus) as right:
        left.read(frames(3))  # nobody asked: nothing is kept
        assert left.ask("report").counts["raw.frames"] == 0
        for number, one in enumerate((left, right)):
            assert one.begin(raw_name("wave", one.name)).metrics["raw.on"] == 1.0
            one.read(frames(10, 3, late_ns=number))
            assert one.begin(raw_name("wave", one.name)).metrics["raw.on"] == 1.0, "asked again: it goes on"
            with pytest.raises(BusError, match="is being recorded: raw_stop ends it"):
                one.begin("other")
        for one in (left, right):
            assert one.probe is not None
            one.probe.flush()  # as at the end of the loop, whose last frame is kept, too
            one.raw.close()
            answer = one.ask("raw_stop")
            assert (
                answer.counts["raw.frames"],
                answer.counts["raw.dropped"],
                answer.counts["raw.ended"],
            ) == (
                10,
                0,
                0,
            )
            assert answer.metrics["raw.on"] == 0.0
            assert answer.metrics["raw.megabytes"] > 0.0
        with pytest.raises(BusError, match="wave-left: holds something already"):
            left.begin("wave-left")
    assert check_whole(folder / "wave-left") == check_whole(folder / "wave-right") == 10
    kept = open_recording(folder / "wave-left")
    assert [row.seq for row in kept.rows] == list(range(3, 13))
    assert kept.manifest.clock is not None
    assert kept.manifest.cameras.keys() == {"left", "right"}
    assert kept.manifest.cameras["left"].exposure_us == 1234.0, "as in use, saved or not"
    assert join_recordings([folder / "wave-left", folder / "wave-right"], tmp_path / "wave") == {
        "left": 10,
        "right": 10,
    }
    assert detect_recording(tmp_path / "wave", "right").seq.tolist() == list(range(3, 13))


def test_it_says_why_it_does_not_begin(calibration: Path, tmp_path: Path) -> None:
    with slave(calibration, None) as left:
        assert "raw.frames" not in left.ask("report").counts
        for verb in ("raw", "raw_stop"):
            with pytest.raises(
                BusError, match=rf"{verb}: this slave keeps no raw frames: .*--raw-folder DIR"
            ):
                left.ask(verb)
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "notes.txt").write_text("mine")
    tree = tmp_path / "tree"
    copytree(calibration, tree)
    (tree / "cameras" / "right.json").unlink()
    with slave(tree, tmp_path) as left:
        for name in ("..", ".hidden", "a/b", "", "x" * 65):
            with pytest.raises(CalibrationError, match="name"):
                RawRequest.of(f'{{"name": "{name}"}}')
        with pytest.raises(BusError, match=r"files of all cameras of rig 'desk': .*right\.json"):
            left.begin("wave")
        with pytest.raises(BusError, match="raw_stop: takes no body"):
            left.ask("raw_stop", "wave")
        left.free = 500
        with pytest.raises(BusError, match=r"stay free \(--raw-reserve-mb\): make room"):
            left.begin("wave")
    with slave(calibration, tmp_path) as left, pytest.raises(BusError, match="kept: holds something already"):
        left.begin("kept")
    assert (tmp_path / "kept" / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "wave").exists()


def test_a_full_disk_ends_the_recording_and_not_the_loop(
    calibration: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    with slave(calibration, tmp_path) as left:
        left.begin("wave")
        left.read(frames(4))
        assert until(lambda: left.ask("report").counts["raw.frames"] == 4)
        left.free = 1500
        left.read(frames(6, 4))
        assert until(lambda: left.ask("report").counts["raw.ended"] == 1)
        assert "raw frames ended" in caplog.text
        assert "--raw-reserve-mb" in caplog.text
        left.free = PLENTY
        with pytest.raises(BusError, match="wave: ended after 4 frames"):
            left.begin("wave")
        left.begin("wave-2")
        small = Frame(20, 10**13, 10**13, np.zeros((24, 32, 3), np.uint8))
        left.read([*frames(2, 10), small, *frames(2, 21)])
        assert until(lambda: left.ask("report").counts["raw.ended"] == 2)
        assert left.counters.counts()["frames"] == 15, "the loop has seen all of them"
    assert check_whole(tmp_path / "wave") == 4
    assert check_whole(tmp_path / "wave-2") == 2


def test_it_ends_when_nobody_is_left_who_could_end_it(
    calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(raw, "GONE_S", 0.05)
    with slave(calibration, tmp_path) as left:

        def ends(name: str) -> bool:
            over = until(lambda: left.raw.metrics()["raw.on"] == 0.0)
            left.ask("raw_stop")
            return over and check_whole(tmp_path / name) == 6

        left.begin("lease", lease_s=1.0)
        left.read(frames(6))
        assert ends("lease")
        left.begin("gone")
        left.read(frames(6))
        left.here = False
        assert ends("gone")
        left.here = True
        left.begin("slave")
        left.read(frames(6))
    assert check_whole(tmp_path / "slave") == 6
    assert not [one for one in threading.enumerate() if one.name.startswith("left ")]


def test_a_folder_that_cannot_be_made_is_said_before_a_camera_is_opened(
    calibration: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PHALANX_RIG_KEY", "00" * 32)
    (tmp_path / "file").write_text("")
    arguments = ["run", "--name", "left", "--camera", "replay:nowhere", "--calibration", str(calibration)]
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    try:
        assert main([*arguments, "--raw-folder", str(tmp_path / "file")]) == 1
        assert "file: cannot make it: File exists" in capsys.readouterr().err
        assert main([*arguments, "--raw-folder", str(tmp_path / "raw")]) == 1
    finally:
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(number, handler)
    assert "nowhere" in capsys.readouterr().err
    assert (tmp_path / "raw").is_dir()
