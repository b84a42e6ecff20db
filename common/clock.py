"""Clocks give monotonic time, and a token bucket limits a rate.

Every time in Phalanx is an integer of nanoseconds on a monotonic clock; the wall clock is never asked, and setting it
moves nothing. How the clock of another machine runs is `common.link.clock_offset`.
"""

import time
from abc import ABC, abstractmethod


def now_ns() -> int:
    """Return the monotonic time of this machine [ns]; only differences mean anything."""
    return time.monotonic_ns()


class Clock(ABC):
    """Source of time, which tests can replace."""

    @abstractmethod
    def now_ns(self) -> int:
        """Return the time [ns]; never runs backwards."""


class SystemClock(Clock):
    """The monotonic clock of this machine."""

    def now_ns(self) -> int:
        """Return the monotonic time [ns]."""
        return now_ns()


class SkewedClock(Clock):
    """Clock of a simulated foreign machine: another zero and rate, steps if wanted."""

    def __init__(self, offset_ns: int, rate_ppm: float, clock: Clock | None = None) -> None:
        """Start `offset_ns` ahead of `clock`, gaining `rate_ppm` (above -1e6)."""
        self._true: Clock = SystemClock() if clock is None else clock
        self._epoch_ns = self._true.now_ns()
        self._offset_ns = offset_ns
        self._rate_ppb = round(rate_ppm * 1000)
        if self._rate_ppb <= -(10**9):
            raise ValueError(f"rate_ppm={rate_ppm}: must be above -1e6")

    def step(self, by_ns: int) -> None:
        """Step the clock by `by_ns` [ns], as for a machine that was asleep or restored."""
        self._offset_ns += by_ns

    def now_ns(self) -> int:
        """Return the time on this clock [ns]."""
        return self.from_true(self._true.now_ns())

    def from_true(self, t_ns: int) -> int:
        """Return what this clock shows [ns] when the true clock shows `t_ns`."""
        return t_ns + self._offset_ns + (t_ns - self._epoch_ns) * self._rate_ppb // 10**9

    def to_true(self, t_ns: int) -> int:
        """Return the true clock's time [ns] when this clock shows `t_ns`. Exact to 1 ns."""
        elapsed = t_ns - self._offset_ns - self._epoch_ns
        rate = 10**9 + self._rate_ppb
        return self._epoch_ns + (2 * elapsed * 10**9 + rate) // (2 * rate)


class TokenBucket:
    """Token bucket that bounds how many messages are taken."""

    def __init__(self, per_s: float, at_once: float) -> None:
        """So many a second, of which `at_once` may come together."""
        self._per_s = per_s
        self._most = self._left = at_once
        self._t_ns: int | None = None

    def take(self, t_ns: int) -> bool:
        """Whether a message that came at `t_ns` [ns] is within the rate."""
        elapsed_ns = 0 if self._t_ns is None else max(t_ns - self._t_ns, 0)
        self._t_ns = t_ns
        self._left = min(self._left + self._per_s * elapsed_ns * 1e-9, self._most)
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
