"""A bad network in user space: seeded loss, delay, jitter, reordering and duplication over real UDP.

It stands between the master and its slaves like an address-translating router: beacons come in on
`beacon`, go out as loopback broadcasts; each slave that answers gets its own socket towards the
master. Kernel impairment (netem) is not everywhere; this needs no privilege.
"""

import heapq
import itertools
import random
import select
import socket
import threading
import time
from dataclasses import dataclass

from common.datagram import Address

LOOPBACK_BROADCAST = "127.255.255.255"
LONGEST = 8192


@dataclass(frozen=True)
class Impairment:
    """What happens to each datagram, on each way alike.

    Attributes:
        loss: Probability of being lost.
        delay_s: Every datagram is this late [s].
        jitter_s: And up to this much more, evenly [s].
        reorder: Probability of being held back by `held_s`, so that others overtake.
        held_s: How long a held datagram waits [s].
        duplicate: Probability of coming twice, independently delayed.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    reorder: float = 0.0
    held_s: float = 0.02
    duplicate: float = 0.0


class Relay:
    """Forwards between one master and its slaves until closed. Holds sockets, a thread, a schedule."""

    def __init__(self, slave_beacon_port: int, impairment: Impairment, seed: int) -> None:
        self._impairment = impairment
        self._random = random.Random(seed)
        self._slave_beacons = (LOOPBACK_BROADCAST, slave_beacon_port)
        self._inlet = _socket()  # hears the master's beacons
        self._front = _socket()  # speaks with the slaves
        self._backs: dict[Address, socket.socket] = {}  # slave -> its socket towards the master
        self._master: Address | None = None
        self._schedule: list[tuple[float, int, socket.socket, bytes, Address]] = []
        self._order = itertools.count()
        self._closing = threading.Event()
        self.forwarded = 0
        self.lost = 0
        self.cable_out = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def beacon(self) -> Address:
        """Where the master has to send its beacons."""
        address: Address = self._inlet.getsockname()
        return address

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        for sock in (self._inlet, self._front, *self._backs.values()):
            sock.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            wait = 0.02
            if self._schedule:
                wait = min(wait, max(0.0, self._schedule[0][0] - time.monotonic()))
            readable, _, _ = select.select([self._inlet, self._front, *self._backs.values()], [], [], wait)
            for sock in readable:
                datagram, source = sock.recvfrom(LONGEST)
                self._route(sock, datagram, source)
            while self._schedule and self._schedule[0][0] <= time.monotonic():
                _, _, sock, datagram, to = heapq.heappop(self._schedule)
                sock.sendto(datagram, to)
                self.forwarded += 1

    def _route(self, sock: socket.socket, datagram: bytes, source: Address) -> None:
        if sock is self._inlet:
            self._master = source
            self._impair(self._front, datagram, self._slave_beacons)
        elif sock is self._front:
            if source not in self._backs:
                self._backs[source] = _socket()
            if self._master is not None:
                self._impair(self._backs[source], datagram, self._master)
        else:
            slave = next(slave for slave, back in self._backs.items() if back is sock)
            self._impair(self._front, datagram, slave)

    def _impair(self, sock: socket.socket, datagram: bytes, to: Address) -> None:
        plan, draw = self._impairment, self._random.random
        for _ in range(2 if draw() < plan.duplicate else 1):
            if self.cable_out or draw() < plan.loss:
                self.lost += 1
                continue
            late = plan.delay_s + draw() * plan.jitter_s + (plan.held_s if draw() < plan.reorder else 0.0)
            heapq.heappush(self._schedule, (time.monotonic() + late, next(self._order), sock, datagram, to))


def _socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    sock.bind(("127.0.0.1", 0))
    return sock
