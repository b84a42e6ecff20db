"""The master publishes results and tracker poses on the bus and asks cameras.

Output interface of the master for hands, objects, contact and gestures.

Behind it are a file, the bus, and any later output.

Bus output of hands, objects, contact and gestures.

For the viewer and for any program of the user.

Publisher of tracker poses on the master's clock.

For registering a tracker: `phalanx calibrate tracker --live`.

A tracker's poses come as datagrams, to the master alone, and mean nothing in the rig until it is registered. So that
the registration can see them beside the objects' poses without being a master itself, they go on the bus as they came.

Asks the cameras for their pictures as long as somebody looks.
"""

import logging
import threading
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeVar

from common.bus.bus import Bus
from common.clock import now_ns
from common.errors import BusError
from common.messages import Command, Contact, Gesture, HandPose, ResultMessage, TrackerPose


class Sink(Protocol):
    """Output that takes the results of the master.

    Those of each hand and object come in the order of their time. Opened by its constructor.
    """

    def write(self, message: ResultMessage) -> None:
        """Take one message. What a sink is not for, it leaves alone.

        Raises:
            PhalanxError: The sink cannot take it (disk full, bus gone); the text names sink and fix.
        """
        ...

    def close(self) -> None:
        """Finish writing.

        What was written is complete and readable from here on. Safe to call twice.

        Raises:
            PhalanxError: The result could not be completed; nothing half written is left.
        """
        ...


_STREAM = {HandPose: "hand", Contact: "contact", Gesture: "gesture"}


class BusSink:
    """A `Sink` that publishes each message on the bus.

    On the stream of its type, under the name of its hand or object.

    The bus belongs to the caller.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def write(self, message: ResultMessage) -> None:
        """Publish the message; a slow or absent reader never delays the master.

        Raises:
            BusError: The bus is closed.
        """
        if isinstance(message, HandPose | Contact | Gesture):
            self._bus.publish(_STREAM[type(message)], message.hand, message)
        else:
            self._bus.publish("object", message.object, message)

    def close(self) -> None:
        """Nothing to finish: the bus is closed by whoever opened it."""


ReceivedT = TypeVar("ReceivedT")
TakenT_co = TypeVar("TakenT_co", covariant=True)


class Taking(Protocol[TakenT_co]):
    """Where messages come from; an `Ingest`."""

    def get(self, timeout_s: float) -> TakenT_co | None:
        """The next message, or None when none came in time."""
        ...


class DevicePoses(Generic[ReceivedT]):
    """Message source that publishes tracker poses as they pass.

    The bus belongs to the caller.
    """

    def __init__(self, source: Taking[ReceivedT], bus: Bus) -> None:
        """Stand between a source and who reads it."""
        self._source, self._bus = source, bus

    def get(self, timeout_s: float) -> ReceivedT | None:
        """The next message; one of a tracker is on the bus, too, stream `device`.

        Raises:
            BusError: The bus is closed.
        """
        message = self._source.get(timeout_s)
        if isinstance(message, TrackerPose):
            self._bus.publish("device", message.source, message)
        return message


TIMEOUT_S = 0.9

_log = logging.getLogger(__name__)


class PictureAsker:
    """Requester of camera pictures, one thread per camera.

    A camera that is not there keeps no other waiting. Holds the threads.
    """

    def __init__(
        self,
        bus: Bus,
        cameras: Iterable[str],
        verb: str = "preview",
        # a camera shows itself for 3 s after each request
        period_s: float = 2.0,
        notify: Callable[[str], None] = _log.info,
    ) -> None:
        """Begin to ask.

        Args:
            bus: Must stay open until `close`.
            cameras: Whom.
            verb: "preview", which a camera shows for three seconds, or "still", one whole frame.
            period_s: From one question to the next.
            say: Called once when a camera does not answer, and again after it was there.
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
        """Stop asking.

        Waits for an unanswered request, at most a second. Safe to call twice.
        """
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
