"""A running master publishes its inputs while a recorder asks for them.

A message goes on the bus (stream `taken`) once all that it yields is out, in the order of receipt, with those
of the same fifth of a second, by a `Worker`: no pose waits for it. The worker may wait for a reader, so that
none is lost on the way; where it waits for too long, what does not fit its queue is dropped and counted.
While nobody taps, a message costs one comparison.

`phalanx run --record FILE` starts a recorder process, which is there before the first message is taken, so
that a replay is what was published live from the first pose on. When its standard input, a pipe from this
process, closes, because we end it or because we died, it ends its file. It is in a group of its own, so that
Ctrl-C stops the tracking first.
"""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from common.bus.bus import Bus
from common.clock import Clock
from common.errors import BusError, RecordingError
from common.messages import Backlog, Message
from common.messages.streams import MASTER, sender_of
from common.supervisor import NEW_GROUP
from master.outputs.bus import Receive
from master.outputs.worker import Worker
from master.rig.setup import RigFiles

if TYPE_CHECKING:
    from master.run.solver_supervisor import LoadShedding

LEASE_NS = 3_000_000_000
_DRAIN_S = 5.0

ReceivedT = TypeVar("ReceivedT", bound=Message)


class Probe:
    """Whether somebody taps, and what is to be shown; `show` belongs to the loop."""

    def __init__(self, bus: Bus, clock: Clock, *, always: bool = False) -> None:
        """Show nothing until `lease`; with `always` everything from the first message on."""
        self._bus, self._clock, self._always = bus, clock, always
        self._until_ns = 0
        self._at_once = threading.Event()
        self._shown = self._dropped = 0
        self._skipped, self._again = 0, False  # as was shown last; a reader may not have been there
        self._worker = Worker[Message]("tap", self._work, 20_000)  # some seconds
        self._worker.start()

    @property
    def counts(self) -> dict[str, int]:
        """`tap.shown`, and of those `tap.dropped`, once there were any."""
        if not self._shown:
            return {}
        # What waits to be published can be nobody's loss yet.
        return {"tap.shown": self._shown - self._worker.waiting, "tap.dropped": self._dropped}

    def lease(self) -> None:
        """Show everything for three seconds from now, and how far behind the master is."""
        self._again = True
        self._until_ns = self._clock.now_ns() + LEASE_NS

    def show(self, message: Message, skip: int = 0) -> None:
        """Queue a message if somebody taps, after the number of dropped epochs if new."""
        if not self._always:
            if self._until_ns == 0:
                return
            if self._clock.now_ns() >= self._until_ns:
                self._until_ns = 0
                return
        if skip != self._skipped or (self._again and skip):
            self._skipped = skip
            self._put(Backlog(MASTER, came_ns(message, self._clock.now_ns()), skip))
        self._again = False
        self._put(message)

    def _put(self, message: Message) -> None:
        self._shown += 1
        self._dropped += self._worker.offer(message) is not None

    def end_always(self) -> None:
        """Show messages only to those who tap: the recorder that wanted all is gone."""
        self._always = False

    def drain(self) -> None:
        """Wait until all that was shown is on its way, at most some seconds."""
        self._at_once.set()
        self._worker.drain(_DRAIN_S)
        self._at_once.clear()

    def close(self) -> None:
        """Show nothing any more. Safe to call twice."""
        self._worker.clear()
        self._at_once.set()
        self._worker.close(_DRAIN_S)

    def _work(self) -> None:
        while self._worker.wait():
            batch_s = 0.2  # to wake a thread and a link for each message would cost several times as much
            self._at_once.wait(batch_s)
            while (message := self._worker.take(0.0)) is not None:
                try:
                    self._bus.publish("taken", sender_of(message), message)
                except BusError:
                    self._dropped += 1  # the bus is closed: the master ends


def came_ns(message: Message, now_ns: int) -> int:
    """Return when a message was available: at its slave, else measured, else now."""
    return getattr(message, "ready_t_ns", None) or getattr(message, "t_ns", now_ns)


class Tapped(Generic[ReceivedT]):
    """Source that shows each message, and the backlog, when the next is requested.

    By then its reader has processed the message as far as it can.
    """

    def __init__(self, receive: Receive[ReceivedT], probe: Probe, load_shedding: "LoadShedding") -> None:
        """Stand between a source and who reads it."""
        self._receive, self._probe, self._load_shedding = receive, probe, load_shedding
        self._last: ReceivedT | None = None

    def get(self, timeout_s: float) -> ReceivedT | None:
        """The next message, or None when none came in time."""
        self.flush()
        self._last = self._receive(timeout_s)
        if self._last is not None:
            self._load_shedding.look(self._last)
        return self._last

    def flush(self) -> None:
        """At the end: the last message, too."""
        last, self._last = self._last, None
        if last is not None:
            self._probe.show(last, self._load_shedding.skip)


class RecorderProcess:
    """A running recorder."""

    def __init__(
        self,
        path: Path,
        files: RigFiles,
        endpoint: str,
        notify: Callable[[str], None],
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Start it for our open bus at `endpoint`.

        `notify` is called with each line that it prints, `ended`, on another thread, once it is gone.
        """
        self._notify, self._ended, self._path = notify, ended, path
        self._name = f"recorder-{os.getpid()}"
        self._process = subprocess.Popen(
            _command(path, files, endpoint, self._name),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            creationflags=NEW_GROUP,
        )
        self._last = ""
        self._thread = threading.Thread(target=self._listen, name="recorder lines", daemon=True)
        self._thread.start()

    # 60 s: Python, numpy and the bus on a busy machine
    def wait_ready(self, bus: Bus, timeout_s: float = 60.0) -> None:
        """Wait until the recorder receives all that follows; RecordingError: it does not."""
        deadline = time.monotonic() + timeout_s
        while self._name not in bus.alive():
            if self._process.poll() is not None:
                self._thread.join(1.0)
                raise RecordingError(
                    f"{self._path}: the recorder ended at once: {self._last or 'it printed nothing'}"
                )
            if time.monotonic() > deadline:
                self.close()
                raise RecordingError(f"{self._path}: the recorder was not ready within {timeout_s:g} s")
            step_s = 0.05
            time.sleep(step_s)

    def close(self) -> None:
        """Let the recorder end its file while the bus is open. Safe to call twice."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            end_s = 20.0
            code = self._process.wait(end_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self._thread.join(1.0)
        if code:
            self._notify(f"the recording is not whole: {self._last}")

    def _listen(self) -> None:
        assert self._process.stdout is not None  # it is a pipe
        with self._process.stdout:
            for line in self._process.stdout:
                self._last = line.strip()
                self._notify(self._last)
        self._ended()


def _command(path: Path, files: RigFiles, endpoint: str, name: str) -> list[str]:
    command = [sys.executable, "-m", "master", "record", str(path), "--bus", endpoint, "--owned", name]
    command += ["--calibration", str(files.calibration)]
    for rig in files.rigs:
        command += ["--rig", rig]
    return command if files.hand is None else [*command, "--hand", str(files.hand)]
