"""Time stamps of cameras, brought to the slave's clock.

A driver stamps its frames on a clock of its own choice: monotonic, since boot, or the wall clock. Two clocks are
compared by reading the slave's clock, then the other one, then the slave's again: the other was read in between,
so the difference is known to half the width of that sandwich, a microsecond or less. It is measured anew for every
frame, and a wide sandwich (the process was interrupted) is read again.

A wall clock may be stepped by NTP between the moment of the stamp and that of the reading. Such a frame could be
converted with the difference before or after the step; the right one is that which leaves the frame as old at its
hand-over as its predecessors were. So a step moves no `t_ns`.
"""

import time
from collections.abc import Callable
from math import sqrt

from common.clock import Clock

STEP_NS = (
    1_000_000  # a clock that moved this much between two frames was set; slewing makes 500 ppm of a period
)
NARROW_NS = 20_000  # a sandwich narrower than this is good at once
TRIES = 5
OLDEST_NS = 5_000_000_000  # an older frame, or one from the future, is not on the clock that was assumed
CLOCKS: dict[str, int] = {
    "monotonic": time.CLOCK_MONOTONIC,
    "boot": time.CLOCK_BOOTTIME,
    "wall": time.CLOCK_REALTIME,
}


class ForeignClock:
    """Converts the stamps of one driver.

    Holds the last difference between the clocks and how well it was read, the age of the last frame when it was
    converted, and in `steps` how often the foreign clock was set.
    """

    def __init__(self, own: Clock, read_ns: Callable[[], int]) -> None:
        """Convert to `own` from the clock that `read_ns` reads [ns]."""
        self._own = own
        self._read_ns = read_ns
        self._offset_ns: int | None = None
        self._age_ns: int | None = None
        self._width_ns = 0
        self.steps = 0

    @property
    def sigma_ns(self) -> float:
        """Standard deviation of the last conversion [ns]: anywhere in its sandwich is as likely."""
        return self._width_ns / sqrt(12.0)

    def to_own(self, stamp_ns: int) -> int:
        """Time on the slave's clock [ns] of a stamp taken a short while ago [ns]."""
        now_ns, offset_ns = self._pair()
        t_ns = stamp_ns - offset_ns
        before, self._offset_ns = self._offset_ns, offset_ns
        if before is not None and abs(offset_ns - before) > STEP_NS:
            self.steps += 1
            if self._age_ns is not None:
                typical_ns = now_ns - self._age_ns
                t_ns = min(t_ns, stamp_ns - before, key=lambda t: abs(t - typical_ns))
        self._age_ns = now_ns - t_ns
        return t_ns

    def _pair(self) -> tuple[int, int]:
        """Time on the slave's clock, and foreign minus own [ns], from the narrowest sandwich."""
        best: tuple[int, int, int] | None = None
        for _ in range(TRIES):
            first_ns = self._own.now_ns()
            foreign_ns = self._read_ns()
            last_ns = self._own.now_ns()
            width_ns = last_ns - first_ns
            if best is None or width_ns < best[0]:
                best = (width_ns, last_ns, foreign_ns - (first_ns + last_ns) // 2)
            if width_ns < NARROW_NS:
                break
        assert best is not None, "TRIES is positive"
        self._width_ns = best[0]
        return best[1], best[2]


def system_clock(name: str) -> Callable[[], int]:
    """Reader [ns] of a clock of `CLOCKS`."""
    number = CLOCKS[name]
    return lambda: time.clock_gettime_ns(number)


def clock_of(stamp_ns: int) -> str | None:
    """Name of the clock that a stamp taken a moment ago is on, or None if no clock fits.

    On a machine that never slept, monotonic and boot are the same and the first one is named. After a sleep of
    more than the age of a frame only one of them makes the frame neither old nor from the future.
    """
    for name in CLOCKS:
        if 0 <= system_clock(name)() - stamp_ns < OLDEST_NS:
            return name
    return None
