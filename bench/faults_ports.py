"""Hostile connections at a TCP port: what strangers send, and connections that say nothing and stay."""

import random
import socket
import time
from collections import Counter
from contextlib import ExitStack, suppress

from common.link.datagram import Address

_HELLO = bytes.fromhex("16030100c8010000c40303")  # how a TLS client begins
_UPGRADE = (
    b"GET /socket HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
CONNECT_S = 0.5


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
    said, became, kept = openings(seed), Counter[str](), list[socket.socket]()
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
                one.sendall(said[k % len(said)])
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
