"""Time: the monotonic clock, a loop tick that never drifts, and the offset of a foreign clock.

Every time in Phalanx is an integer of nanoseconds on a monotonic clock; the wall clock is never
asked. Each machine has its own monotonic clock, so the master measures how each slave's clock
runs against its own, by the four-timestamp echo of NTP (RFC 5905, section 8):

    t1 master sends, t2 slave receives, t3 slave answers, t4 master receives
    offset = ((t2 - t1) + (t3 - t4)) / 2        round trip = (t4 - t1) - (t3 - t2)

The true offset lies within half a round trip of that value, whatever the two ways cost. Hence
two rules: samples count by how near their round trip is to the shortest one, and a sample that
contradicts the line by more than its half round trip proves that the remote clock was stepped.
"""

import heapq
import time
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, Protocol

BEST_FRACTION = 10  # one in ten: the best 10 % by round trip carry the estimate
BEST_AT_LEAST = 5  # while there are few samples
FLOOR_NS = 5_000.0  # scatter of a sample without queueing: scheduling of two threads [ns]
DRIFT_PRIOR = 200e-6  # two crystals differ by less than this (Raspberry Pi: +-100 ppm each)
STEPS_TO_RESTART = 3  # contradicting echoes in a row: one may be a freak of the network


def now_ns() -> int:
    """Return the monotonic time of this machine [ns]; only differences mean anything."""
    return time.monotonic_ns()


class Clock(Protocol):
    """Something that tells the time, so that a test can tell another."""

    def now_ns(self) -> int:
        """Return the time [ns]; never runs backwards."""
        ...


class SystemClock:
    """The monotonic clock of this machine."""

    def now_ns(self) -> int:
        """Return the monotonic time [ns]."""
        return now_ns()


class SkewedClock:
    """The clock of a simulated foreign machine: another zero and another rate.

    Holds the moment of its construction, at which it is `offset_ns` ahead of the true clock.
    """

    def __init__(self, offset_ns: int, rate_ppm: float, clock: Clock | None = None) -> None:
        """Begin `offset_ns` ahead of `clock` and gain `rate_ppm` microseconds per second on it.

        Raises:
            ValueError: The rate is not above -1 000 000 ppm: such a clock would not run.
        """
        self._true: Clock = SystemClock() if clock is None else clock
        self._epoch_ns = self._true.now_ns()
        self._offset_ns = offset_ns
        self._rate_ppb = round(rate_ppm * 1000)
        if self._rate_ppb <= -(10**9):
            raise ValueError(f"rate_ppm={rate_ppm}: must be above -1e6")

    def now_ns(self) -> int:
        """Return the time on this clock [ns]."""
        return self.from_true(self._true.now_ns())

    def from_true(self, t_ns: int) -> int:
        """Return what this clock shows [ns] when the true clock shows `t_ns`."""
        return t_ns + self._offset_ns + (t_ns - self._epoch_ns) * self._rate_ppb // 10**9

    def to_true(self, t_ns: int) -> int:
        """Return what the true clock shows [ns] when this clock shows `t_ns`; exact to 1 ns."""
        elapsed = t_ns - self._offset_ns - self._epoch_ns
        rate = 10**9 + self._rate_ppb
        return self._epoch_ns + (2 * elapsed * 10**9 + rate) // (2 * rate)


class Ticker:
    """Paces a loop on a fixed grid; the time the loop's body takes does not add up.

    Holds the next grid time, and in `missed` how many ticks were skipped because the loop was late.
    """

    def __init__(self, period_ns: int, clock: Clock | None = None) -> None:
        """Start the grid now.

        Raises:
            ValueError: The period is not positive.
        """
        if period_ns <= 0:
            raise ValueError(f"period_ns={period_ns}: must be positive")
        self._clock: Clock = SystemClock() if clock is None else clock
        self._period_ns = period_ns
        self._next_ns = self._clock.now_ns()
        self.missed = 0

    def next(self) -> int:
        """Sleep until the next grid time and return it [ns]; skip the ones already over."""
        self._next_ns += self._period_ns
        late = (self._clock.now_ns() - self._next_ns) // self._period_ns
        if late > 0:
            self.missed += late
            self._next_ns += late * self._period_ns
        while (left_ns := self._next_ns - self._clock.now_ns()) > 0:
            time.sleep(left_ns * 1e-9)
        return self._next_ns


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """How a remote clock runs against the local one.

    Attributes:
        t_ns: Local time at which `offset_ns` holds [ns]: the newest echo.
        offset_ns: Remote minus local time [ns].
        drift_ppm: Rate of the remote clock minus that of the local one [1e-6].
        sigma_ns: Standard deviation of the offset from scatter [ns]. A constant difference
            between the two ways of the network is invisible to any echo and not in it.
        bound_ns: Half of the shortest round trip [ns]: the offset cannot be further off than that.
    """

    t_ns: int
    offset_ns: int
    drift_ppm: float
    sigma_ns: float
    bound_ns: int

    def to_local(self, t_remote_ns: int) -> int:
        """Return the local time [ns] at which the remote clock shows `t_remote_ns`."""
        drift = self.drift_ppm * 1e-6
        elapsed = t_remote_ns - (self.t_ns + self.offset_ns)
        return self.t_ns + elapsed - round(elapsed * (drift / (1.0 + drift)))

    def to_remote(self, t_local_ns: int) -> int:
        """Return what the remote clock shows [ns] at the local time `t_local_ns`."""
        return t_local_ns + self.offset_ns + round((t_local_ns - self.t_ns) * (self.drift_ppm * 1e-6))


class _Echo(NamedTuple):
    round_trip_ns: int
    t_ns: int  # middle of the round trip, local clock
    offset_ns: int


class OffsetEstimator:
    """Line through the best echoes of a sliding window: offset, drift and their uncertainty.

    Holds the echoes of the window, the line through the best of them, and the newest echoes that
    contradict it; three of those in a row are a stepped clock and start the estimate afresh.
    `steps` counts such restarts, `refused` impossible echoes.
    """

    def __init__(
        self, window_ns: int = 20_000_000_000, capacity: int = 512, step_ns: int = 1_000_000
    ) -> None:
        """Keep at most `capacity` echoes of `window_ns`; a jump above `step_ns` is a step."""
        self._window_ns = window_ns
        self._step_ns = step_ns
        self._echoes: deque[_Echo] = deque(maxlen=capacity)
        self._suspects: list[_Echo] = []
        self._estimate: ClockEstimate | None = None
        self.steps = 0
        self.refused = 0

    @property
    def ready(self) -> bool:
        """Whether there are enough echoes for a usable estimate."""
        return len(self._echoes) >= BEST_AT_LEAST

    @property
    def settled(self) -> bool:
        """Whether there are enough echoes, and none that contradict: no need to hurry."""
        return len(self._echoes) >= 2 * BEST_AT_LEAST and not self._suspects

    def push(self, t1_ns: int, t2_ns: int, t3_ns: int, t4_ns: int) -> None:
        """Take one echo: t1, t4 on the local clock, t2, t3 on the remote clock [ns]."""
        round_trip = (t4_ns - t1_ns) - (t3_ns - t2_ns)
        if round_trip < 0 or t4_ns < t1_ns or t3_ns < t2_ns:
            self.refused += 1
            return
        offset = ((t2_ns - t1_ns) + (t3_ns - t4_ns)) // 2
        echo = _Echo(round_trip, (t1_ns + t4_ns) // 2, offset)
        if self._contradicts(echo):
            self._suspects.append(echo)
            if len(self._suspects) < STEPS_TO_RESTART:
                return
            self.steps += 1
            self._echoes.clear()
            self._echoes.extend(self._suspects)
        else:
            self._echoes.append(echo)
        self._suspects = []
        while echo.t_ns - self._echoes[0].t_ns > self._window_ns:
            self._echoes.popleft()
        self._estimate = _fit(self._echoes, echo.t_ns)

    def estimate(self) -> ClockEstimate | None:
        """Return the estimate at the newest echo, or None before the first."""
        return self._estimate

    def _contradicts(self, echo: _Echo) -> bool:
        """Whether no delay of the network explains this echo (see the theory above)."""
        if self._estimate is None:
            return False
        expected = self._estimate.to_remote(echo.t_ns) - echo.t_ns
        allowed = echo.round_trip_ns // 2 + self._estimate.bound_ns + self._step_ns
        return abs(echo.offset_ns - expected) > allowed


def _fit(echoes: deque[_Echo], t_ns: int) -> ClockEstimate:
    """Weighted least squares line through the best tenth of `echoes`, evaluated at `t_ns`.

    A sample that queued for e longer than the fastest is off by up to e/2, so it weighs
    1 / (FLOOR^2 + (e/2)^2). The drift has a Gaussian prior (ridge), so that a line through
    samples close in time stays flat: d = Sxy / (Sxx + 1/prior^2).
    """
    best = heapq.nsmallest(max(BEST_AT_LEAST, len(echoes) // BEST_FRACTION), echoes)
    shortest = best[0].round_trip_ns
    base = best[0].offset_ns
    weights = [1.0 / (FLOOR_NS**2 + (0.5 * (echo.round_trip_ns - shortest)) ** 2) for echo in best]
    x = [float(echo.t_ns - t_ns) for echo in best]
    y = [float(echo.offset_ns - base) for echo in best]
    total = sum(weights)
    x_mean = sum(w * a for w, a in zip(weights, x, strict=True)) / total
    y_mean = sum(w * b for w, b in zip(weights, y, strict=True)) / total
    sxx = sum(w * (a - x_mean) ** 2 for w, a in zip(weights, x, strict=True)) + DRIFT_PRIOR**-2
    sxy = sum(w * (a - x_mean) * (b - y_mean) for w, a, b in zip(weights, x, y, strict=True))
    drift = sxy / sxx
    residual = [b - y_mean - drift * (a - x_mean) for a, b in zip(x, y, strict=True)]
    chi2 = sum(w * r * r for w, r in zip(weights, residual, strict=True)) / max(1, len(best) - 2)
    variance = (1.0 / total + x_mean**2 / sxx) * max(1.0, chi2)
    offset = base + round(y_mean - drift * x_mean)
    return ClockEstimate(t_ns, offset, drift * 1e6, variance**0.5, (shortest + 1) // 2)
