"""Read a tracker through libsurvive's own program, survive-cli.

Every line of --record-stdout or --record begins with the program's time [s since its start], then who, then what
(src/survive_recording.c of https://github.com/collabora/libsurvive, read at the versions of 2019 to 2025):

    8.042091 WM0 POSE -0.284080 0.936063 0.374069 0.707107 0.000000 0.000000 0.707107 CR LF
    0.331402 WM0 CONFIG {... "device_serial_number": "LHR-1A2B3C4D" ...} CR LF
    9.112874 WM0 DISCONNECT CR LF
    8.042070 WM0 VELOCITY ...     0.001240 OPTION ...     7.120011 0 LH_POSE ...     0.001000 INFO LOG ...

A pose is the device's in libsurvive's world [m], z up, quaternion w first; decimals, or hexadecimal where built with
SURVIVE_HEX_FLOATS. Lines carry no checksum: the length 1 of a quaternion shows that none was cut. Names (WM0, T20) go
by order of appearance, which a restart may turn about; the serial number stays.

A stamp is when the program wrote the line, by this machine's wall clock, which may be set or slewed, so `DeviceClock`
makes it a time. The constant delay before that is measured by `phalanx-master calibrate tracker`.

The program writes into a pseudo terminal, because into a pipe C's stdio would write blocks of 4 kB, half a second of
poses. It ends with its slave, also with one that was killed: the terminal is that of its session, and hangs up when
nobody has the other end any more (setsid(2), termios(3)). Nothing of the library is loaded (docs/tracker.md).
"""

import gzip
import logging
import math
import os
import pty
import re
import select
import shutil
import subprocess
import threading
import tty
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeAlias, cast

import numpy as np

from common.clock import Clock
from common.errors import TrackerChoiceError, TrackerError
from common.messages import TrackerPose
from slave.clocks import ClockSteppedError, DeviceClock
from slave.sources import Reporting

LONGEST = 1 << 17  # bytes; the longest lines are CONFIG, some 10 kB
_SERIAL = re.compile(rb'"device_serial_number"\s*:\s*"([^"]{1,64})"')
_DEVICE = re.compile(rb"[A-Za-z0-9_.-]{1,32}")


class Pose(NamedTuple):
    """Where a device is; NaN: it does not know."""

    device: str
    t_s: float  # of the program
    position_m: tuple[float, float, float]
    orientation_wxyz: tuple[float, float, float, float]


class Serial(NamedTuple):
    """Which device hides behind a name that is given in the order of appearance."""

    device: str
    serial: str


class Gone(NamedTuple):
    """A device was unplugged or switched off."""

    device: str


class Fault(Enum):
    """Why a line about a pose is none."""

    OVERRUN = "a line without end"
    LENGTH = "not seven numbers"
    NUMBER = "not a number"
    QUATERNION = "quaternion not of length 1"
    PLACE = "farther than any base station reaches"


Found: TypeAlias = Pose | Serial | Gone | Fault


class LineDecoder:
    """Push machine. Holds the bytes of the line that has not ended."""

    def __init__(self) -> None:
        """Begin between two lines."""
        self._rest = b""

    def push(self, data: bytes) -> Iterator[Found]:
        """Parse the lines that end in `data`, in order; other lines yield nothing."""
        lines = (self._rest + data).split(b"\n")
        self._rest = lines.pop()
        if len(self._rest) > LONGEST:
            self._rest = b""
            yield Fault.OVERRUN
        for line in lines:
            found = read_line(line)
            if found is not None:
                yield found


def read_line(line: bytes) -> Found | None:
    """Parse one line without its end; None: nothing that matters here."""
    words = line.split(None, 3)
    if len(words) < 3:
        return None
    who, what = words[1], words[2]
    if what not in (b"POSE", b"CONFIG", b"DISCONNECT") or not _DEVICE.fullmatch(who):
        return None
    device = who.decode("ascii")
    if what == b"DISCONNECT":
        return Gone(device)
    if what == b"CONFIG":
        found = _SERIAL.search(line)
        return None if found is None else Serial(device, found[1].decode("ascii", "replace"))
    return _pose(device, words[0], b"" if len(words) < 4 else words[3])


def _pose(device: str, stamp: bytes, rest: bytes) -> Pose | Fault:
    words = rest.split()
    size = 7  # numbers of a pose
    if len(words) != size:
        return Fault.LENGTH
    try:
        t_s = _number(stamp)
        values = [_number(word) for word in words]
    except (ValueError, OverflowError):
        return Fault.NUMBER
    if not math.isfinite(t_s) or t_s < 0.0:
        return Fault.NUMBER
    if any(math.isnan(value) for value in values):  # it writes them when its solver fails
        values = [math.nan] * size
    x, y, z, *quaternion = values
    place, (qw, qx, qy, qz) = (x, y, z), quaternion
    length = math.hypot(*quaternion)
    # Six decimals are within 3e-6 of length 1; a component that lost its last digits is not within 1e-3
    if abs(length - 1.0) > 1e-3:
        return Fault.QUATERNION
    if math.hypot(*place) > 100.0:  # m: no base station reaches so far
        return Fault.PLACE
    return Pose(device, t_s, place, (qw / length, qx / length, qy / length, qz / length))


def _number(word: bytes) -> float:
    """A number as C's printf writes it by %f or %a."""
    text = word.decode("ascii")
    if "_" in text:  # Python's own spelling, which nobody sends
        raise ValueError(text)
    return float.fromhex(text) if "0x" in text else float(text)


SLEWED = 600e-6  # at most 500 ppm by NTP, and the crystals


class SurviveDevice:
    """Push machine that dates the poses of one device.

    Attributes:
        last_ns: When its newest message holds [ns]; None: there is none yet.
        counts: Events: `broken.` lines by reason, `clock_steps`, `gone`, poses of `others`.
    """

    def __init__(self, name: str, wanted: str | None) -> None:
        """Begin with a program that was just started.

        `wanted`: serial number of the device, or what libsurvive calls it; None: there is one only.
        """
        self._name, self._wanted = name, wanted
        self._decoder = LineDecoder()
        self._clock = DeviceClock(SLEWED)
        self._serials: dict[str, str] = {}
        self._posed: list[str] = []
        self._seq = -1
        self.last_ns: int | None = None
        self.counts: Counter[str] = Counter()

    def push(self, data: bytes, arrival_ns: int) -> list[TrackerPose]:
        """Poses in bytes of `arrival_ns`; TrackerChoiceError: devices, and none selected."""
        ours = [one for found in self._decoder.push(data) if (one := self.take(found)) is not None]
        dated = [(one, self._observe(one, arrival_ns)) for one in ours]  # all, before one becomes a time
        poses: list[TrackerPose] = []
        for one, possible in dated:
            t_ns = self._clock.at(round(one.t_s * 1e9))
            if not possible or (self.last_ns is not None and t_ns <= self.last_ns):
                self.counts["broken.time"] += 1
                continue
            poses.append(self.numbered(t_ns, one))
        return poses

    def numbered(self, t_ns: int, pose: Pose | None) -> TrackerPose:
        """The next message; None: it does not know where it is."""
        self._seq += 1
        self.last_ns = t_ns
        place = np.full(3, np.nan) if pose is None else np.array(pose.position_m)
        quaternion = np.full(4, np.nan) if pose is None else np.array(pose.orientation_wxyz)
        return TrackerPose(self._name, 0, self._seq, t_ns, place, quaternion)

    def there(self) -> str:
        """Return the devices that have reported anything, as text for people."""
        names = dict.fromkeys([*self._posed, *self._serials])
        texts = (f"{one} (serial {self._serials[one]})" if one in self._serials else one for one in names)
        return ", ".join(texts) or "no device at all"

    def take(self, found: Found) -> Pose | None:
        """Take note of a line; the pose if it is one of the device that is meant."""
        if isinstance(found, Fault):
            self.counts[f"broken.{found.name.lower()}"] += 1
        elif isinstance(found, Serial):
            self._serials[found.device] = found.serial
        elif isinstance(found, Gone):
            self.counts["gone"] += self.is_ours(found.device)
        else:
            if found.device not in self._posed:
                self._posed.append(found.device)
            if self.is_ours(found.device):
                return found
            self.counts["others"] += 1
        return None

    def is_ours(self, device: str) -> bool:
        """Whether it is meant; TrackerChoiceError: several have poses, none selected."""
        if self._wanted is not None:
            return self._wanted in (device, self._serials.get(device))
        if len(self._posed) > 1:
            raise TrackerChoiceError(
                f"several devices have poses: {self.there()}; say with --serial which one sits on the object"
            )
        return True

    def _observe(self, pose: Pose, arrival_ns: int) -> bool:
        try:
            return self._clock.observe(round(pose.t_s * 1e9), arrival_ns)
        except ClockSteppedError:  # somebody set the wall clock
            self.counts["clock_steps"] += 1
            self._clock = DeviceClock(SLEWED)
            return self._clock.observe(round(pose.t_s * 1e9), arrival_ns)


PROGRAM = "survive-cli"
OPTIONS = ("--record-stdout", "1", "--record-rawlight", "0", "--record-imu", "0", "--record-angle", "0")
INSTALL = (
    "build libsurvive (https://github.com/collabora/libsurvive) and put survive-cli on the path, or name it with "
    "--program; docs/tracker.md says how"
)
SILENT_NS = 250_000_000  # no pose for so long: it has lost itself
_CHUNK = 1 << 16
# The leader of a new session gets the first terminal that it opens as its own; then it becomes the program.
_IN_ITS_TERMINAL = 'terminal=$1; shift; exec "$0" "$@" <"$terminal"'
_LOG = logging.getLogger(__name__)


class SurviveTracker(Reporting):
    """`TrackerSource` that reads survive-cli."""

    def __init__(
        self,
        name: str,
        wanted: str | None,
        clock: Clock,
        stop: threading.Event,
        program: str = PROGRAM,
        options: Sequence[str] = OPTIONS,
    ) -> None:
        """Start the program; `wanted` as of `SurviveDevice`; TrackerError: it cannot."""
        self._program, self._clock, self._stop = program, clock, stop
        self._device = SurviveDevice(name, wanted)
        self._came: deque[TrackerPose] = deque()
        self._wanted = wanted
        self._received_ns = self._logged_ns = clock.now_ns()
        self._process, self._terminal = _started(program, options)

    def read(self) -> TrackerPose | None:
        """Next pose, or one of NaN while none come; None once stopped or closed.

        Raises TrackerError: the program has ended; TrackerChoiceError: several devices have poses, and none was
        selected.
        """
        while not self._stop.is_set() and self._terminal is not None:
            if self._came:
                self._received_ns = self._logged_ns = self._clock.now_ns()
                return self._came.popleft()
            now_ns = self._clock.now_ns()
            if now_ns - self._received_ns >= SILENT_NS:
                return self._lost(now_ns)
            self._receive(self._terminal)
        return None

    def close(self) -> None:
        """End the program. Safe to call twice."""
        terminal, self._terminal = self._terminal, None
        if terminal is None:
            return
        self._process.terminate()
        try:
            self._process.wait(3.0)  # seconds: it closes its USB devices in that time
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with suppress(OSError):
            os.close(terminal)

    def counts(self) -> Mapping[str, int]:
        """Lines that were broken by reason, clock_steps, gone, others."""
        return dict(self._device.counts)

    def metrics(self) -> Mapping[str, float]:
        """Nothing."""
        return {}

    def _receive(self, terminal: int) -> None:
        ready, _, _ = select.select([terminal], [], [], 0.05)  # then it is looked whether it is to stop
        if not ready:
            return
        try:
            data = os.read(terminal, _CHUNK)
        except OSError:  # EIO: nobody has the other end any more
            data = b""
        if not data:
            code = self._process.wait()
            raise TrackerError(f"{self._program} ended with code {code}: its last lines above may say why")
        self._came.extend(self._device.push(data, self._clock.now_ns()))

    def _lost(self, now_ns: int) -> TrackerPose:
        """A pose of NaN, between the last one and any that may still be on its way."""
        self._received_ns = now_ns
        if now_ns - self._logged_ns >= 10_000_000_000:  # one line in ten seconds
            self._logged_ns = now_ns
            wanted = "any device" if self._wanted is None else self._wanted
            _LOG.warning("%s: no pose of %s; there is %s", self._program, wanted, self._device.there())
        last_ns = self._device.last_ns
        least_ns = 0 if last_ns is None else last_ns + 1
        return self._device.numbered(max(now_ns - SILENT_NS // 2, least_ns), None)


class SurviveFile:
    """`TrackerSource` that plays recorded lines at the pace of their times."""

    def __init__(
        self, name: str, wanted: str | None, path: Path, clock: Clock, stop: threading.Event
    ) -> None:
        """Open the file, plain or compressed, and look which devices it has.

        `wanted` as of `SurviveDevice`; `path`: what `survive-cli --record FILE` wrote, or its --record-stdout; on
        `clock` the recording begins when it is read first.

        Raises:
            TrackerError: The file cannot be read, or has no pose of the device.
            TrackerChoiceError: Several devices have poses, and none was selected.
        """
        self._clock, self._stop = clock, stop
        self._device = SurviveDevice(name, wanted)
        self._poses = iter(_poses_of(path, wanted))
        self._first_s: float | None = None
        self._begin_ns = 0
        self._closed = False

    def read(self) -> TrackerPose | None:
        """Next pose when it is due; None at the end, once stopped or closed."""
        pose = None if self._closed else next(self._poses, None)
        if pose is None:
            return None
        if self._first_s is None:
            self._first_s, self._begin_ns = pose.t_s, self._clock.now_ns()
        t_ns = self._begin_ns + round((pose.t_s - self._first_s) * 1e9)
        while not (self._closed or self._stop.is_set()):
            if (left_ns := t_ns - self._clock.now_ns()) <= 0:
                return self._device.numbered(t_ns, pose)
            self._stop.wait(left_ns * 1e-9)
        return None

    def close(self) -> None:
        """End the stream."""
        self._closed = True


def _poses_of(path: Path, wanted: str | None) -> list[Pose]:
    """The poses of one device in a file, in order of time; raises as `SurviveFile`."""
    decoder, device = LineDecoder(), SurviveDevice("check", wanted)
    every: list[Pose] = []
    try:
        with path.open("rb") as plain:
            packed = plain.read(2) == b"\x1f\x8b"
        with cast(BinaryIO, gzip.open(path)) if packed else path.open("rb") as file:
            while data := file.read(_CHUNK):
                for found in decoder.push(data):
                    device.take(found)
                    if isinstance(found, Pose):
                        every.append(found)
    except EOFError:  # a packed file whose recorder was killed: what is there is whole
        pass
    except OSError as error:
        raise TrackerError(f"{path}: cannot read: {error.strerror or error}") from error
    ours = [one for one in every if device.is_ours(one.device)]
    if not ours:
        what = "a device" if wanted is None else wanted
        raise TrackerError(f"{path}: no pose of {what}; there is {device.there()}")
    rising = [ours[0]]
    for one in ours[1:]:
        if one.t_s > rising[-1].t_s:
            rising.append(one)
    return rising


def _started(program: str, options: Sequence[str]) -> tuple["subprocess.Popen[bytes]", int]:
    """The program, and our end of the terminal that it writes to."""
    found = shutil.which(program)
    if found is None:
        raise TrackerError(f"--device survive: cannot start {program}: no such program: {INSTALL}")
    ours, theirs = pty.openpty()
    try:
        tty.setraw(theirs)
        process = subprocess.Popen(
            ["/bin/sh", "-c", _IN_ITS_TERMINAL, found, os.ttyname(theirs), *options],
            stdin=subprocess.DEVNULL,
            stdout=theirs,
            start_new_session=True,
        )
    except OSError as error:
        os.close(ours)
        raise TrackerError(
            f"--device survive: cannot start {program}: {error.strerror}: {INSTALL}"
        ) from error
    finally:
        os.close(theirs)
    return process, ours
