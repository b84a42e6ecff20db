"""Message bus: messages and commands over reliable links.

`common.bus.zenoh_bus.ZenohBus` joins processes. Streams with the path DATAGRAM never come here. A subscription holds
at most `depth` messages and drops the oldest; receivers never see a message that `common.messages` would refuse. A
device's messages above the rate of its stream are dropped undecoded.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from common.clock import TokenBucket
from common.errors import MessageError
from common.messages import AnyMessage, Command, Health, Message, decode, encode
from common.messages.streams import STREAMS, Path, key_of, sender_of

Handler = Callable[[Command], Health]
ANY = "*"
MOST_SENDERS = 256  # whose rates are tracked separately; on an open bus names can be invented


class Subscription(Protocol):
    """A bounded queue of messages of one stream.

    Attributes:
        dropped: Messages that were pushed out by newer ones before they were read, or were too many of one sender.
        refused: Payloads that were not a message of the stream, or of another than who sent them.
    """

    dropped: int
    refused: int

    def get(self, timeout_s: float) -> Message | None:
        """Return the oldest waiting message, or None after `timeout_s` or once closed."""
        ...

    def close(self) -> None:
        """Receive no more. Safe to call twice."""
        ...


class Bus(Protocol):
    """Publish and subscribe, ask and serve, and who is alive."""

    def publish(self, stream: str, name: str, message: Message) -> None:
        """Publish `message` of `stream` under the sender's `name`; never waits.

        Raises:
            ValueError: Unknown stream, a datagram stream, a message of another type.
            BusError: The bus is closed.
        """
        ...

    def subscribe(self, stream: str, name: str = ANY, depth: int = 16) -> Subscription:
        """Receive `stream` of the sender `name`, by default of all.

        Raises:
            ValueError: Unknown stream, a datagram stream, `depth` below 1.
            BusError: The bus is closed.
        """
        ...

    def serve(self, name: str, handler: Handler) -> None:
        """Answer every `Command` for `name` with `handler`, on a thread of the bus.

        A `PhalanxError` or `ValueError` of the handler becomes the asker's `BusError`.
        """
        ...

    def ask(self, command: Command, timeout_s: float) -> Health:
        """Send `command` to its target and return the answer.

        Raises:
            BusError: Nobody answered in time, or the target refused; the message states which.
        """
        ...

    def announce(self, name: str) -> None:
        """List this process as `name` in everybody's `alive` until it leaves or dies."""
        ...

    def alive(self) -> frozenset[str]:
        """Return the names announced by the reachable processes, this one included."""
        ...

    def close(self) -> None:
        """Leave the bus. Safe to call twice."""
        ...


class Inbox:
    """Bounded queue of a subscription: full, it drops the oldest; decodes on reading.

    Holds encoded messages of the type `kind`, each with the name under which it came, and the rate of each name. Who
    may send under which name is up to the bus, so no message can be another's.
    """

    def __init__(self, stream: str, depth: int, on_close: Callable[["Inbox"], None]) -> None:
        """Queue for `stream`; `close` calls `on_close` once. `depth` is at least 1."""
        if depth < 1:
            raise ValueError(f"depth={depth}: must be at least 1")
        self._kind, self._most_hz = STREAMS[stream].message, STREAMS[stream].most_hz
        self._buckets: dict[str, TokenBucket] = {}
        self._waiting: deque[tuple[str, bytes]] = deque(maxlen=depth)
        self._changed = threading.Condition()
        self._on_close: Callable[[Inbox], None] | None = on_close
        self.dropped = 0
        self.refused = 0

    @property
    def closed(self) -> bool:
        """Whether nothing is received any more."""
        return self._on_close is None

    def put(self, name: str, payload: bytes) -> None:
        """Append one encoded message that came under `name`; the oldest makes room."""
        with self._changed:
            if self._on_close is None:
                return
            if not self._within_rate(name):
                self.dropped += 1
                return
            if len(self._waiting) == self._waiting.maxlen:
                self.dropped += 1
            self._waiting.append((name, payload))
            self._changed.notify()

    def get(self, timeout_s: float) -> Message | None:
        """Return the oldest waiting message, or None after `timeout_s` or once closed.

        None also where as many as the queue holds were no message: who sends such keeps nobody waiting.
        """
        deadline_s = time.monotonic() + timeout_s
        for _ in range(self._waiting.maxlen or 1):
            with self._changed:
                left_s = max(deadline_s - time.monotonic(), 0.0)
                self._changed.wait_for(lambda: self._waiting or self._on_close is None, left_s)
                if not self._waiting:
                    return None
                name, payload = self._waiting.popleft()
            message = decoded(payload, self._kind)
            if message is not None and sender_of(message) == name:
                return message
            self.refused += 1
        return None

    def _within_rate(self, name: str) -> bool:
        """Whether one more that came under `name` is within the rate of the stream."""
        if self._most_hz is None:
            return True
        if name not in self._buckets and len(self._buckets) >= MOST_SENDERS:
            name = ""
        bucket = self._buckets.setdefault(name, TokenBucket(self._most_hz, self._most_hz))
        return bucket.take(time.monotonic_ns())

    def close(self) -> None:
        """Receive no more and wake a waiting reader. Safe to call twice."""
        with self._changed:
            on_close, self._on_close = self._on_close, None
            self._waiting.clear()
            self._changed.notify_all()
        if on_close is not None:
            on_close(self)


def decoded(payload: bytes, kind: type[Message]) -> AnyMessage | None:
    """Return the message of type `kind` in `payload`, or None if it is anything else."""
    try:
        message = decode(payload)
    except MessageError:
        return None
    return message if isinstance(message, kind) else None


def stream_key(stream: str, name: str) -> str:
    """Return the key of `stream` for `name`.

    Raises:
        ValueError: Unknown stream, or one that travels as datagrams. The text lists the others.
    """
    if stream not in STREAMS or STREAMS[stream].path is not Path.ZENOH:
        allowed = sorted(row for row, entry in STREAMS.items() if entry.path is Path.ZENOH)
        raise ValueError(f"stream {stream!r} is not on the bus; streams on it: {', '.join(allowed)}")
    return key_of(stream, name)


def payload_of(stream: str, message: Message) -> bytes:
    """Return `message` encoded; raises ValueError if it is not of the stream's type."""
    kind = STREAMS[stream].message
    if not isinstance(message, kind):
        raise ValueError(f"stream {stream!r} carries {kind.__name__}, not {type(message).__name__}")
    return encode(message)
