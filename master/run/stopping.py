"""Ctrl-C and a stop by the system as an event.

For commands that run until they are asked to end.
"""

import signal
import threading


def stop_on_signals() -> threading.Event:
    """An event that either sets, from now until the process ends."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    return stop
