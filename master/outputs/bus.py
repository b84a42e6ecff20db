"""The master publishes results and tracker poses on the bus and asks cameras.

A tracker's poses come as datagrams, to the master alone, and mean nothing in the rig until it is registered.
So that the registration (`phalanx calibrate tracker --live`) sees them beside the objects' poses without
being a master itself, they go on the bus as they came.
"""

import logging
import threading
from collections.abc import Callable, Iterable
from typing import Protocol, TypeAlias, TypeVar

from common.bus.bus import Bus
from common.clock import now_ns
from common.errors import BusError
from common.messages import Command, Contact, Gesture, HandPose, ResultMessage, TrackerPose


class Sink(Protocol):
    """Output that takes the master's results, of each hand and object in time order."""

    def write(self, message: ResultMessage) -> None:
        """Take one message. What a sink is not for, it leaves alone.

        Raises:
            PhalanxError: The sink cannot take it (disk full, bus gone); the text names sink and fix.
        """
        ...

    def close(self) -> None:
        """Finish writing: what was written is complete and readable. Safe to call twice.

        Raises:
            PhalanxError: The result could not be completed; nothing half written is left.
        """
        ...


_STREAM = {HandPose: "hand", Contact: "contact", Gesture: "gesture"}


class BusSink:
    """A `Sink` that publishes on the caller's bus, on the stream of each type."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def write(self, message: ResultMessage) -> None:
        """Publish the message; a slow or absent reader never delays the master."""
        if isinstance(message, HandPose | Contact | Gesture):
            self._bus.publish(_STREAM[type(message)], message.hand, message)
        else:
            self._bus.publish("object", message.object, message)

    def close(self) -> None:
        """Nothing to finish: the bus is closed by whoever opened it."""


ReceivedT = TypeVar("ReceivedT")
# the next message, or None when none came in so many seconds; `get` of an `Ingest`'s queue
Receive: TypeAlias = Callable[[float], ReceivedT | None]


def publishing_devices(receive: Receive[ReceivedT], bus: Bus) -> Receive[ReceivedT]:
    """The source `receive`, which publishes tracker poses on the bus as they pass."""

    def get(timeout_s: float) -> ReceivedT | None:
        message = receive(timeout_s)
        if isinstance(message, TrackerPose):
            bus.publish("device", message.source, message)
        return message

    return get


TIMEOUT_S = 0.9

_log = logging.getLogger(__name__)


class PictureAsker:
    """Requester of camera pictures, one thread each: no camera keeps another waiting."""

    def __init__(
        self,
        bus: Bus,
        cameras: Iterable[str],
        verb: str = "preview",
        period_s: float = 2.0,
        notify: Callable[[str], None] = _log.info,
    ) -> None:
        """Begin to ask.

        Args:
            bus: Must stay open until `close`.
            verb: "preview", which a camera shows for three seconds, or "still", one whole frame.
            notify: Called once when a camera does not answer, and again after it was there.
        """
        self._bus, self._verb, self._period_s, self._notify = bus, verb, period_s, notify
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._work, args=(camera,), name=f"{verb} {camera}", daemon=True)
            for camera in cameras
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop asking; waits at most a second for an answer. Safe to call twice."""
        self._closing.set()
        for thread in self._threads:
            thread.join()

    def _work(self, camera: str) -> None:
        silent, due_ns = False, now_ns()
        while not self._closing.wait(max(due_ns - now_ns(), 0) * 1e-9):
            # Never faster than it answers, and no burst after it was away.
            due_ns = max(due_ns + round(self._period_s * 1e9), now_ns())
            try:
                self._bus.ask(Command(camera, self._verb), TIMEOUT_S)
                silent = False
            except BusError as error:
                if not silent and not self._closing.is_set():
                    self._notify(f"no picture of camera {camera} yet: {error}")
                silent = True
