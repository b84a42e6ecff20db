"""Live outputs have names, and each runs on a thread of its own.

An output is a `Sink`, imported when it is switched on: what its library is, nobody else needs. It can be
slow, fail or hang by itself. States: *closed* (not made yet, or it failed; it is made again after a while,
for ever) and *open*. What comes while it is closed, or while its queue is full, is lost to this output alone,
and counted.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from common.bus.endpoints import loopback
from common.calibration.output_settings import OutputPart, OutputSettings
from common.errors import PhalanxError
from common.messages import Contact, Gesture, HandPose, ObjectPose, ResultMessage
from master.outputs.bus import Sink
from master.outputs.network.conventions import MasterTimes
from master.outputs.web.listening import is_loopback, is_open
from master.outputs.worker import Worker


@dataclass(frozen=True, slots=True)
class Output:
    """One row of the registry."""

    takes: tuple[type[ResultMessage], ...]  # types of messages that it is for; others never come to it
    part: Callable[[OutputSettings], OutputPart]  # its settings; where they differ, it is made anew
    where: Callable[[OutputSettings], str]  # where it sends to, for a person
    # opens it. Called on a thread of its own; a `PhalanxError` or `OSError` is reported, and it is retried
    make: Callable[[OutputSettings, MasterTimes], Sink]


def _sink(name: str, kind: str) -> Callable[[OutputSettings, MasterTimes], Sink]:
    """Maker of the sink `kind` in module `name`, of the settings of that name."""

    def make(settings: OutputSettings, times: MasterTimes) -> Sink:
        module = import_module(f"master.outputs.network.{name}")
        return getattr(module, kind)(getattr(settings, name), times)

    return make


def _web(settings: OutputSettings, times: MasterTimes) -> Sink:
    from master.outputs.web.server import WebSink

    del times  # a page shows what is newest
    return WebSink(settings.web)


def _where_web(settings: OutputSettings) -> str:
    from master.outputs.web.server import address_of

    return address_of(settings.web, os.environ)


OUTPUTS: dict[str, Output] = {
    "osc": Output(
        (HandPose, ObjectPose, Contact, Gesture),
        lambda s: s.osc,
        lambda s: f"udp {s.osc.host}:{s.osc.port}",
        _sink("osc", "OscSink"),
    ),
    "vmc": Output(
        (HandPose,),
        lambda s: s.vmc,
        lambda s: f"udp {s.vmc.host}:{s.vmc.port}",
        _sink("vmc", "VmcSink"),
    ),
    "ros2": Output(
        (HandPose, ObjectPose),
        lambda s: s.ros2,
        lambda s: f"router {s.ros2.router}, domain {s.ros2.domain_id}",
        _sink("ros2", "Ros2Sink"),
    ),
    "lsl": Output(
        (HandPose,),
        lambda s: s.lsl,
        lambda s: f"streams {s.lsl.name}-HAND ({s.lsl.scope})",
        _sink("lsl", "LslSink"),
    ),
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


@dataclass(slots=True)
class Counters:
    """Counts of one output since the process began, also while it is switched off."""

    sent: int = 0  # messages that it took
    failed: int = 0  # times it could not be opened, or broke on a message
    dropped: int = 0  # messages that it was too slow for, or that came while it was not open
    trouble: str = ""  # why it is not open; empty while nothing is wrong


class OutputLine:
    """Feeds one `Sink` by a `Worker`, and opens it again on failure."""

    def __init__(
        self, name: str, make: Callable[[], Sink], counters: Counters, notify: Callable[[str], None]
    ) -> None:
        """Start at once; `make` opens the sink on the worker's thread."""
        self._name, self._make, self._counters, self._notify = name, make, counters, notify
        self._sink: Sink | None = None
        self._retry_s = FIRST_RETRY_S
        self._worker = Worker[ResultMessage](f"output {name}", self._work, DEPTH, loses_oldest=True)
        self._worker.start()

    @property
    def open(self) -> bool:
        """Whether its sink is open and takes messages."""
        return self._sink is not None

    @property
    def waiting(self) -> int:
        """Messages in its queue."""
        return self._worker.waiting

    def offer(self, message: ResultMessage) -> None:
        """Queue one message without waiting; the oldest makes room, or it is lost."""
        lost = message if self._sink is None else self._worker.offer(message)
        self._counters.dropped += lost is not None

    def close(self) -> None:
        """Send what waits, close the sink and end the thread. Safe to call twice."""
        join_s = 3.0  # an output that hangs is left to the end of the process
        if not self._worker.close(join_s):
            self._notify(f"{self._name}: hangs and was left behind")

    def _work(self) -> None:
        try:
            while not self._worker.closing or (self._sink is not None and self._worker.waiting):
                try:
                    if self._sink is None:
                        self._open()
                    elif (message := self._worker.take()) is not None:
                        self._sink.write(message)
                        self._counters.sent += 1
                except (PhalanxError, OSError) as error:
                    self._failed(error)
        finally:  # also after an error that nobody foresaw: what has no thread any more is not open
            self._shut()

    def _open(self) -> None:
        self._sink = self._make()
        if self._counters.trouble:
            self._notify(f"{self._name}: open again")
        self._counters.trouble, self._retry_s = "", FIRST_RETRY_S

    def _failed(self, error: Exception) -> None:
        """Count a failure, report it once, and open the output again."""
        broke = self._sink is not None
        self._counters.dropped += broke  # the message that it broke on
        self._shut()
        self._counters.failed += 1
        text = str(error)
        if text != self._counters.trouble:
            self._notify(f"{self._name}: {text}; tried again")
        self._counters.trouble = text
        if not broke:
            last_retry_s = 10.0
            self._worker.rest(self._retry_s)
            self._retry_s = min(2.0 * self._retry_s, last_retry_s)

    def _shut(self) -> None:
        sink, self._sink = self._sink, None
        self._counters.dropped += len(self._worker.clear())
        if sink is None:
            return
        try:
            sink.close()
        except (PhalanxError, OSError) as error:
            self._notify(f"{self._name}: closing: {error}")
