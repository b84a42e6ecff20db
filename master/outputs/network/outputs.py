"""Live outputs have names, and each runs on a thread of its own.

Live outputs by name.

What each takes, where it sends to, and how it is made.

An output is a `Sink`. Its file is imported when it is switched on: what its library is, nobody else needs.

One live output as it runs.

Its queue and its thread, so that it can be slow, fail or hang by itself.

States: *closed* (not made yet, or it failed; it is made again after a while, for ever) and *open*. What comes while it
is closed, or while its queue is full, is lost to this output alone, and counted.
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
from master.outputs.network.conventions import Times
from master.outputs.web.listening import is_loopback, is_open


@dataclass(frozen=True, slots=True)
class Output:
    """One row of the registry.

    Attributes:
        takes: Types of messages that it is for; others never come to it.
        part: Its settings; where they differ, it is made anew.
        where: Where it sends to, for a person.
        make: Opens it. Called on a thread of its own; a `PhalanxError` or `OSError` is reported, and it is retried.
    """

    takes: tuple[type[ResultMessage], ...]
    part: Callable[[OutputSettings], OutputPart]
    where: Callable[[OutputSettings], str]
    make: Callable[[OutputSettings, Times], Sink]


def _osc(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.osc import OscSink

    return OscSink(settings.osc, times)


def _vmc(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.vmc import VmcSink

    return VmcSink(settings.vmc, times)


def _lsl(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.lsl import LslSink

    return LslSink(settings.lsl, times)


def _ros2(settings: OutputSettings, times: Times) -> Sink:
    from master.outputs.network.ros2 import Ros2Sink

    return Ros2Sink(settings.ros2, times)


def _web(settings: OutputSettings, times: Times) -> Sink:
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
    """State who else can read an output that leaves this machine.

    Also what they can do; None where the output does not leave it.

    These protocols have no encryption and no login: that they leave the machine is the choice of who wrote the file.
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
    """Counts of one output since the process began.

    They outlive the output's being switched off.

    Attributes:
        sent: Messages that it took.
        failed: Times it could not be opened, or broke on a message.
        dropped: Messages that it was too slow for, or that came while it was not open.
        trouble: Why it is not open; empty while nothing is wrong.
    """

    def __init__(self) -> None:
        self.sent = self.failed = self.dropped = 0
        self.trouble = ""


class OutputLine:
    """Feeds one `Sink` on a thread of its own from a queue that drops its oldest.

    Holds the queue, and the sink while it is open.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], Sink],
        counters: Counters,
        notify: Callable[[str], None],
        clock: Clock | None = None,
    ) -> None:
        """Start at once.

        `make` opens the sink and is called on the line's own thread, again after each failure.
        """
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
        """Queue one message without waiting.

        The oldest makes room, or the message is lost while the output is closed.
        """
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
        """Count a failure, and report it once.

        The same trouble again is not reported.
        """
        self._counters.failed += 1
        text = str(error)
        if text != self._counters.trouble:
            self._notify(f"{self._name}: {text}; tried again")
        self._counters.trouble = text
