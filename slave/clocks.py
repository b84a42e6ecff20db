"""Bring time stamps of devices to the slave's clock.

A camera driver stamps on a clock of its own choice, which can be read: `ForeignClock` reads it between two readings
of the slave's clock, so that the difference is known to half the width of that sandwich, a microsecond or less; a
wide one (the process was interrupted) is read again. A wall clock may be stepped by NTP between stamp and reading: of
the differences before and after the step the one is right that leaves the frame as old at its hand-over as the frames
before it. So a step moves no `t_ns`.

The clock of an IMU or of a tracking program cannot be read; only the arrival of its stamps is known (`DeviceClock`).
Buffer, bus, kernel and a busy machine only ever delay, so the lags, arrival minus stamp, lie above a line: offset of
the two clocks plus the least delay. The line below them with the least area between is the edge of their lower convex
hull over the mean stamp (Moon, Skelly & Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999). Its slope is the rate of the clocks, its height the offset; jitter and bunches of
samples move neither. The least delay itself no one-way measurement can see; `least_delay_ns` is what is known of it.
"""

import time
from collections import deque
from collections.abc import Callable
from math import sqrt

import numpy as np

from common.clock import Clock

TRIES = 5
OLDEST_NS = 5_000_000_000  # an older frame, or one from the future, is not on the clock that was assumed
CLOCKS = {"monotonic": "CLOCK_MONOTONIC", "boot": "CLOCK_BOOTTIME", "wall": "CLOCK_REALTIME"}


class ForeignClock:
    """Converts stamps of `read_ns` [ns] to `own`; `steps`: how often it was set."""

    def __init__(self, own: Clock, read_ns: Callable[[], int]) -> None:
        self._own = own
        self._read_ns = read_ns
        self._offset_ns: int | None = None
        self._age_ns: int | None = None
        self._width_ns = 0
        self.steps = 0

    @property
    def sigma_ns(self) -> float:
        """Standard deviation of the last conversion [ns], uniform in its sandwich."""
        return self._width_ns / sqrt(12.0)

    def to_own(self, stamp_ns: int) -> int:
        """Time on the slave's clock [ns] of a stamp taken a short while ago [ns]."""
        now_ns, offset_ns = self._pair()
        t_ns = stamp_ns - offset_ns
        before, self._offset_ns = self._offset_ns, offset_ns
        # a clock that moved this much between two frames was set; slewing makes 500 ppm of a period
        step_ns = 1_000_000
        if before is not None and abs(offset_ns - before) > step_ns:
            self.steps += 1
            if self._age_ns is not None:
                typical_ns = now_ns - self._age_ns
                t_ns = min(t_ns, stamp_ns - before, key=lambda t: abs(t - typical_ns))
        self._age_ns = now_ns - t_ns
        return t_ns

    def _pair(self) -> tuple[int, int]:
        """Own time, and foreign minus own [ns], from the narrowest sandwich."""
        best: tuple[int, int, int] | None = None
        for _ in range(TRIES):
            first_ns = self._own.now_ns()
            foreign_ns = self._read_ns()
            last_ns = self._own.now_ns()
            width_ns = last_ns - first_ns
            if best is None or width_ns < best[0]:
                best = (width_ns, last_ns, foreign_ns - (first_ns + last_ns) // 2)
            if width_ns < 20_000:  # narrow enough at once
                break
        assert best is not None, "TRIES is positive"
        self._width_ns = best[0]
        return best[1], best[2]


def system_clock(name: str) -> Callable[[], int]:
    """Reader [ns] of a clock of `CLOCKS`."""
    number, read = getattr(time, CLOCKS[name]), getattr(time, "clock_gettime_ns", None)
    assert read is not None, "drivers that ask for it are of Linux"
    return lambda: read(number)


def clock_of(stamp_ns: int) -> str | None:
    """Name of the clock that a stamp taken just now is on; None: no clock fits.

    On a machine that never slept, monotonic and boot are the same, and the first is named; after a sleep only one of
    them makes the frame neither old nor from the future.
    """
    for name in CLOCKS:
        if 0 <= system_clock(name)() - stamp_ns < OLDEST_NS:
            return name
    return None


IMPOSSIBLE_NS = 1_000_000_000  # a stamp from so far in the future is broken, or its clock was set
SUSPECTS = 3  # impossible stamps in a row: not bytes are broken, but the clock was set


class ClockSteppedError(Exception):
    """The sensor's clock has been set, or has begun anew."""


class DeviceClock:
    """Fit of offset and rate of a sensor's clock over the last minute of stamps."""

    def __init__(self, rate_error: float, least_delay_ns: int = 0) -> None:
        """Clocks differ by at most the share `rate_error`; no sample is faster [ns]."""
        self._rate_error, self._least_delay_ns = rate_error, least_delay_ns
        # A minute of buckets: a crystal's rate changes by less than 1 ppm in that time
        self._least: deque[tuple[int, int]] = deque(maxlen=120)  # stamp, lag [ns]
        self._bucket: int | None = None
        self._foot = (0, 0)  # a point of the line: stamp, lag [ns]
        self._slope = 0.0
        self._last_ns: int | None = None
        self._suspects = 0

    def observe(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Take one stamp [ns], and a time at which it had already been received [ns].

        Of stamps that came together all are observed before the first becomes a time. False for a stamp that cannot
        be: not later than the last one, or from the future.

        Raises:
            ClockSteppedError: Impossible stamps came one after another.
        """
        lag = arrival_ns - stamp_ns
        if self._last_ns is not None and (
            stamp_ns <= self._last_ns or lag < self._line(stamp_ns) - IMPOSSIBLE_NS
        ):
            self._suspects += 1
            if self._suspects >= SUSPECTS:
                raise ClockSteppedError
            return False
        self._suspects, self._last_ns = 0, stamp_ns
        bucket_ns = 500_000_000  # of so much time one lag is kept, the least
        bucket = stamp_ns // bucket_ns
        if bucket != self._bucket:
            self._least.append((stamp_ns, lag))
            self._bucket = bucket
            self._fit()
        elif lag < self._least[-1][1]:
            self._least[-1] = (stamp_ns, lag)
        if lag < self._line(stamp_ns):  # nothing arrives before it was sent: the line is lower
            self._foot = (stamp_ns, lag)
        return True

    def at(self, stamp_ns: int) -> int:
        """When on the slave's clock the sensor's clock showed `stamp_ns` [ns]."""
        return stamp_ns + round(self._line(stamp_ns)) - self._least_delay_ns

    def _line(self, stamp_ns: int) -> float:
        return self._foot[1] + self._slope * (stamp_ns - self._foot[0])

    def _fit(self) -> None:
        """Fit the edge of the lower hull, no steeper than two clocks can differ."""
        origin_ns, origin_lag = self._least[0]
        x = np.array([stamp - origin_ns for stamp, _ in self._least], float)
        y = np.array([lag - origin_lag for _, lag in self._least], float)
        mean = x.mean()
        left, right = x <= mean, x > mean
        if right.any():
            run = x[right] - x[left, None]
            rise = (y[right] - y[left, None]) / run
            over_mean = y[left, None] + rise * (mean - x[left, None])
            edge = float(rise.ravel()[over_mean.argmin()])
            self._slope = min(max(edge, -self._rate_error), self._rate_error)
        lowest = int((y - self._slope * x).argmin())
        self._foot = self._least[lowest]
