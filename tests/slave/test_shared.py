"""A slave gives its frames to programs of its machine: to the last bit, without waiting, and to nobody else."""

import grp
import os
import socket
import subprocess
import sys
import threading
import time
from argparse import Namespace
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError, CameraError
from common.recording.frame_recording import Illumination, Manifest
from slave.cameras.v4l2_abi import users_of
from slave.cli.table import PROGRAM
from slave.raw import RawProbe
from slave.shared import FrameServer, SharedCamera, opened_by, shared_camera
from slave.sources import Frame
from tests.network_helpers import until
from tests.slave.test_recorder import ListCamera

PERIOD_NS = 16_666_667


class Slave:
    """One end: a slave of the rig `desk` that offers what its loop is given."""

    def __init__(self, calibration: Path, folder: Path, words: str = "") -> None:
        self.camera = load(calibration / "cameras/left.json", CameraCalibration)
        self.rig = load(calibration / "rigs/desk.json", RigCalibration)
        self.fault: CalibrationError | None = None
        self.options = options("run", f"--camera v4l2:/dev/video7 {words}")
        self.server = FrameServer("left", opened_by(self.options), lambda: self.camera, self.manifest)
        self.path = folder / "phalanx/left/frames"

    def manifest(self) -> Manifest:
        if self.fault is not None:
            raise self.fault
        cameras = {"left": self.camera, "right": msgspec.structs.replace(self.camera, name="right")}
        return Manifest(version=1, kind="markers", cameras=cameras, rig=self.rig)

    def read(self, given: list[Frame]) -> None:
        """The loop, over these frames."""
        source = RawProbe(ListCamera(given), self.server.offer)
        while source.read() is not None:
            pass


def options(verb: str, words: str) -> Namespace:
    """Options of a command for the camera `left`."""
    more = ["-o", "out"] if verb == "record" else []
    return PROGRAM.parse([verb, "--name", "left", *words.split(), *more])[1]


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch) -> Generator[Path, None, None]:
    """What stands for the folder of a session, open to all; no service is looked for on this machine."""
    with TemporaryDirectory() as place:
        monkeypatch.setenv("XDG_RUNTIME_DIR", place)
        monkeypatch.setenv("PHALANX_SYSTEM_ROOT", f"{place}/root")
        Path(place).chmod(0o755)
        yield Path(place)


@pytest.fixture
def slave(root: Path, folder: Path) -> Generator[Slave, None, None]:
    made = Slave(root / "calib_json", folder)
    yield made
    made.server.close()


def frames(count: int, shape: tuple[int, ...] = (480, 640, 3), first: int = 0) -> list[Frame]:
    """Frames of noise, each with its own number and light."""
    rng, lit = np.random.default_rng(5), tuple(Illumination)
    return [
        Frame(
            first + k,
            10**12 + PERIOD_NS * (first + k),
            10**12 + PERIOD_NS * (first + k) + 77,
            rng.integers(0, 256, shape, np.uint8),
            lit[k % len(lit)],
            50e3 + k,
            5000.0 + k,
        )
        for k in range(count)
    ]


def reading(slave: Slave, count: int = 1) -> list[SharedCamera]:
    """Programs that have asked for frames."""
    readers = [SharedCamera("left") for _ in range(count)]
    for reader in readers:
        reader._file.write(b"+")
        reader._file.flush()
        reader._asked = True
    assert until(lambda: len(slave.server._readers) == count)
    return readers


@pytest.mark.parametrize("shape", [(480, 640, 3), (480, 640)])
def test_frames_arrive_as_they_were_read_with_the_files_in_use(slave: Slave, shape: tuple[int, ...]) -> None:
    given = frames(9, shape)
    given[4] = msgspec.structs.replace(given[4], image=given[4].image[:, ::-1])  # not contiguous
    (reader,) = reading(slave)
    slave.read(given)
    with closing(reader):
        got = [reader.read() for _ in given]
        assert reader.manifest == slave.manifest()
    for one, other in zip(given, got, strict=True):
        assert other is not None
        np.testing.assert_array_equal(one.image, other.image)
        assert other.image.dtype == np.uint8
        for name in ("seq", "t_ns", "ready_t_ns", "illumination", "t_sigma_ns", "exposure_us"):
            assert getattr(one, name) == getattr(other, name)


def test_a_slow_reader_loses_frames_and_never_holds_up_the_loop(
    slave: Slave, caplog: pytest.LogCaptureFixture
) -> None:
    slow, quick = reading(slave, 2)
    taken: list[Frame] = []

    def take() -> None:
        while len(taken) < 200:
            taken.append(quick.read())

    thread = threading.Thread(target=take)
    thread.start()
    longest_s, given = 0.0, frames(20)
    for k in range(200):
        began = time.monotonic()
        slave.server.offer(msgspec.structs.replace(given[k % 20], seq=k))
        longest_s = max(longest_s, time.monotonic() - began)
        assert until(lambda upto=k: len(taken) > upto - 5)
    thread.join()
    assert [frame.seq for frame in taken] == list(range(200))
    assert longest_s < 0.1  # what a busy machine takes; a queue that waited would never go on
    got = []
    with closing(slow):
        while not got or slow._dropped == 0:
            if not got or len(got) > 30:
                slave.server.offer(given[0])
            frame = slow.read()
            assert frame is not None
            got.append(frame)
        dropped = slow._dropped
    assert 100 < dropped < 200
    assert f"{dropped} frames dropped: this program was too slow" in caplog.text
    quick.close()


def test_readers_that_are_gone_are_forgotten_and_a_third_is_refused(slave: Slave) -> None:
    one, other = reading(slave, 2)
    with pytest.raises(CameraError, match="2 programs read its frames already"):
        SharedCamera("left")
    one.close()
    other.close()
    SharedCamera("left").close()  # served, though no frame has shown yet that the two are gone

    def gone() -> bool:
        slave.server.offer(frames(1)[0])
        return not slave.server.wanted()

    assert until(gone)
    (third,) = reading(slave)
    slave.read(frames(1))
    assert third.read() is not None
    third.close()


def test_a_program_that_only_looks_at_the_offer_is_no_reader(slave: Slave) -> None:
    for _ in range(5):
        SharedCamera("left").close()
    assert not slave.server.wanted()


def test_frames_of_other_settings_are_never_given_in_their_place(slave: Slave, root: Path) -> None:
    file = load(root / "calib_json/cameras/left.json", CameraCalibration)
    other = msgspec.structs.replace(file, exposure_us=4000.0, markers=None)
    same = options("record", "--camera v4l2:/dev/video7")
    with pytest.raises(
        CameraError, match=r"running slave, with exposure_us 5000\.0, not 4000\.0: give the same, take it"
    ):
        shared_camera(same, other, None)
    with pytest.raises(CameraError, match="--control , not \\['gain=32'\\]"):
        shared_camera(options("record", "--camera v4l2:7 --control gain=32"), file, None)
    for words, wanted in (
        ("--camera v4l2:7", msgspec.structs.replace(file, markers=None, intrinsics=None)),
        ("--camera service", file),
        ("--camera picamera2", None),
    ):
        source = shared_camera(options("record", words), wanted, None)
        assert (source is None) == (wanted is None)
        if source is not None:
            source.close()
    (reader,) = reading(slave)
    slave.camera = msgspec.structs.replace(slave.camera, markers=None)  # no setting of the camera
    slave.read(frames(1))
    assert reader.read() is not None
    slave.camera = other  # as `phalanx camera` does
    slave.read(frames(1, first=1))
    with pytest.raises(CameraError, match="has ended, or given this reader up"):
        reader.read()
    reader.close()


def test_a_slave_whose_tree_is_broken_says_so_to_readers(slave: Slave) -> None:
    slave.fault = CalibrationError("calib_json/cameras/right.json: cannot read")
    with pytest.raises(CameraError, match=r"slave 'left': calib_json/cameras/right\.json: cannot read"):
        SharedCamera("left")


def test_without_a_slave_a_camera_is_opened_as_ever_and_service_is_an_error(folder: Path) -> None:
    assert shared_camera(options("record", "--camera picamera2"), None, None) is None
    with pytest.raises(
        CameraError, match="no slave 'left' shares its frames on this machine: `systemctl status"
    ):
        shared_camera(options("record", "--camera service"), None, None)


def test_a_socket_left_by_a_killed_slave_is_taken_over(root: Path, folder: Path) -> None:
    path = folder / "phalanx/left/frames"
    path.parent.mkdir(parents=True)
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with pytest.raises(CameraError, match="no slave"):
        SharedCamera("left")
    slave = Slave(root / "calib_json", folder)
    SharedCamera("left").close()
    slave.server.close()


def test_a_folder_that_cannot_be_made_costs_the_sharing_alone(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / ("long" * 30)))
    slave = Slave(root / "calib_json", tmp_path)
    slave.read(frames(2))
    slave.server.close()
    assert "left: its frames are not shared: " in caplog.text
    assert "AF_UNIX path too long" in caplog.text


ASK = """
import grp, os, sys
from pathlib import Path
from slave.shared import SharedCamera
from common.errors import CameraError
user, groups = int(sys.argv[1]), [int(one) for one in sys.argv[2:]]
os.setgroups(groups)
os.setgid(user)
os.setuid(user)
try:
    print(SharedCamera("left").camera.name)
except CameraError as error:
    print(error)
"""


def test_only_root_the_slaves_user_and_group_video_are_served(slave: Slave) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can become another user")
    video = str(grp.getgrnam("video").gr_gid)

    def ask(*who: str) -> str:
        done = subprocess.run([sys.executable, "-c", ASK, *who], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    refused = ask("65534", "65534")
    assert refused.startswith(
        "slave 'left': its frames are for root and group video: `sudo usermod -aG video"
    )
    assert ask("65534", "65534", video) == "left"
    assert ask("0") == "left"


LOCK = """
import fcntl, sys, time
file = open(sys.argv[1], "w")
if sys.argv[2] == "lock":
    fcntl.lockf(file, fcntl.LOCK_EX)
print("has it", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("how", ["lock", "open"])
def test_who_has_a_device_is_named(tmp_path: Path, how: str) -> None:
    device = tmp_path / "media0"
    device.touch()
    assert users_of(device) == f"another program may have it: `sudo fuser -v {device}` names it"
    holder = subprocess.Popen(
        [sys.executable, "-c", LOCK, str(device), how],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "has it\n"
        for pattern in (device, tmp_path / "media*"):
            text = users_of(pattern)
            assert f"(process {holder.pid}" in text
            assert "import fcntl" in text
            assert text.endswith(": end that")
    finally:
        holder.kill()
        holder.communicate()
