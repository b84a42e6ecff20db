"""A sensor's own time stamps on the slave's clock, from nothing but when they arrived.

Whatever lies between the sensor's clock and the moment its bytes are read (its buffer, the bus, the kernel, a busy
machine) only ever delays. So the lags, arrival minus stamp, lie above a line, which is the offset of the two clocks
plus the least delay, and the line that touches them from below with the least area between is the best one: the edge
of their lower convex hull over the mean stamp (Moon, Skelly & Towsley, "Estimation and removal of clock skew from
network delay measurements", INFOCOM 1999). Its slope is the rate of the two clocks, its height the offset. Jitter of
arrivals, and samples that come in bunches, move neither.

What no one-way measurement can see is the least delay itself; `least_delay_ns` is what is known of it.
"""

from collections import deque

import numpy as np

BUCKET_NS = 500_000_000  # of so much time one lag is kept, the least
BUCKETS = 120  # a minute: a crystal's rate changes by less than 1 ppm in that time
IMPOSSIBLE_NS = 1_000_000_000  # a stamp from so far in the future is broken, or its clock was set
SUSPECTS = 3  # impossible stamps in a row: not bytes are broken, but the clock was set


class ClockSteppedError(Exception):
    """The sensor's clock has been set, or has begun anew."""


class DeviceClock:
    """Push machine. Holds the least lag of each half second of the last minute, and the line below them."""

    def __init__(self, rate_error: float, least_delay_ns: int = 0) -> None:
        """Begin without any stamp.

        Args:
            rate_error: How much faster or slower than the slave's clock the sensor's can be.
            least_delay_ns: How long the fastest sample is on its way [ns], as far as known.
        """
        self._rate_error, self._least_delay_ns = rate_error, least_delay_ns
        self._least: deque[tuple[int, int]] = deque(maxlen=BUCKETS)  # stamp, lag [ns]
        self._bucket: int | None = None
        self._foot = (0, 0)  # a point of the line: stamp, lag [ns]
        self._slope = 0.0
        self._last_ns: int | None = None
        self._suspects = 0

    def observe(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Learn from one stamp; of stamps that came together, all before the first is turned into a time.

        Args:
            stamp_ns: What the sensor said, later than the last time [ns].
            arrival_ns: A moment at which it had said it, slave's clock [ns].

        Returns:
            Whether it can be: it is not older than the last, and not from the future.

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
        bucket = stamp_ns // BUCKET_NS
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
        """The edge of the lower hull over the mean stamp; no steeper than two clocks can differ."""
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
