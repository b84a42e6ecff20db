"""Ctrl-C and a stop by the system as an event.

For commands that run until they are requested to end.
"""

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager

_NUMBERS = (signal.SIGINT, signal.SIGTERM)


def stop_on_signals() -> threading.Event:
    """An event that either sets, from now until the process ends."""
    stop = threading.Event()
    for number in _NUMBERS:
        signal.signal(number, lambda _number, _frame: stop.set())
    return stop


@contextmanager
def stop_by_signal() -> Generator[threading.Event, None, None]:
    """An event that either sets, for as long as the block runs."""
    before = [signal.getsignal(number) for number in _NUMBERS]
    try:
        yield stop_on_signals()
    finally:
        for number, handler in zip(_NUMBERS, before, strict=True):
            signal.signal(number, handler)
