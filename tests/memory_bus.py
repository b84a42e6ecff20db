"""A bus inside one process, for tests: as `common.bus.bus.Bus`, messages encoded and decoded like on the real one."""

import threading

from common.bus.bus import ANY, Handler, Inbox, Subscription, decoded, payload_of, stream_key
from common.errors import BusError, PhalanxError
from common.messages import Command, Health, Message, encode


class _Hub:
    """Shared state of the ends of one loopback bus."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.inboxes: dict[Inbox, tuple[str, str]] = {}
        self.handlers: dict[str, Handler] = {}
        self.names: dict[LoopbackBus, set[str]] = {}


class LoopbackBus:
    """One end of a bus inside one process; `join` gives another."""

    def __init__(self, hub: _Hub | None = None) -> None:
        """Open a new bus, or (by `join`) another end of an open one."""
        self._hub = _Hub() if hub is None else hub
        self._closed = False
        self._inboxes: list[Inbox] = []
        self._served: list[str] = []

    def join(self) -> "LoopbackBus":
        """Return another end of this bus."""
        return LoopbackBus(self._hub)

    def publish(self, stream: str, name: str, message: Message) -> None:
        """Send to every matching subscription (see `Bus.publish`)."""
        self._check_open()
        stream_key(stream, name)
        payload = payload_of(stream, message)
        with self._hub.lock:
            for inbox, (wanted_stream, wanted) in self._hub.inboxes.items():
                if wanted_stream == stream and wanted in (ANY, name):
                    inbox.put(name, payload)

    def subscribe(self, stream: str, name: str = ANY, depth: int = 16) -> Subscription:
        """Receive a stream (see `Bus.subscribe`)."""
        self._check_open()
        stream_key(stream, name)
        inbox = Inbox(stream, depth, self._forget)
        with self._hub.lock:
            self._hub.inboxes[inbox] = (stream, name)
        self._inboxes.append(inbox)
        return inbox

    def serve(self, name: str, handler: Handler) -> None:
        """Answer commands for `name`; here the handler runs on the asker's thread."""
        self._check_open()
        with self._hub.lock:
            self._hub.handlers[name] = handler
        self._served.append(name)

    def ask(self, command: Command, timeout_s: float) -> Health:
        """Ask (see `Bus.ask`); `timeout_s` has no meaning inside one process."""
        self._check_open()
        with self._hub.lock:
            handler = self._hub.handlers.get(command.target)
            names = ", ".join(sorted(self._hub.handlers)) or "nobody"
        if handler is None:
            raise BusError(
                f"no answer from {command.target!r} to {command.verb!r}: it is not on the bus ({names} is)"
            )
        request = decoded(encode(command), Command)
        assert isinstance(request, Command)  # we encoded it ourselves
        try:
            return handler(request)
        except (PhalanxError, ValueError) as error:
            raise BusError(f"{command.target!r} refused {command.verb!r}: {error}") from error

    def announce(self, name: str) -> None:
        """Be listed in `alive` until this end closes."""
        self._check_open()
        with self._hub.lock:
            self._hub.names.setdefault(self, set()).add(name)

    def alive(self) -> frozenset[str]:
        """Return the announced names of all open ends."""
        with self._hub.lock:
            return frozenset(name for names in self._hub.names.values() for name in names)

    def close(self) -> None:
        """Leave: subscriptions, handlers and names of this end go. Safe to call twice."""
        self._closed = True
        for inbox in list(self._inboxes):
            inbox.close()
        with self._hub.lock:
            self._hub.names.pop(self, None)
            for name in self._served:
                self._hub.handlers.pop(name, None)
        self._served.clear()

    def _check_open(self) -> None:
        if self._closed:
            raise BusError("the bus is closed")

    def _forget(self, inbox: Inbox) -> None:
        with self._hub.lock:
            self._hub.inboxes.pop(inbox, None)
        if inbox in self._inboxes:
            self._inboxes.remove(inbox)
