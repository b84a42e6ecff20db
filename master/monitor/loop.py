"""Notify the service manager that the live loop goes round.

A loop that hangs is ended by the watchdog, and started again.

The loop itself gives the sign, when it asks for the next message, never a thread that would live on while it hangs.
"""

import time
from collections.abc import Callable
from typing import Generic

from common.service_manager import ServiceManager
from master.run.app import AuxiliaryMessage, SeenT, Source


class MonitoredLoop(Generic[SeenT]):
    """A source of messages that shows the manager each time it is asked.

    Holds when the next sign is due.
    """

    def __init__(
        self,
        source: Source[SeenT],
        manager: ServiceManager,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Report that the loop is ready: it begins now.

        Args:
            source: Where messages come from.
            manager: Who started this process.
            now_ns: The time [ns].
        """
        self._source, self._manager, self._now_ns = source, manager, now_ns
        notifies = 4  # in a period of the watchdog
        self._every_ns = manager.watchdog_us * 1000 // notifies
        self._due_ns = now_ns() + self._every_ns
        manager.send("READY=1\nSTATUS=tracks", wait=True)

    def get(self, timeout_s: float) -> SeenT | AuxiliaryMessage | None:
        """The next message, or None when none came in time."""
        if self._every_ns and (now_ns := self._now_ns()) >= self._due_ns:
            self._manager.send("WATCHDOG=1")
            self._due_ns = now_ns + self._every_ns
        return self._source.get(timeout_s)
