"""The bus as the master sees it, for programs beside a master: they wait until one is there."""

import threading
from collections.abc import Callable

from common.errors import BusError
from common.zenoh_bus import ZenohBus

_TRY_AGAIN_S = 0.3


def bus_of_master(
    endpoint: str, stop: threading.Event, waiting: Callable[[BusError], None]
) -> ZenohBus | None:
    """The bus, once a master listens at `endpoint`; None when stopped before. `waiting` is told once why not yet.

    Raises:
        BusError: The endpoint is malformed.
    """
    said = False
    while not stop.is_set():
        try:
            return ZenohBus(None, endpoint, beyond=True)
        except BusError as error:
            if error.__cause__ is None:  # refused by us, not by the network: the endpoint is malformed
                raise
            if not said:
                waiting(error)
            said = True
            stop.wait(_TRY_AGAIN_S)
    return None
