"""Tracker source that reads libsurvive's own program, survive-cli.

The program is started here and its lines are read; or the lines of a file are.

The library has no Linux wheel, so nothing of it is loaded: whoever wants it builds it (docs/tracker.md). The program
writes its lines into a pseudo terminal, because into a pipe C's stdio would write blocks of 4 kB, half a second of
poses at once; its messages to people go to stderr, as ever. It ends with its slave, also with one that was killed: the
terminal is that of its session, and hangs up when nobody has the other end any more (setsid(2), termios(3)).
"""

import gzip
import logging
import os
import pty
import select
import shutil
import subprocess
import threading
import tty
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, cast

from common.clock import Clock
from common.errors import TrackerError
from common.messages import TrackerPose
from slave.objects.survive_lines import LineDecoder, Pose, Serial, SurviveDevice

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


class SurviveTracker:
    """`TrackerSource` that reads survive-cli.

    Holds the program, its terminal, and poses not handed over yet.
    """

    def __init__(
        self,
        name: str,
        wanted: str | None,
        clock: Clock,
        stop: threading.Event,
        program: str = PROGRAM,
        options: Sequence[str] = OPTIONS,
    ) -> None:
        """Start the program.

        Args:
            name: Of the device in our messages.
            wanted: Its serial number, or what libsurvive calls it; None: there is one only.
            clock: The slave's clock.
            stop: Set when the slave is to end.
            program: Name or path of survive-cli.
            options: What it is called with.

        Raises:
            TrackerError: There is no such program, or it cannot be started.
        """
        self._program, self._clock, self._stop = program, clock, stop
        self._device = SurviveDevice(name, wanted)
        self._came: deque[TrackerPose] = deque()
        self._wanted = wanted
        self._received_ns = self._logged_ns = clock.now_ns()
        self._process, self._terminal = _started(program, options)

    def read(self) -> TrackerPose | None:
        """Next pose, or one of NaN while none come; None once stopped or closed.

        Raises:
            TrackerError: The program has ended.
            TrackerChoiceError: Several devices have poses, and none was selected.
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
        """Read what has come, and wait a little for it."""
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
        """Return a pose of NaN for a lost device.

        Its time is between the last pose and any that may still be on its way.
        """
        self._received_ns = now_ns
        if now_ns - self._logged_ns >= 10_000_000_000:  # one line in ten seconds
            self._logged_ns = now_ns
            wanted = "any device" if self._wanted is None else self._wanted
            _LOG.warning("%s: no pose of %s; there is %s", self._program, wanted, self._device.there())
        t_ns = now_ns - SILENT_NS // 2
        if self._device.last_ns is not None:
            t_ns = max(t_ns, self._device.last_ns + 1)
        return self._device.numbered(t_ns, None)


class SurviveFile:
    """`TrackerSource` that plays recorded lines at the pace of their times.

    Holds the open file.
    """

    def __init__(
        self, name: str, wanted: str | None, path: Path, clock: Clock, stop: threading.Event
    ) -> None:
        """Open the file, plain or compressed, and look which devices it has.

        Args:
            name: Of the device in our messages.
            wanted: Its serial number, or what libsurvive calls it; None: there is one only.
            path: What `survive-cli --record FILE` wrote, or its --record-stdout.
            clock: The slave's clock, on which the recording begins when it is read first.
            stop: Ends the stream, also while a pose is waited for.

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
    """The poses of one device in a file, in order of time.

    Raises:
        TrackerError: As `SurviveFile`.
    """
    decoder, device = LineDecoder(), SurviveDevice("check", wanted)
    names: dict[str, str] = {}
    every: list[Pose] = []
    broken: Counter[str] = Counter()
    try:
        with path.open("rb") as plain:
            packed = plain.read(2) == b"\x1f\x8b"
        with cast(BinaryIO, gzip.open(path)) if packed else path.open("rb") as file:
            while data := file.read(_CHUNK):
                for found in decoder.push(data):
                    if isinstance(found, Pose):
                        every.append(found)
                    elif isinstance(found, Serial):
                        names[found.device] = found.serial
                    else:
                        broken[type(found).__name__] += 1
                device.push(data, 0)  # refuses a choice that nobody made
    except EOFError:  # a packed file whose recorder was killed: what is there is whole
        pass
    except OSError as error:
        raise TrackerError(f"{path}: cannot read: {error.strerror or error}") from error
    ours = [one for one in every if wanted is None or wanted in (one.device, names.get(one.device))]
    if not ours:
        what = "a device" if wanted is None else wanted
        raise TrackerError(f"{path}: no pose of {what}; there is {device.there()}")
    rising = [ours[0]]
    for one in ours[1:]:
        if one.t_s > rising[-1].t_s:
            rising.append(one)
    return rising


def _started(program: str, options: Sequence[str]) -> tuple["subprocess.Popen[bytes]", int]:
    """The program, and our end of the terminal that it writes to.

    Raises:
        TrackerError: It cannot be started.
    """
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
