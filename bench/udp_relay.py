"""A network that can be made worse while it is used: UDP between a master and its slaves, with loss and delay.

It stands between them like an address-translating router: beacons come in on `beacon` and go out as loopback
broadcasts; each slave that answers gets a socket of its own towards the master. No privilege is needed.
"""

import heapq
import itertools
import random
import select
import socket
import threading
import time

from common.datagram import Address

_BROADCAST = "127.255.255.255"
_LONGEST = 8192


class UdpRelay:
    """Forwards until closed. Holds sockets, a thread, what waits; `loss`, `delay_s` and `cut` may change at any time.

    Attributes:
        loss: Probability of a datagram to be lost, either way.
        delay_s: Every datagram is so late [s]; their order stays.
        cut: Nothing goes through: a cable is out.
    """

    def __init__(self, slave_beacon_port: int, seed: int = 1) -> None:
        """Forward to the slaves that listen on a port of this machine."""
        self.loss, self.delay_s, self.cut = 0.0, 0.0, False
        self._random = random.Random(seed)
        self._slaves: Address = (_BROADCAST, slave_beacon_port)
        self._inlet, self._front = _socket(), _socket()  # hears the master's beacons; speaks with the slaves
        self._backs: dict[Address, socket.socket] = {}  # slave -> its socket towards the master
        self._master: Address | None = None
        self._waiting: list[tuple[float, int, socket.socket, bytes, Address]] = []
        self._order = itertools.count()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def beacon(self) -> str:
        """Where the master has to send its beacons, ADDRESS:PORT."""
        host, port = self._inlet.getsockname()
        return f"{host}:{port}"

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
                self._route(one, *one.recvfrom(_LONGEST))
            while self._waiting and self._waiting[0][0] <= time.monotonic():
                _, _, one, datagram, to = heapq.heappop(self._waiting)
                one.sendto(datagram, to)

    def _route(self, one: socket.socket, datagram: bytes, source: Address) -> None:
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
        if self.cut or self._random.random() < self.loss:
            return
        if self.delay_s <= 0.0 and not self._waiting:
            one.sendto(datagram, to)
            return
        heapq.heappush(self._waiting, (time.monotonic() + self.delay_s, next(self._order), one, datagram, to))


def _socket() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    made.bind(("127.0.0.1", 0))
    return made
