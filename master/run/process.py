"""Process of the PC joins the bus, and stops on a signal.

A master listens, all others join it, each with its own certificate.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterable

from common.bus.keys import MASTER, OPERATOR, access_of
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError


def join_bus(endpoint: str, site: str | None = None) -> ZenohBus:
    """Join the bus as the master at `endpoint` sees it; at a router, that of `site`.

    Raises:
        BusError: Nobody listens there, or refuses this program's certificate; the endpoint is malformed.
    """
    return ZenohBus(None, endpoint, access_of(os.environ, OPERATOR), beyond=True, namespace=site)


def host_bus(endpoint: str, devices: Iterable[str] = ()) -> ZenohBus:
    """The bus of a master, which listens at `endpoint`; `devices` may connect.

    So may those whose keys are in the keys folder.

    Raises:
        BusError: The address is taken; keys are missing; the endpoint is malformed.
    """
    return ZenohBus(endpoint, None, access_of(os.environ, MASTER), devices=devices)


def bus_of_master(
    endpoint: str, stop: threading.Event, waiting: Callable[[BusError], None], site: str | None = None
) -> ZenohBus | None:
    """Return the bus, once a master or router listens; None when stopped before.

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
            stop.wait(0.3)
    return None


def stop_on_signals() -> threading.Event:
    """An event that either sets, from now until the process ends."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    return stop
