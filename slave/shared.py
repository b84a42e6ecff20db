"""Give the frames of a running slave to other programs of this machine.

    loop ── offer ──▶ bounded queue per reader ──▶ its thread ──▶ Unix socket ──▶ `SharedCamera` of another process

A camera has one user. While a slave has it, `phalanx-slave record` and `doctor` read its frames, to the last bit, at a
socket that no network reaches. The loop never waits: what a reader's queue has no room for is dropped, and counted
for that reader. root, the slave's own user and members of group `video`, who may open cameras themselves, are served;
everybody else is refused with what to do. A refusal, and a slave that is gone, raise `CameraError`.
"""

import argparse
import logging
import os
import queue
import select
import socket
import struct
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from io import BufferedRWPair
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct

from common.calibration import CameraCalibration, parse
from common.calibration.files import MAX_BYTES
from common.clock import SystemClock
from common.command_line import remark
from common.errors import CameraError, PhalanxError
from common.machine import ROOT
from common.recording.frame_recording import Illumination, Manifest
from slave.drivers import SERVICE
from slave.reconnect import ReconnectingDriver
from slave.sources import Frame, FrameSource

# seq, t_ns, ready_t_ns, how many were dropped for this reader; t_sigma_ns, exposure_us; illumination, (H, W, C) of
# the image, whose bytes follow; C = 0: grey
_HEADER, _LENGTH = struct.Struct("<4q2d4I"), struct.Struct("<I")
_LIT = tuple(Illumination)
_OPENED = ("lights", "luma", "sync", "control", "clock_offset_ms", "clock_ppm")  # how a camera is opened
_NO_SETTING = frozenset({"intrinsics", "markers", "roi_margin", "provenance"})  # of a camera file
_WAIT_S = 2.0  # for a frame, as for that of a camera
_LOG = logging.getLogger(__name__)


class Offer(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """First answer of a slave: why a reader is refused, or what its frames are.

    `opened`: options by which the camera was opened; `manifest`: of a recording of it now.
    """

    refused: str = ""
    opened: dict[str, str] = {}
    manifest: Manifest | None = None


def opened_by(options: argparse.Namespace) -> dict[str, str]:
    """Options of a command by which it opens its camera; empty: not given."""
    return {key: str(getattr(options, key) or "") for key in ("camera", *_OPENED)}


def _settings(camera: CameraCalibration, opened: Mapping[str, str]) -> Mapping[str, object]:
    """What decides how frames of a camera look, by keys of the file and options."""
    of_file = {k: v for k, v in msgspec.structs.asdict(camera).items() if k not in _NO_SETTING}
    return of_file | {f"--{key.replace('_', '-')}": opened[key] for key in _OPENED}


class _Reader:
    """A program that reads, and the frames that wait for it."""

    def __init__(self, end: socket.socket, camera: CameraCalibration, settings: Mapping[str, object]) -> None:
        self.end, self.settings, self.frames, self.dropped = end, settings, 0, 0
        most_bytes = 32_000_000  # the smallest machine leaves 90 MB
        capacity = max(most_bytes // (camera.width_px * camera.height_px * 3), 2)
        self.waiting: queue.Queue[Frame | None] = queue.Queue(capacity)

    def send_all(self) -> None:
        """Send frames until None comes; OSError: nobody takes them."""
        while (frame := self.waiting.get()) is not None:
            stamps = frame.seq, frame.t_ns, frame.ready_t_ns, self.dropped
            seen = frame.t_sigma_ns, frame.exposure_us, _LIT.index(frame.illumination)
            self.end.sendall(_HEADER.pack(*stamps, *seen, *(*frame.image.shape, 0)[:3]))
            self.end.sendall(np.ascontiguousarray(frame.image).data)
            self.frames += 1

    def stop(self) -> None:
        """End at once."""
        with suppress(OSError, queue.Full):
            self.end.shutdown(socket.SHUT_RDWR)
            self.waiting.put_nowait(None)


class FrameServer:
    """Offers the frames of a slave at a socket, where it has a folder for that."""

    def __init__(
        self,
        name: str,
        opened: dict[str, str],
        camera: Callable[[], CameraCalibration],
        manifest: Callable[[], Manifest],
    ) -> None:
        """Listen from now on; `camera` and `manifest` return what is in use now."""
        self._name, self._opened, self._camera, self._manifest = name, opened, camera, manifest
        self._lock, self._server = threading.Lock(), None
        self._readers: tuple[_Reader, ...] = ()  # replaced whole: the loop walks it without the lock
        folder = os.environ.get("RUNTIME_DIRECTORY")  # of a service, by systemd
        for path in [Path(folder) / "frames"] if folder else _places(name)[1:]:
            from socketserver import ThreadingUnixStreamServer  # not on Windows

            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.unlink(missing_ok=True)  # of a slave that died
                server = ThreadingUnixStreamServer(str(path), self._serve)  # type: ignore[arg-type]
                path.chmod(0o666)  # the kernel states who asks
            except OSError as error:
                _LOG.warning("%s: its frames are not shared: %s: %s", name, path, error.strerror or error)
                return
            self._server, server.daemon_threads = server, True
            threading.Thread(target=server.serve_forever, name=f"{name} shared", daemon=True).start()

    def offer(self, frame: Frame) -> None:
        """Queue a frame for all readers. Never waits."""
        for reader in self._readers:
            if _settings(self._camera(), self._opened) != reader.settings:
                reader.stop()  # it was offered others
                continue
            try:
                reader.waiting.put_nowait(frame)
            except queue.Full:
                reader.dropped += 1

    def wanted(self) -> bool:
        """Whether anybody reads."""
        return bool(self._readers)

    def close(self) -> None:
        """End; what still waits is lost."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
        for reader in self._readers:
            reader.stop()

    def _serve(self, end: socket.socket, _address: object, _server: object) -> None:
        """Serve one reader to its end, in a thread of its own."""
        stuck_s = 10.0  # a reader that takes nothing for so long is given up
        end.settimeout(stuck_s)
        with suppress(OSError):
            who, offer = self._offer(end)
            text = msgspec.json.encode(offer)
            end.sendall(_LENGTH.pack(len(text)) + text)
            if offer.manifest is None:
                _LOG.info("%s: its frames are refused to %s: %s", self._name, who, offer.refused)
            elif end.recv(1):  # it wants frames, not only the offer
                camera = offer.manifest.cameras[self._name]
                self._read_by(_Reader(end, camera, _settings(camera, self._opened)), who)

    def _read_by(self, reader: _Reader, who: str) -> None:
        with self._lock:
            self._readers = (*self._readers, reader)
        _LOG.info("%s: its frames are read by %s", self._name, who)
        with suppress(OSError):
            reader.send_all()
        with self._lock:
            self._readers = tuple(one for one in self._readers if one is not reader)
        _LOG.info("%s: %d frames read by %s, %d dropped", self._name, reader.frames, who, reader.dropped)

    def _offer(self, end: socket.socket) -> tuple[str, Offer]:
        """Who asks, by the kernel, and the answer."""
        import grp  # not on Windows

        pid, user, group = struct.unpack("3i", end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        peer_groups, most = 59, 2  # SO_PEERGROUPS of Linux; readers
        groups = {group, *memoryview(end.getsockopt(socket.SOL_SOCKET, peer_groups, 1024)).cast("I")}
        who = f"process {pid} of user {user}"
        video = {one.gr_gid for one in grp.getgrall() if one.gr_name == "video"}
        if user not in (0, os.geteuid()) and not groups & video:
            how = "`sudo usermod -aG video $USER`, then log in again; or use sudo"
            return who, Offer(f"its frames are for root and group video: {how}")
        ends = [reader.end for reader in self._readers]
        gone, _, _ = select.select(ends, [], [], 0.0)  # readers send nothing, but their end
        if len(ends) - len(gone) >= most:
            return who, Offer(f"{most} programs read its frames already: end one of them")
        try:
            return who, Offer(opened=self._opened, manifest=self._manifest())
        except PhalanxError as error:
            return who, Offer(str(error))


def _places(name: str) -> list[Path]:
    """Where a service has its socket; then, in a session, a slave of its user."""
    folders = [os.environ.get(ROOT, "/") + "/run", os.environ.get("XDG_RUNTIME_DIR")]
    if not hasattr(socket, "AF_UNIX"):  # Windows
        return []
    return [Path(folder) / "phalanx" / name / "frames" for folder in folders if folder]


class _NoSlaveError(CameraError):
    """No slave of that name shares its frames here."""


class SharedCamera:
    """A `FrameSource`: frames of the slave `name` of this machine, from now on."""

    def __init__(self, name: str) -> None:
        """Ask what it offers; frames are sent from the first `read` on."""
        self._slave, self._asked, self._dropped = f"slave {name!r}", False, 0
        self._file = _connected(name)
        try:
            (length,) = _LENGTH.unpack(self._bytes(_LENGTH.size))
            self.offer = parse(bytes(self._bytes(min(length, MAX_BYTES))), Offer, f"offer of {self._slave}")
            if self.offer.manifest is None:
                raise CameraError(f"{self._slave}: {self.offer.refused}")
            self.manifest = self.offer.manifest
            self.camera = self.manifest.cameras[name]
        except BaseException:
            self.close()
            raise

    def read(self) -> Frame:
        """The next frame."""
        if not self._asked:
            self._asked = True
            with suppress(OSError):  # it has ended, as the next line sees
                self._file.write(b"+")
                self._file.flush()
        header = _HEADER.unpack(self._bytes(_HEADER.size))
        seq, t_ns, ready_ns, self._dropped, sigma_ns, exposure_us, lit, *shape = header
        shape = shape if shape[2] else shape[:2]
        image = np.frombuffer(self._bytes(int(np.prod(shape))), np.uint8).reshape(shape)
        return Frame(seq, t_ns, ready_ns, image, _LIT[int(lit)], sigma_ns, exposure_us)

    def close(self) -> None:
        """Leave. Safe to call twice."""
        self._file.close()
        if self._dropped:
            _LOG.warning("%s: %d frames dropped: this program was too slow", self._slave, self._dropped)
        self._dropped = 0

    def _bytes(self, count: int) -> bytearray:
        data = bytearray(count)
        try:
            if self._file.readinto(data) == count:
                return data
        except TimeoutError as error:
            raise CameraError(f"{self._slave}: no frame for {_WAIT_S:g} s: its camera is away") from error
        except OSError as error:
            raise CameraError(f"{self._slave}: {error.strerror}") from error
        raise CameraError(f"{self._slave} has ended, or given this reader up: its log states why")


def _connected(name: str) -> BufferedRWPair:
    for path in _places(name):
        with socket.socket(socket.AF_UNIX) as end:
            end.settimeout(_WAIT_S)
            try:
                end.connect(str(path))
                return end.makefile("rwb")
            except (FileNotFoundError, ConnectionRefusedError):
                continue
            except OSError as error:
                raise CameraError(f"slave {name!r}: {path}: {error.strerror or error}; use sudo") from error
    how = f"`systemctl status phalanx-slave@{name}`"
    raise _NoSlaveError(f"no slave {name!r} shares its frames on this machine: {how}")


def shared_camera(
    options: argparse.Namespace, camera: CameraCalibration | None, stop: threading.Event | None
) -> FrameSource | None:
    """Frames of the slave that has the camera that `options` name, or None.

    It has the settings of `camera`, where one is given. Lost, it is waited for until `stop`; without, that is an error.
    """
    name, own = str(options.name), opened_by(options)
    asked, device = own["camera"] == SERVICE, _device(own["camera"])
    if not (asked or device):
        return None

    def opener() -> SharedCamera:
        source = SharedCamera(name)
        if not asked and device != _device(source.offer.opened["camera"]):
            source.close()
            raise _NoSlaveError(f"slave {name!r} has another camera")
        theirs = _settings(source.camera, source.offer.opened)
        wanted = theirs if camera is None else _settings(camera, own)
        alike = ("", "off") if asked else ()  # options that were not given
        wrong = [f"{k} {theirs[k]}, not {v}" for k, v in wanted.items() if v not in (theirs[k], *alike)]
        if not wrong:
            return source
        source.close()
        how = f"give the same, take it as it is (--camera {SERVICE}), or `sudo systemctl stop phalanx-slave@{name}`"
        raise CameraError(f"{name!r} is the camera of a running slave, with {'; '.join(wrong)}: {how}")

    def lost(what: str) -> None:
        longest_s = 30.0  # a slave is back after some seconds, one that was stopped never
        if source.metrics()["away_s"] > longest_s:
            raise CameraError(what)

    try:
        first = opener()
    except _NoSlaveError:
        if asked:
            raise
        return None
    if stop is None:
        return first
    made, rate_hz = [first], first.camera.frame_rate_hz
    source = ReconnectingDriver(
        f"slave {name}", lambda: made.pop() if made else opener(), SystemClock(), stop, lost, rate_hz=rate_hz
    )
    remark(f"{name}: a running slave has the camera, and gives its frames")
    return source


def _device(driver: str) -> str:
    """The device of a real camera; empty: it is none."""
    kind, _, place = driver.partition(":")
    if kind == "v4l2":
        from slave.cameras.v4l2 import device_path  # not on Windows

        return os.path.realpath(device_path(place))
    return f"{kind}:{place or 0}" if kind == "picamera2" else ""
