"""What rigs of real processes on this machine need: free ports, the bus once its master listens, and patience."""

import os
import secrets
import socket
import time
from collections.abc import Callable
from contextlib import suppress

from common.bus.certificates import OPERATOR
from common.bus.keys import access_of
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError

_PORTS = range(15_000, 32_000)  # below those that Linux gives to whoever names none (32768 to 60999)
_TRIES = 100


def free_port(kind: int) -> int:
    """A port of this machine that nobody has now, for `socket.SOCK_DGRAM` or `socket.SOCK_STREAM`.

    None of those that a system gives to whoever names none: before its own process has it, nobody else gets it.

    Raises:
        OSError: None is free.
    """
    for _ in range(_TRIES):
        port = _PORTS.start + secrets.randbelow(len(_PORTS))
        with socket.socket(socket.AF_INET, kind) as probe, suppress(OSError):
            probe.bind(("0.0.0.0", port))
            return port
    raise OSError(f"of {_TRIES} ports from {_PORTS.start} to {_PORTS.stop - 1} none was free")


def join_bus(endpoint: str, patience_s: float) -> ZenohBus:
    """Join the bus of a master that is about to listen at `endpoint`.

    Raises:
        BusError: It did not within `patience_s`.
    """
    until = time.monotonic() + patience_s
    while True:
        try:
            return ZenohBus(None, endpoint, access_of(os.environ, OPERATOR), beyond=True)
        except BusError:
            if time.monotonic() > until:
                raise
            time.sleep(0.2)


def until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Wait until it holds; False if it never did."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True
