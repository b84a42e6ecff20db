"""Connect to the master: wait for its start, then send without ever waiting.

Sockets around `slave.link`: one thread receives the beacons, one what the master sends to this slave. A datagram that
cannot go now is counted and forgotten, because the next frame matters more.
"""

import logging
import os
import threading
import time
from collections.abc import Callable
from ipaddress import AddressValueError, IPv4Address

from common.clock import Clock
from common.errors import BusError
from common.link.datagram import READ_TIMEOUT_S, Address, LinkKey, UdpSocket
from common.link.handshake import Random
from common.messages import Message
from slave.link import SlaveLink

ANYWHERE = "0.0.0.0"
LOOPBACK_BROADCAST = "127.255.255.255"
LOG_NS = 1_000_000_000
_LOG = logging.getLogger(__name__)


class Uplink:
    """Datagrams from one slave to whichever master is there."""

    def __init__(
        self,
        name: str,
        key: LinkKey | bytes,
        clock: Clock,
        beacon_port: int,
        bind: str = ANYWHERE,
        random: Random = os.urandom,
    ) -> None:
        """Begin to listen for the beacon of a master that has the same rig `key`.

        Args:
            name: Camera or IMU, as the rig's file calls it.
            key: Rig key (32 bytes), alone or with this device's secret.
            beacon_port: UDP port of the beacons; several slaves of one machine share it.
            bind: Where to receive: 0.0.0.0 for every network, or an address of this machine.

        Raises:
            BusError: The port or address cannot be bound.
            ValueError: Key of wrong length.
        """
        self._clock = clock
        self._link = SlaveLink(name, key, clock, random)
        beacon_host, data_host = _hosts(bind)
        self._beacons = UdpSocket((beacon_host, beacon_port), shared=True, timeout_s=0.1)
        self._data = UdpSocket((data_host, 0))
        self._lock = threading.Lock()
        self._sent = 0
        self._unsent = 0
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(
                target=self._receive, args=(self._beacons, self._link.receive_beacon), name=f"{name} beacons"
            ),
            threading.Thread(target=self._receive, args=(self._data, self._link.receive), name=f"{name} data"),
        ]  # fmt: skip
        for thread in self._threads:
            thread.daemon = True
            thread.start()

    @property
    def session(self) -> int:
        """Random id of this process, for the `session` of its messages."""
        return self._link.process

    @property
    def started(self) -> bool:
        """Whether a master has sent start and is still there; else nothing is sent."""
        with self._lock:
            return self._link.started

    @property
    def start_t_ns(self) -> int | None:
        """When this master wanted the slaves to begin [ns], on this slave's clock."""
        with self._lock:
            return self._link.start_t_ns

    @property
    def zenoh_endpoint(self) -> str | None:
        """Where the master's bus listens, or None without a session."""
        with self._lock:
            return self._link.zenoh_endpoint

    @property
    def wrong(self) -> str | None:
        """Why no master accepts this slave, if known; see `SlaveLink.wrong`."""
        with self._lock:
            return self._link.wrong

    @property
    def counts(self) -> dict[str, int]:
        """sent, unsent (no start), would_block, send_failed, refused.<reason>."""
        with self._lock:
            counts = {
                "sent": self._sent,
                "unsent": self._unsent,
                "would_block": self._data.would_block,
                "send_failed": self._data.failed,
            }
            return counts | {f"refused.{reason}": n for reason, n in self._link.refused.items()}

    def wait_for_start(self, timeout_s: float) -> bool:
        """Wait until the start time that the master has sent; False after `timeout_s`."""
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while (now_ns := self._clock.now_ns()) < deadline_ns and not self._closing.is_set():
            start_t_ns = self.start_t_ns if self.started else None
            if start_t_ns is not None and now_ns >= start_t_ns:
                return True
            until_ns = deadline_ns if start_t_ns is None else min(start_t_ns, deadline_ns)
            time.sleep(max(0.0, min(READ_TIMEOUT_S, (until_ns - now_ns) * 1e-9)))
        return False

    def send(self, message: Message) -> None:
        """Send `message`, which must fit a datagram, or count it as unsent; never wait."""
        with self._lock:
            sealed = self._link.seal(message)
            if sealed is None:
                self._unsent += 1
            elif self._data.send(*sealed):
                self._sent += 1

    def close(self) -> None:
        """End the threads and give the ports back. Safe to call twice."""
        self._closing.set()
        for thread in self._threads:
            thread.join()
        self._beacons.close()
        self._data.close()

    def _receive(self, source: UdpSocket, take: Callable[[bytes, Address, int], None]) -> None:
        news = News()
        while not self._closing.is_set():
            arrived = source.receive()
            t_ns = self._clock.now_ns()
            with self._lock:
                endpoint, wrong = self._link.zenoh_endpoint, self._link.wrong
                if arrived is not None:
                    take(*arrived, t_ns)
                for datagram, address in self._link.due():
                    self._data.send(datagram, address)
                changed = self._link.zenoh_endpoint != endpoint
            if changed:
                _LOG.info("session with the master whose bus is %s", self._link.zenoh_endpoint)
            if source is self._beacons and news.is_new(wrong, t_ns):
                _LOG.warning("%s", wrong)


class News:
    """Filter of the log, as any datagram may change it: other lines, a second apart."""

    def __init__(self) -> None:
        self._line: str | None = None
        self._logged_ns: int | None = None

    def is_new(self, line: str | None, t_ns: int) -> bool:
        """Whether to log `line` at `t_ns` [ns]; after None whatever comes next is new."""
        if line is None or line == self._line:
            self._line = line
            return False
        if self._logged_ns is not None and 0 <= t_ns - self._logged_ns < LOG_NS:
            return False
        self._line, self._logged_ns = line, t_ns
        return True


def _hosts(bind: str) -> tuple[str, str]:
    """Where to bind for beacons and for data; raises `BusError`.

    A socket bound to one address of the machine receives no broadcast (Linux, ip(7)), hence the loopback's broadcast
    address for a loopback address, and every network for any other.
    """
    try:
        address = IPv4Address(bind)
    except AddressValueError as error:
        raise BusError(
            f"bind address {bind!r}: must be an IPv4 address of this machine, or {ANYWHERE}"
        ) from error
    if address.is_loopback:
        return LOOPBACK_BROADCAST, "127.0.0.1" if bind == LOOPBACK_BROADCAST else bind
    return ANYWHERE, bind
