"""What rigs of real processes on this machine need: free ports, the bus once its master listens, and patience."""

import os
import socket
import time
from collections.abc import Callable

from common.certificates import OPERATOR
from common.errors import BusError
from common.keys import access_of
from common.zenoh_bus import ZenohBus


def free_port(kind: int) -> int:
    """A port of 127.0.0.1 that nobody has now, for `socket.SOCK_DGRAM` or `socket.SOCK_STREAM`."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


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
