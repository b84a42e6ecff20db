"""Ingest turns datagrams into a queue of detections and IMU samples.

A socket around `link`: one thread reads, answers and repeats what has to be repeated; the live loop takes
messages from the queue, decoded, checked, counted, and on the master's clock. The queue drops the oldest, so
a slow loop sees what is new. Frames, tags, IMU samples and tracker poses have each their own room in it: none
drives another out, and at overload all that is taken is of the same stretch of time.
"""

import os
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from ipaddress import AddressValueError, IPv4Address
from types import MappingProxyType
from typing import NamedTuple

from common.clock import Clock
from common.errors import BusError
from common.link.clock_offset import ClockEstimate
from common.link.datagram import Address, LinkKey, UdpSocket
from common.link.handshake import Random
from common.messages import ImuSample, MarkerDetections, TagDetections, TrackerPose, WristDetections
from common.messages.streams import sender_of
from common.supervisor import until
from master.run.link import MasterLink
from master.run.link_senders import MarkerCounts, Quarantine, RejectedPeer, SenderLimits, SensorMessage
from master.run.sequence import CameraCounts

QUEUE = 64  # frames, or strobe cycles, that may wait, of one or two cameras
QUEUE_PER_CAMERA = 32  # of more: a third of a second at 90 Hz
# What comes while so many frames do.
CAPACITY = {"frame": QUEUE, "tags": QUEUE, "imu": 16 * QUEUE, "tracker": 16 * QUEUE}
# Whose room in the queue a message takes.
_KIND: dict[type[SensorMessage], str] = {
    MarkerDetections: "frame",
    WristDetections: "frame",
    TagDetections: "tags",
    ImuSample: "imu",
    TrackerPose: "tracker",
}


class Span(NamedTuple):
    """Times [ns] of a camera's oldest and newest waiting frame, master's clock."""

    oldest_ns: int
    newest_ns: int


class MessageQueue:
    """Messages in the order in which they came. Safe to use from several threads.

    Attributes:
        overflowed: Messages that were dropped, as there was no more room.
    """

    def __init__(self, cameras: int) -> None:
        self.overflowed = 0
        self._queue: deque[SensorMessage] = deque()
        self._has_capacity = capacity(cameras)
        self._waiting = dict.fromkeys(CAPACITY, 0)
        self._times: dict[tuple[str, str], deque[int]] = {}
        self._changed = threading.Condition()
        self._closed = False

    @property
    def frames(self) -> int:
        """Number of waiting frames of all cameras; strobe cycles count as frames do."""
        return self._waiting["frame"]

    def frame_spans(self) -> dict[str, Span]:
        """Return the time span of the waiting frames, of each camera that has any."""
        if not self._waiting["frame"]:
            return {}
        with self._changed:
            return {
                sender: Span(times[0], times[-1])
                for (kind, sender), times in self._times.items()
                if kind == "frame" and times
            }

    def put(self, messages: Sequence[SensorMessage]) -> None:
        """Let them wait, and wake who waits for them: once for all that came together.

        Where there is no more room for a kind, the oldest of the sender goes of which most wait: who sends
        too much loses his own.
        """
        with self._changed:
            for message in messages:
                kind, sender = _KIND[type(message)], sender_of(message)
                self._queue.append(message)
                self._waiting[kind] += 1
                self._times.setdefault((kind, sender), deque()).append(message.t_ns)
                if self._waiting[kind] > self._has_capacity[kind]:
                    self.overflowed += 1
                    self._drop_oldest(kind)
            self._changed.notify()

    def get(self, timeout_s: float) -> SensorMessage | None:
        """Return the oldest message; None after `timeout_s`, or once closed and empty."""
        with self._changed:
            if not self._queue:
                self._changed.wait_for(lambda: self._queue or self._closed, timeout_s)
                if not self._queue:
                    return None
            message = self._queue.popleft()
            self._left(message)
            return message

    def close(self) -> None:
        """Wake who waits: nothing comes any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _drop_oldest(self, kind: str) -> None:
        _, most = max((len(times), sender) for (of, sender), times in self._times.items() if of == kind)
        for k, message in enumerate(self._queue):
            if _KIND[type(message)] == kind and sender_of(message) == most:
                del self._queue[k]
                self._left(message)
                return

    def _left(self, message: SensorMessage) -> None:
        kind = _KIND[type(message)]
        self._waiting[kind] -= 1
        self._times[kind, sender_of(message)].popleft()


def capacity(cameras: int) -> dict[str, int]:
    """How many messages of each kind may wait."""
    frames = max(QUEUE, QUEUE_PER_CAMERA * cameras)
    return CAPACITY | {"frame": frames, "tags": frames}


class Ingest:
    """Receiver of all slaves of one rig, on one UDP port; `queue` has what came."""

    def __init__(
        self,
        cameras: tuple[str, ...],
        key: LinkKey | bytes,
        clock: Clock,
        beacon: Address,
        bind: Address,
        zenoh_endpoint: str,
        start_timeout_s: float = 5.0,
        random: Random = os.urandom,
        imus: tuple[str, ...] = (),
        wrists: tuple[str, ...] = (),
        trackers: tuple[str, ...] = (),
        limits: Mapping[str, SenderLimits] = MappingProxyType({}),
    ) -> None:
        """Begin to call the slaves.

        Args:
            cameras, imus, trackers: Names that may take part; any other slave is refused.
            key: Rig key (32 bytes), alone or with the root of the secrets of devices.
            clock: The clock that every time is moved to.
            beacon: Where beacons go: a broadcast address and the slaves' beacon port.
            bind: Own address and port (0: any).
            zenoh_endpoint: Where this master's bus listens, sent to the slaves; may be empty.
            start_timeout_s: How long the first slave waits for the others.
            random: Source of nonces.
            wrists: Those of `cameras` that belong to a wrist device.
            limits: What files state of each sender (`link_senders.limits_of`); else only what its messages
                can be.

        Raises:
            BusError: The address cannot be bound, or `beacon` is not an IPv4 address.
            ValueError: As of `MasterLink`.
        """
        _check_address(beacon[0])
        self._clock = clock
        timeout_ns = round(start_timeout_s * 1e9)
        self._link = MasterLink(
            cameras, key, clock, beacon, zenoh_endpoint, timeout_ns, random, imus, wrists, trackers, limits
        )
        self._cameras, self._senders = cameras, (*cameras, *imus, *trackers)
        self._socket = UdpSocket(bind, broadcast=True)
        self._lock = threading.Lock()
        self.queue = MessageQueue(len(cameras))
        self._closing = threading.Event()
        self._thread = threading.Thread(
            target=until(self._closing.is_set, self._run), name="ingest", daemon=True
        )
        self._thread.start()

    @property
    def address(self) -> Address:
        """Own address and port."""
        return self._socket.address

    @property
    def quarantine(self) -> Quarantine:
        """Senders that are silenced, as their messages made something fail."""
        return self._link.quarantine

    @property
    def started(self) -> bool:
        """Whether the start was given."""
        with self._lock:
            return self._link.started

    @property
    def connected(self) -> frozenset[str]:
        """Return the cameras, IMUs and trackers received within the last second."""
        with self._lock:
            return self._link.connected()

    @property
    def lost(self) -> int:
        """Number of frames or strobe cycles of all cameras that were sent and never came."""
        return sum(self.counts_of(camera).lost for camera in self._cameras)

    @property
    def skipped(self) -> int:
        """Number of frames or strobe cycles that camera or slave had no time for."""
        return sum(self.counts_of(camera).skipped for camera in self._cameras)

    @property
    def refused(self) -> dict[str, int]:
        """Reason (docs/wire.md) -> datagrams refused for it."""
        with self._lock:
            return {str(reason): n for reason, n in self._link.refused.items()}

    @property
    def counts(self) -> dict[str, int]:
        """Event -> how often, as `Health.counts` wants it.

        <sender>.<event> of `MasterLink.events_of`, refused.<reason>, fault.<sender>, queue.*.
        """
        counts = {
            "queue.dropped": self.queue.overflowed,
            "would_block": self._socket.would_block,
            "send_failed": self._socket.failed,
            "unsynchronised": self._link.unsynchronised,
        }
        for sender in self._senders:
            with self._lock:
                events = self._link.events_of(sender)
            counts |= {f"{sender}.{event}": number for event, number in events.items()}
        counts |= {f"fault.{sender}": n for sender, n in dict(self.quarantine.faults).items()}
        return counts | {f"refused.{reason}": n for reason, n in self.refused.items()}

    def limit(self, limits: Mapping[str, SenderLimits]) -> None:
        """Accept from each sender what its files state now (`link_senders.limits_of`)."""
        with self._lock:
            self._link.limit(limits)

    def counts_of(self, sender: str) -> CameraCounts:
        """Return what became of the frames, samples or poses of `sender`.

        Raises:
            KeyError: The rig has no such sender.
        """
        with self._lock:
            return self._link.counts_of(sender)

    def rejected_peers(
        self,
    ) -> tuple[dict[str, RejectedPeer], dict[str, RejectedPeer], dict[str, RejectedPeer]]:
        """Return who was rejected lately, by sender.

        First second processes of a name, then speakers of another version, then hellos without the secret.
        """
        t_ns = self._clock.now_ns()
        with self._lock:
            lately = self._link.rejected_peers.lately
            return lately("duplicate", t_ns), lately("version", t_ns), lately("unproven", t_ns)

    def marker_counts(self) -> dict[str, MarkerCounts]:
        """Camera -> how many markers it sent and its rig has, where these differ."""
        t_ns = self._clock.now_ns()
        with self._lock:
            return self._link.rejected_peers.marker_counts(t_ns)

    def clock_of(self, camera: str) -> ClockEstimate | None:
        """Return how the clock of `camera` runs against this one; None while unknown.

        Raises:
            KeyError: The rig has no such camera.
        """
        with self._lock:
            return self._link.clock_of(camera)

    def get(self, timeout_s: float) -> SensorMessage | None:
        """Return the oldest message, on the master's clock; None after `timeout_s`."""
        return self.queue.get(timeout_s)

    def close(self) -> None:
        """End the thread and give the port back. Safe to call twice."""
        self._closing.set()
        self._thread.join()
        self.queue.close()
        self._socket.close()

    def _run(self) -> None:
        due_ns = self._clock.now_ns()
        while not self._closing.is_set():
            first = self._socket.receive()
            messages: list[SensorMessage] = []
            outbox: list[tuple[bytes, Address]] = []
            pending = 0
            with self._lock:
                for datagram, address in self._pending(first):
                    pending += 1
                    message = self._link.receive(datagram, address, self._clock.now_ns())
                    if message is not None:
                        messages.append(message)
                now_ns = self._clock.now_ns()
                if pending != len(messages) or pending == 0 or now_ns >= due_ns:
                    # nor is it looked at more often while nothing but data comes
                    outbox, due_ns = self._link.due(), now_ns + 1_000_000
            for datagram, address in outbox:
                self._socket.send(datagram, address)
            if messages:
                self.queue.put(messages)

    def _pending(self, first: tuple[bytes, Address] | None) -> Iterator[tuple[bytes, Address]]:
        """Yield at most 64 datagrams that have arrived, so that a flood delays nothing."""
        if first is None:
            return
        yield first
        at_once = 64  # datagrams between two looks at what is due: less than a millisecond
        for _ in range(at_once - 1):
            if (arrived := self._socket.receive_waiting()) is None:
                return
            yield arrived


def _check_address(host: str) -> None:
    """Refuse a host name: its lookup would stop the reading thread at every beacon."""
    try:
        IPv4Address(host)
    except AddressValueError as error:
        raise BusError(
            f"beacon address {host!r}: must be an IPv4 address, for example 192.168.1.255"
        ) from error
