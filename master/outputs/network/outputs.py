"""Live outputs have names, and each runs on a thread of its own.

An output is a `Sink`, imported when it is switched on: what its library is, nobody else needs. It can be
slow, fail or hang by itself. States: *closed* (not made yet, or it failed; it is made again after a while,
for ever) and *open*. What comes while it is closed, or while its queue is full, is lost to this output alone,
and counted.
"""

import os
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from common.bus.endpoints import loopback
from common.calibration.output_settings import OutputPart, OutputSettings
from common.clock import Clock, SystemClock
from common.errors import PhalanxError
from common.messages import Contact, Gesture, HandPose, ObjectPose, ResultMessage
from master.outputs.bus import Sink
from master.outputs.network.conventions import MasterTimes
from master.outputs.web.listening import is_loopback, is_open


@dataclass(frozen=True, slots=True)
class Output:
    """One row of the registry."""

    takes: tuple[type[ResultMessage], ...]  # types of messages that it is for; others never come to it
    part: Callable[[OutputSettings], OutputPart]  # its settings; where they differ, it is made anew
    where: Callable[[OutputSettings], str]  # where it sends to, for a person
    # opens it. Called on a thread of its own; a `PhalanxError` or `OSError` is reported, and it is retried
    make: Callable[[OutputSettings, MasterTimes], Sink]


def _osc(settings: OutputSettings, times: MasterTimes) -> Sink:
    from master.outputs.network.osc import OscSink

    return OscSink(settings.osc, times)


def _vmc(settings: OutputSettings, times: MasterTimes) -> Sink:
    from master.outputs.network.vmc import VmcSink

    return VmcSink(settings.vmc, times)


def _lsl(settings: OutputSettings, times: MasterTimes) -> Sink:
    from master.outputs.network.lsl import LslSink

    return LslSink(settings.lsl, times)


def _ros2(settings: OutputSettings, times: MasterTimes) -> Sink:
    from master.outputs.network.ros2 import Ros2Sink

    return Ros2Sink(settings.ros2, times)


def _web(settings: OutputSettings, times: MasterTimes) -> Sink:
    from master.outputs.web.server import WebSink

    return WebSink(settings.web)


def _where_web(settings: OutputSettings) -> str:
    from master.outputs.web.server import address_of

    return address_of(settings.web, os.environ)


EVERYTHING: tuple[type[ResultMessage], ...] = (HandPose, ObjectPose, Contact, Gesture)
OUTPUTS: dict[str, Output] = {
    "osc": Output(EVERYTHING, lambda s: s.osc, lambda s: f"udp {s.osc.host}:{s.osc.port}", _osc),
    "vmc": Output((HandPose,), lambda s: s.vmc, lambda s: f"udp {s.vmc.host}:{s.vmc.port}", _vmc),
    "ros2": Output(
        (HandPose, ObjectPose),
        lambda s: s.ros2,
        lambda s: f"router {s.ros2.router}, domain {s.ros2.domain_id}",
        _ros2,
    ),
    "lsl": Output((HandPose,), lambda s: s.lsl, lambda s: f"streams {s.lsl.name}-HAND ({s.lsl.scope})", _lsl),
    "web": Output((HandPose, ObjectPose), lambda s: s.web, _where_web, _web),
}


def who_reads(name: str, settings: OutputSettings) -> str | None:
    """State who else can read an output that leaves this machine; None: it does not.

    These protocols have no encryption and no login: who wrote the file chose that they leave the machine.
    """
    match name:
        case "osc" | "vmc":
            part = settings.osc if name == "osc" else settings.vmc
            leaves = not is_loopback(part.host)
        case "ros2":
            leaves = not loopback(settings.ros2.router)
        case "lsl":
            leaves = settings.lsl.scope != "machine"
        case _:
            if is_loopback(settings.web.host):
                return None
            if is_open(os.environ):
                return "plain (--open): whoever listens to the network reads the hands and the key"
            return "encrypted, by a certificate of this machine; whoever has the key of the address reads the hands"
    if not leaves:
        return None
    return "leaves this machine unencrypted: whoever is in that network reads it, and can send such messages himself"


def switched_on(settings: OutputSettings) -> dict[str, bool]:
    """Output -> whether its settings have it on."""
    return {name: output.part(settings).on for name, output in OUTPUTS.items()}


DEPTH = 64  # messages; what a receiver was too slow for is old by then
FIRST_RETRY_S = 1.0


class Counters:
    """Counts of one output since the process began, also while it is switched off."""

    def __init__(self) -> None:
        self.sent = 0  # messages that it took
        self.failed = 0  # times it could not be opened, or broke on a message
        self.dropped = 0  # messages that it was too slow for, or that came while it was not open
        self.trouble = ""  # why it is not open; empty while nothing is wrong


class OutputLine:
    """Feeds one `Sink` on a thread of its own from a queue that drops its oldest."""

    def __init__(
        self,
        name: str,
        make: Callable[[], Sink],
        counters: Counters,
        notify: Callable[[str], None],
        clock: Clock | None = None,
    ) -> None:
        """Start at once; `make` opens the sink on the line's thread, again on failure."""
        self._name, self._make, self._counters, self._notify = name, make, counters, notify
        self._clock: Clock = SystemClock() if clock is None else clock
        self._queue: deque[ResultMessage] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._sink: Sink | None = None
        self._wait_s = FIRST_RETRY_S
        self._thread = threading.Thread(target=self._work, name=f"output {name}", daemon=True)
        self._thread.start()

    @property
    def open(self) -> bool:
        """Whether its sink is open and takes messages."""
        return self._sink is not None

    @property
    def waiting(self) -> int:
        """Messages in its queue."""
        return len(self._queue)

    def offer(self, message: ResultMessage) -> None:
        """Queue one message without waiting; the oldest makes room, or it is lost."""
        with self._changed:
            if self._sink is None:
                self._counters.dropped += 1
                return
            if len(self._queue) >= DEPTH:
                self._queue.popleft()
                self._counters.dropped += 1
            self._queue.append(message)
            self._changed.notify()

    def close(self) -> None:
        """Send what waits, close the sink and end the thread. Safe to call twice."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        join_s = 3.0  # an output that hangs is left to the end of the process
        self._thread.join(join_s)
        if self._thread.is_alive():
            self._notify(f"{self._name}: hangs and was left behind")

    def _work(self) -> None:
        try:
            while not self._closing or (self._sink is not None and self._queue):
                if self._sink is None:
                    self._open()
                if self._sink is None:
                    self._pause()
                else:
                    self._send()
        finally:  # also after an error that nobody foresaw: what has no thread any more is not open
            self._shut()

    def _open(self) -> None:
        try:
            self._sink = self._make()
        except (PhalanxError, OSError) as error:
            self._failed(error)
            return
        if self._counters.trouble:
            self._notify(f"{self._name}: open again")
        self._counters.trouble, self._wait_s = "", FIRST_RETRY_S

    def _pause(self) -> None:
        """Wait until the next retry."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing, self._wait_s)
        last_retry_s = 10.0
        self._wait_s = min(2.0 * self._wait_s, last_retry_s)

    def _send(self) -> None:
        """Hand on what waits, or wait for more."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._closing)
            messages = list(self._queue)
            self._queue.clear()
        sink = self._sink
        for number, message in enumerate(messages):
            assert sink is not None  # set and cleared by this thread alone
            try:
                sink.write(message)
            except (PhalanxError, OSError) as error:
                self._counters.dropped += len(messages) - number
                self._shut()
                self._failed(error)
                return
            self._counters.sent += 1

    def _shut(self) -> None:
        sink, self._sink = self._sink, None
        if sink is None:
            return
        with self._changed:
            self._counters.dropped += len(self._queue)
            self._queue.clear()
        try:
            sink.close()
        except (PhalanxError, OSError) as error:
            self._notify(f"{self._name}: closing: {error}")

    def _failed(self, error: Exception) -> None:
        """Count a failure, and report it once."""
        self._counters.failed += 1
        text = str(error)
        if text != self._counters.trouble:
            self._notify(f"{self._name}: {text}; tried again")
        self._counters.trouble = text
