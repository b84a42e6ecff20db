"""Process of the PC joins the bus, and stops on a signal.

Access of the PC's programs to the bus.

A master listens, all others join it, each with its own certificate.

Ctrl-C and a stop by the system as an event.

For commands that run until they are asked to end.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterable

from common.bus.keys import MASTER, OPERATOR, access_of
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError


def join_bus(endpoint: str, site: str | None = None) -> ZenohBus:
    """Join the bus as the master at `endpoint` sees it.

    Where a router is at the endpoint, it is what is published of `site`.

    Raises:
        BusError: Nobody listens there, or refuses this program's certificate; the endpoint is malformed.
    """
    return ZenohBus(None, endpoint, access_of(os.environ, OPERATOR), beyond=True, namespace=site)


def host_bus(endpoint: str, devices: Iterable[str] = ()) -> ZenohBus:
    """The bus of a master, which listens at `endpoint`.

    Args:
        endpoint: As `tls/0.0.0.0:47802`.
        devices: Names of cameras, IMUs and trackers that may connect, beside those whose keys are in the keys folder.

    Raises:
        BusError: The address is taken; keys are missing; the endpoint is malformed.
    """
    return ZenohBus(endpoint, None, access_of(os.environ, MASTER), devices=devices)


def bus_of_master(
    endpoint: str, stop: threading.Event, waiting: Callable[[BusError], None], site: str | None = None
) -> ZenohBus | None:
    """Return the bus, once a master listens at `endpoint`; None when stopped before.

    A router for `site` will do too.

    `waiting` is called once with why not yet.

    Raises:
        BusError: The endpoint is malformed, or keys are missing.
    """
    notified = False
    while not stop.is_set():
        try:
            return join_bus(endpoint, site)
        except BusError as error:
            if error.__cause__ is None:  # refused by us, not by the network: endpoint or keys
                raise
            if not notified:
                waiting(error)
            notified = True
            try_again_s = 0.3
            stop.wait(try_again_s)
    return None


def stop_on_signals() -> threading.Event:
    """An event that either sets, from now until the process ends."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    return stop
