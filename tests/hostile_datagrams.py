"""Hostile datagrams at both ends of the link, and strangers at a TCP port, while a hand is tracked.

Datagrams are of three kinds, mixed: random bytes; headers that pass every cheap check with random
bodies, so that the cipher has to say no; and genuine datagrams, captured before, cut, lengthened, with bits turned, or
as they were: replays.
"""

import random
import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass

from common.link.datagram import HEADER, MAGIC, MAX_DATAGRAM, Address, Kind
from common.link.handshake import RigKeys
from common.messages import WIRE_VERSION
from common.messages.streams import MASTER
from tests.faults.links import FaultRig, Judged

_HELLO = bytes.fromhex("16030100c8010000c40303")  # how a TLS client begins
_UPGRADE = (
    b"GET /socket HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
CONNECT_S = 0.5
POOL = 4096  # different ones; the network does not care


@dataclass(frozen=True, slots=True)
class Share:
    """What two processes and a hand did in some seconds.

    Attributes:
        seconds: How many.
        master_cpu, slave_cpu: Cores.
        lost: Share of the frames of both cameras that did not come.
        poses: The poses.
    """

    seconds: float
    master_cpu: float
    slave_cpu: float
    lost: float
    poses: list[Judged]


class Watch:
    """From a moment on. Holds what the processes had used then."""

    def __init__(self, rig: FaultRig) -> None:
        """Begin now."""
        self._rig, self._counts = rig, rig.counts()
        self._began, self._used = time.monotonic(), self._cpu()

    def end(self) -> Share:
        """What happened since."""
        seconds, used = time.monotonic() - self._began, self._cpu()
        poses, counts = self._rig.poses.since(self._began), self._rig.counts()
        rise = {
            name: sum(
                counts.get(f"{c}.{name}", 0) - self._counts.get(f"{c}.{name}", 0) for c in ("left", "right")
            )
            for name in ("received", "lost")
        }
        cpu = [(b - a) / seconds for a, b in zip(self._used, used, strict=True)]
        lost = rise["lost"] / max(rise["lost"] + rise["received"], 1)
        return Share(seconds, cpu[0], cpu[1], lost, poses)

    def _cpu(self) -> tuple[float, float]:
        return self._rig.footprint(MASTER).cpu_s, self._rig.footprint("left").cpu_s


class Capture:
    """What passed the relay. Holds datagrams for the master and for slaves."""

    def __init__(self, rig: FaultRig, most: int = 20_000) -> None:
        """Begin to listen."""
        self.to_master: list[bytes] = []
        self.to_slaves: list[bytes] = []
        self._rig, self._most = rig, most
        rig.relay.seen = self._seen

    def end(self) -> None:
        """Listen no more."""
        self._rig.relay.seen = None

    def _seen(self, datagram: bytes, for_master: bool) -> None:
        kept = self.to_master if for_master else self.to_slaves
        if len(kept) < self._most:
            kept.append(datagram)


def hostile(originals: list[bytes], key: bytes, seed: int = 5) -> list[bytes]:
    """`POOL` datagrams: 40 % random, 20 % well headed, 30 % mutated, 10 % replayed."""
    source = random.Random(seed)
    tag, pool = RigKeys(key).rig_tag, source.randbytes(1 << 16)
    ids = [HEADER.unpack_from(one)[5] for one in originals]
    out: list[bytes] = []
    for k in range(POOL):
        start = source.randrange(len(pool) - 400)
        kind = k % 10
        if kind < 4:
            out.append(pool[start : start + source.randrange(1, 400)])
        elif kind < 6:
            body = pool[start : start + 16 + source.randrange(200)]
            head = (MAGIC, WIRE_VERSION, source.choice(list(Kind)), 28 + len(body), tag, source.choice(ids))
            out.append(HEADER.pack(*head, source.getrandbits(60)) + body)
        else:
            out.append(_mutated(source, source.choice(originals), replay=kind == 9))
    return out


def _mutated(source: random.Random, original: bytes, *, replay: bool) -> bytes:
    if replay:
        return original
    how, datagram = source.randrange(3), bytearray(original)
    if how == 0:
        return bytes(datagram[: source.randrange(1, len(datagram))])
    if how == 1:
        return bytes(datagram) + source.randbytes(source.choice((1, 16, MAX_DATAGRAM)))
    bit = source.randrange(8 * len(datagram))
    datagram[bit // 8] ^= 1 << bit % 8
    return bytes(datagram)


def flood(pool: list[bytes], targets: list[Address], count: int, per_s: float | None = None) -> float:
    """Send so many, turn by turn, as fast as this machine gives or so many a second; return the seconds it took."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        began = time.monotonic()
        for k, datagram in enumerate(_turns(pool, count)):
            out.sendto(datagram, targets[k % len(targets)])
            if per_s is not None and k % 64 == 0:
                time.sleep(max(0.0, k / per_s - (time.monotonic() - began)))
        return time.monotonic() - began


def _turns(pool: list[bytes], count: int) -> Iterator[bytes]:
    for k in range(count):
        yield pool[k % len(pool)]


def targets(rig: FaultRig) -> list[Address]:
    """The master's port, the beacons' port and the data ports of both slaves."""
    return [("127.0.0.1", rig.master_port), ("127.255.255.255", rig.beacon_port), *rig.relay.slaves()[:2]]


def memory_mb(rig: FaultRig) -> tuple[float, float]:
    """Of the master and of a slave, what is no file's."""
    return rig.footprint(MASTER).anonymous_mb, rig.footprint("left").anonymous_mb


def openings(seed: int) -> list[bytes]:
    """What is said first: noise, the beginning of TLS, HTTP and WebSocket and noise, lengths of gigabytes, nothing."""
    source = random.Random(seed)
    return [
        source.randbytes(200),
        source.randbytes(20_000),
        _HELLO + source.randbytes(2000),
        b"\xff" * 4000,
        b"\x00" * 4000,
        b"\xff\xff" + source.randbytes(65_535),
        b"GET /" + b"A" * 100_000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"X: " + b"y" * 60_000,
        _UPGRADE + source.randbytes(5000),
        b"POST / HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n" + source.randbytes(5000),
        b"",
    ]


def assault(port: Address, connections: int, hold: int, seconds: float, seed: int = 3) -> Counter[str]:
    """Connect so many times within so many seconds, keep the last `hold` connections half open until the end.

    Returns:
        How many were "open", "refused" at once, and "cut" while something was said.
    """
    output, became, kept = openings(seed), Counter[str](), list[socket.socket]()
    began = time.monotonic()
    with ExitStack() as stack:
        for k in range(connections):
            time.sleep(max(0.0, seconds * k / connections - (time.monotonic() - began)))
            one = socket.socket()
            one.settimeout(CONNECT_S)
            stack.callback(one.close)
            try:
                one.connect(port)
            except OSError:
                became["refused"] += 1
                continue
            try:
                one.settimeout(0.05)
                one.sendall(output[k % len(output)])
                became["open"] += 1
            except OSError:
                became["cut"] += 1
            kept.append(one)
            if len(kept) > hold:
                old = kept.pop(0)
                with suppress(OSError):
                    old.shutdown(socket.SHUT_RDWR)
                old.close()
    return became
