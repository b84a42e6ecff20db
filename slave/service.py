"""Run as a service: notify the system's manager, and stop on its signals.

The watchdog is fed by the loop itself, never by a thread that would live on while the loop hangs. Waiting for the
master the loop comes round; a lost camera asks for more patience (`WATCHDOG_USEC`), as does a slow start
(`EXTEND_TIMEOUT_USEC`). It is fed four times in a period, not twice: of a slave that is stopped for 3 s with a
watchdog of 5 s, up to 3.75 s may have passed since it was fed, and it goes on; fed every 2.5 s it might be ended.
"""

import signal
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import TypeAlias

from common.supervisor import WATCHDOG, ServiceManager, one_line

# opening a camera again, all settings checked, takes seconds; one that hangs is given up
LOST_PATIENCE_S = 90.0
COMPILE_S = 180.0  # numba compiles 15 s on a desktop processor, more than a minute on a Raspberry Pi
NEVER_NS = 2**63
WAITING = "waits for the master"


# called with what is lost, and before each try to open it again
ConnectionLost: TypeAlias = Callable[[str], None]
# the same, and how long the next try may take [s]
ConnectionLostFor: TypeAlias = Callable[[str, float], None]


def nobody(what: str, patience_s: float = LOST_PATIENCE_S) -> None:
    """Ignore the loss of a device."""


class Service:
    """Notifications of one slave to the service manager; of the loop's thread alone."""

    def __init__(
        self,
        environment: Mapping[str, str],
        now_ns: Callable[[], int] = time.monotonic_ns,
        noun: str = "frames",
    ) -> None:
        """Find out who listens in the `environment`; `noun` is what the loop counts."""
        self._manager = ServiceManager(environment)
        self._send, self._period_us = self._manager.send, self._manager.watchdog_us
        self._now_ns, self._noun = now_ns, noun
        self._linked: Callable[[], bool] = lambda: False
        # Four times in a period of the watchdog; without one, a line of status every five seconds
        self._every_ns = self._period_us * 1000 // 4 or 5_000_000_000
        self._ready = self._patient = False
        self._rounds, self._since_ns = 0, 0
        self._due_ns = NEVER_NS

    def starting(self, patience_s: float, what: str = "compiles") -> None:
        """Announce to manager and installer that becoming ready may take so long [s]."""
        status = f"{one_line(what)}: may take {patience_s:.0f} s"
        self._send(f"STATUS={status}\nEXTEND_TIMEOUT_USEC={round(patience_s * 1e6)}")

    def ready(self, linked: Callable[[], bool]) -> None:
        """Report that it waits for the master; `linked`: whether anybody takes its data."""
        self._ready, self._linked = True, linked
        self._begin(self._now_ns())
        self._send(f"READY=1\nSTATUS={WAITING}{self._fed()}", wait=True)

    def waiting(self) -> None:
        """The loop came round, but there is no master yet."""
        now_ns = self._now_ns()
        if now_ns >= self._due_ns or self._patient:
            self._notify(WAITING, now_ns)

    def working(self) -> None:
        """The loop came round with one of what it is for."""
        now_ns = self._now_ns()
        if self._rounds == 0:
            self._since_ns = now_ns
        self._rounds += 1
        if now_ns < self._due_ns and not self._patient:
            return
        if self._patient:
            self._notify(f"{self._noun} come", now_ns)
            return
        rate_hz = (self._rounds - 1) * 1e9 / max(1, now_ns - self._since_ns)
        alone = "" if self._linked() else ", but the master is away"
        self._notify(f"{rate_hz:.3g} {self._noun}/s{alone}", now_ns)

    def connection_lost(self, what: str, patience_s: float = LOST_PATIENCE_S) -> None:
        """Announce that a device is lost: the next round may be so late [s]."""
        if not self._ready:
            self.starting(patience_s, what)
            return
        self._patient = True
        self._send(f"STATUS={one_line(what)}{self._fed(round(patience_s * 1e6))}", wait=True)

    def stopping(self) -> None:
        """It ends now, in order."""
        self._due_ns, self._patient = NEVER_NS, False
        self._send("STOPPING=1\nSTATUS=ends")

    def failed(self, why: str) -> None:
        """Report the error that ends the service as the last line of status."""
        self._send(f"STATUS=failed: {one_line(why)}")

    def _notify(self, doing: str, now_ns: int) -> None:
        """Report what it does; from now on with no more patience than usual."""
        if self._send(f"STATUS={one_line(doing)}{self._fed(self._period_us if self._patient else 0)}"):
            self._patient = False
        self._begin(now_ns)

    def _begin(self, now_ns: int) -> None:
        self._rounds = 0
        self._due_ns = now_ns + self._every_ns if self._manager.listens else NEVER_NS

    def _fed(self, period_us: int = 0) -> str:
        """Message that feeds the watchdog, and sets its period [us]; empty without one."""
        if not self._period_us:
            return ""
        return f"\n{WATCHDOG}={period_us}\nWATCHDOG=1" if period_us else "\nWATCHDOG=1"


@contextmanager
def stop_by_signal(event: threading.Event | None = None) -> Generator[threading.Event, None, None]:
    """An `event`, or a new one, that Ctrl-C and a stop by the system set meanwhile."""
    stop = threading.Event() if event is None else event
    before = {
        number: signal.signal(number, lambda _number, _frame: stop.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
