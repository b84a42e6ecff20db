"""Connection of the console to the bus.

It reopens by itself whenever a master comes or goes.
"""

import logging
import threading
from collections.abc import Callable, Mapping

from common.bus.bus import Bus, Subscription
from common.errors import BusError
from common.messages import Command, Health, Message

POLL_S = 0.5  # between two looks at who is alive
ANSWER_S = 20.0  # a slow camera shows its new settings after some seconds

_LOG = logging.getLogger(__name__)
Take = Callable[[Message], None]


class Link:
    """Bus connection that also holds which processes are alive.

    It holds the bus while there is one, and one thread keeps both up to date.
    """

    def __init__(self, open_bus: Callable[[], Bus], take: Mapping[str, Take]) -> None:
        """Begin to connect.

        Args:
            open_bus: Opens the bus, or raises `BusError` while nobody listens there.
            take: Stream -> what is called with each of its messages, on a thread of its own; must not raise.
        """
        self._open_bus, self._take = open_bus, dict(take)
        self._bus: Bus | None = None
        self._alive: frozenset[str] = frozenset()
        self._reason = "not connected yet"
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="console link", daemon=True)
        self._thread.start()

    @property
    def up(self) -> bool:
        """Whether somebody is reached."""
        return bool(self._alive)

    @property
    def alive(self) -> frozenset[str]:
        """Names of the processes that are reached."""
        return self._alive

    @property
    def reason(self) -> str:
        """Why nobody is reached; empty while somebody is."""
        return "" if self.up else self._reason

    def ask(self, command: Command, timeout_s: float = ANSWER_S) -> Health:
        """Send a command and wait for the answer; never on the thread of the page.

        Raises:
            BusError: There is no bus, nobody answered in time, or the target refused; the text states which.
        """
        bus = self._bus
        if bus is None:
            raise BusError(f"no answer from {command.target!r} to {command.verb!r}: {self._reason}")
        return bus.ask(command, timeout_s)

    def close(self) -> None:
        """Leave the bus. Safe to call twice."""
        self._closing.set()
        self._thread.join(2.0 * ANSWER_S)

    def _work(self) -> None:
        while not self._closing.is_set():
            try:
                bus = self._open_bus()
            except BusError as error:
                self._reason = str(error)
                self._closing.wait(POLL_S)
                continue
            try:
                self._wait(bus)
            finally:
                self._bus, self._alive = None, frozenset()
                bus.close()

    def _wait(self, bus: Bus) -> None:
        """Read and look around until the others are gone or the console ends."""
        ended = threading.Event()
        depth = 64
        inboxes = {stream: bus.subscribe(stream, depth=depth) for stream in self._take}
        readers = [
            threading.Thread(target=_read, args=(inbox, self._take[stream], ended), name=f"read {stream}")
            for stream, inbox in inboxes.items()
        ]
        for reader in readers:
            reader.daemon = True
            reader.start()
        self._bus = bus
        empty = 0
        try:
            missed_polls = 4  # so often nobody was alive: the connection is made anew
            while empty < missed_polls and not self._closing.is_set():
                self._alive = bus.alive()
                empty = 0 if self._alive else empty + 1
                self._closing.wait(POLL_S)
            self._reason = "the master is gone"
        except BusError as error:
            self._reason = str(error)
        finally:
            ended.set()
            for inbox in inboxes.values():
                inbox.close()
            for reader in readers:
                reader.join(2.0)


def _read(inbox: Subscription, take: Take, ended: threading.Event) -> None:
    while not ended.is_set():
        read_s = 0.2
        message = inbox.get(read_s)
        if message is not None:
            take(message)
