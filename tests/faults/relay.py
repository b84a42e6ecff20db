"""A network between a master and its slaves with loss, delay, jitter, reordering, duplicates, and a cable to pull.

It works like an address-translating router: beacons come in on `beacon` and go out as loopback broadcasts; each slave
that answers gets a socket of its own towards the master. Unlike the kernel's netem it needs no privilege.
"""

import heapq
import itertools
import random
import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from common.link.datagram import Address

_BROADCAST = "127.255.255.255"


@dataclass(slots=True)
class Impairment:
    """What happens to each datagram, on each way alike. May be changed at any time."""

    loss: float = 0.0  # probability of being lost
    delay_s: float = 0.0  # every datagram is this late [s]
    jitter_s: float = 0.0  # and up to this much more, evenly [s]
    reorder: float = 0.0  # probability of being held back by `held_s`, so that others overtake
    held_s: float = 0.02  # how long a held datagram waits [s]
    duplicate: float = 0.0  # probability of coming twice, each independently delayed

    @property
    def late(self) -> bool:
        """Whether anything waits at all."""
        return bool(self.delay_s or self.jitter_s or self.reorder)


class UdpRelay:
    """Forwards between one master and its slaves until closed. Holds sockets, a thread, what waits.

    `cut`: nothing goes through. `seen` is called with every datagram, and whether it was for the master.
    """

    def __init__(self, slave_beacon_port: int, seed: int = 1, way: Impairment | None = None) -> None:
        """Forward to the slaves that listen on a port of this machine."""
        self.way = Impairment() if way is None else way
        self.cut, self.forwarded, self.lost = False, 0, 0
        self.seen: Callable[[bytes, bool], None] | None = None
        self._random = random.Random(seed)
        self._slaves: Address = (_BROADCAST, slave_beacon_port)
        self._inlet, self._front = _socket(), _socket()  # for the master's beacons; for the slaves
        self._backs: dict[Address, socket.socket] = {}  # slave -> its socket towards the master
        self._master: Address | None = None
        self._waiting: list[tuple[float, int, socket.socket, bytes, Address]] = []
        self._order = itertools.count()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def beacon(self) -> Address:
        """Where the master has to send its beacons."""
        address: Address = self._inlet.getsockname()
        return address

    @property
    def master(self) -> Address | None:
        """Where the master speaks from, once it did."""
        return self._master

    def slaves(self) -> tuple[Address, ...]:
        """Where the slaves speak from that ever answered."""
        return tuple(self._backs)

    def close(self) -> None:
        """Forward no more."""
        self._closing.set()
        self._thread.join()
        for one in (self._inlet, self._front, *self._backs.values()):
            one.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            wait_s = 0.02
            if self._waiting:
                wait_s = min(wait_s, max(0.0, self._waiting[0][0] - time.monotonic()))
            readable, _, _ = select.select([self._inlet, self._front, *self._backs.values()], [], [], wait_s)
            for one in readable:
                self._route(one, *one.recvfrom(8192))
            while self._waiting and self._waiting[0][0] <= time.monotonic():
                _, _, one, datagram, to = heapq.heappop(self._waiting)
                self._send(one, datagram, to)

    def _route(self, one: socket.socket, datagram: bytes, source: Address) -> None:
        if self.seen is not None:
            self.seen(datagram, one is self._front)
        if one is self._inlet:
            self._master = source
            self._forward(self._front, datagram, self._slaves)
        elif one is self._front:
            if source not in self._backs:
                self._backs[source] = _socket()
            if self._master is not None:
                self._forward(self._backs[source], datagram, self._master)
        else:
            slave = next(slave for slave, back in self._backs.items() if back is one)
            self._forward(self._front, datagram, slave)

    def _forward(self, one: socket.socket, datagram: bytes, to: Address) -> None:
        way, draw = self.way, self._random.random
        for _ in range(2 if way.duplicate and draw() < way.duplicate else 1):
            if self.cut or draw() < way.loss:
                self.lost += 1
                continue
            if not (way.late or self._waiting):
                self._send(one, datagram, to)
                continue
            late_s = way.delay_s + draw() * way.jitter_s + (way.held_s if draw() < way.reorder else 0.0)
            heapq.heappush(self._waiting, (time.monotonic() + late_s, next(self._order), one, datagram, to))

    def _send(self, one: socket.socket, datagram: bytes, to: Address) -> None:
        self.forwarded += 1
        one.sendto(datagram, to)


def _socket() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    made.bind(("127.0.0.1", 0))
    return made
