"""Offset of a foreign clock: another machine's monotonic clock relative to ours.

The master measures every slave's clock by the four time stamps of NTP (RFC 5905, section 8):

    t1 master sends, t2 slave receives, t3 slave answers, t4 master receives
    there = t2 - t1 = offset + delay          back = t4 - t3 = delay - offset

A network only ever adds delay. So in a plot over time the offset is a line below all `there` and above all `-back`,
and the best one is the middle of the widest search band between the two clouds. For delays with an exponential tail
that is the maximum likelihood (Jeske, "On maximum-likelihood estimation of clock offset", IEEE Trans. Commun. 53,
2005; the band's slope: Moon, Skelly & Towsley, "Estimation and removal of clock skew from network delay measurements",
INFOCOM 1999). Each way has its own fastest echo: no echo need be fast both ways, as NTP's filter wants.

What no echo can see is a constant difference of the two ways. The offset is off by half of it, at most half of the
band's width; where in there is unknown. An echo that leaves the band by more than its width would have arrived before
it was sent: the remote clock was stepped, or a machine slept.
"""

from collections import deque
from dataclasses import dataclass
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Float

AT_LEAST = 5  # echoes before the offset is used
_GRID: Float = np.linspace(-1.0, 1.0, 33)


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """How a remote clock runs against the local one.

    Attributes:
        t_ns: Local time at which `offset_ns` holds [ns]: the newest echo of the fit.
        offset_ns: Remote minus local time [ns].
        drift_ppm: Rate of the remote clock minus that of the local one [1e-6].
        sigma_ns: Standard deviation of the offset from scatter [ns], if both ways of the network cost the same.
        bound_ns: Half of the band's width, that is of the shortest round trip [ns]: the offset is not further off.
        drift_sigma_ppm: Standard deviation of the drift.
    """

    t_ns: int
    offset_ns: int
    drift_ppm: float
    sigma_ns: float
    bound_ns: int
    drift_sigma_ppm: float = 0.0

    def to_local(self, t_remote_ns: int) -> int:
        """Return the local time [ns] at which the remote clock shows `t_remote_ns`."""
        drift = self.drift_ppm * 1e-6
        elapsed = t_remote_ns - (self.t_ns + self.offset_ns)
        return self.t_ns + elapsed - round(elapsed * (drift / (1.0 + drift)))

    def to_remote(self, t_local_ns: int) -> int:
        """Return what the remote clock shows [ns] at the local time `t_local_ns`."""
        return t_local_ns + self.offset_ns + round((t_local_ns - self.t_ns) * (self.drift_ppm * 1e-6))

    def scatter_at(self, t_local_ns: int) -> float:
        """Standard deviation [ns] of the offset at a local time, for ways of equal delay.

        It grows with the time since the newest echo, as the drift is known and as a crystal wanders.
        """
        wander_ppm = 1.0  # a crystal's rate changes by so much with its temperature within minutes
        drift = 1e-6 * hypot(self.drift_sigma_ppm, wander_ppm) * (t_local_ns - self.t_ns)
        return hypot(self.sigma_ns, drift)

    def sigma_at(self, t_local_ns: int) -> float:
        """Standard deviation [ns] of a converted time, with what no echo can see.

        Of the difference of the two ways only the bound is known: any value within it is as likely as another.
        """
        return hypot(self.scatter_at(t_local_ns), self.bound_ns / sqrt(3.0))


class _Echo(NamedTuple):
    t_ns: int  # middle of the round trip, local clock
    there_ns: int  # offset + delay
    back_ns: int  # delay - offset


class OffsetEstimator:
    """Estimator of clock offset and drift, with their uncertainty.

    Finds the widest search band between the echoes of a sliding window. Three echoes among twenty that contradict the
    estimate are a stepped clock and reinitialise it from the echoes since the first of them. `steps` counts such
    restarts, `refused` impossible echoes.
    """

    def __init__(self, window_ns: int = 20_000_000_000, capacity: int = 512, step_ns: int = 200_000) -> None:
        """Keep `capacity` echoes within `window_ns`; more than `step_ns` can be a step."""
        self._window_ns = window_ns
        self._step_ns = step_ns
        self._echoes: deque[_Echo] = deque(maxlen=capacity)
        self._since: list[_Echo] = []
        self._suspects = 0
        self._estimate: ClockEstimate | None = None
        self._unfitted = 0  # echoes since the estimate
        self.steps = 0
        self.refused = 0

    @property
    def ready(self) -> bool:
        """Whether there are enough echoes for a usable estimate."""
        return len(self._echoes) >= AT_LEAST

    @property
    def settled(self) -> bool:
        """Whether there are enough echoes, none contradicting: no fast ones are needed."""
        return len(self._echoes) >= 2 * AT_LEAST and not self._suspects

    def push(self, t1_ns: int, t2_ns: int, t3_ns: int, t4_ns: int) -> None:
        """Take one echo: t1, t4 on the local clock, t2, t3 on the remote clock [ns]."""
        if (t4_ns - t1_ns) - (t3_ns - t2_ns) < 0 or t4_ns < t1_ns or t3_ns < t2_ns:
            self.refused += 1
            return
        echo = _Echo((t1_ns + t4_ns) // 2, t2_ns - t1_ns, t4_ns - t3_ns)
        if self._uncertain(echo):
            return
        self._echoes.append(echo)
        while echo.t_ns - self._echoes[0].t_ns > self._window_ns:
            self._echoes.popleft()
        self._unfitted += 1
        known = self._estimate
        refit_share = 16  # refit when one echo in so many is new: less moves the band by next to nothing
        refit_ns = 500_000_000  # or when the fit is so old
        if (
            known is None
            or self._unfitted * refit_share >= len(self._echoes)
            or echo.t_ns - known.t_ns >= refit_ns
        ):
            self._estimate = _fit(self._echoes)
            self._unfitted = 0

    def estimate(self) -> ClockEstimate | None:
        """Return the estimate, which may be a few echoes old, or None before the first."""
        return self._estimate

    def _uncertain(self, echo: _Echo) -> bool:
        """Whether this echo must not be used yet; too many reinitialise the estimate."""
        wrong = self._contradicts(echo)
        if wrong or self._suspects:
            self._since.append(echo)
            self._suspects += wrong
        suspects_to_restart = 3  # echoes that contradict: one may be a freak
        if self._suspects >= suspects_to_restart:
            self.steps += 1
            self._echoes.clear()
            self._echoes.extend(self._since[:-1])
            self._estimate = None  # of the clock before the step
            wrong = False
        suspects_among = 20  # so many echoes
        if self._suspects >= suspects_to_restart or len(self._since) >= suspects_among:
            self._since, self._suspects = [], 0
        return wrong

    def _contradicts(self, echo: _Echo) -> bool:
        """Whether no delay of the network explains this echo (see the theory above)."""
        known = self._estimate
        if known is None:
            return False
        expected = known.to_remote(echo.t_ns) - echo.t_ns
        least = min(echo.there_ns - expected, echo.back_ns + expected)
        return least < -(known.bound_ns + self._step_ns + 3.0 * known.scatter_at(echo.t_ns))


@dataclass(frozen=True, slots=True)
class _OffsetBounds:
    """Constraints of the echoes on a range of drifts [ns, ns/s], at the newest echo."""

    offset: float
    sigma: float
    width: float
    drift: float
    drift_sigma: float
    step: float  # between neighbouring drifts

    @classmethod
    def of(cls, t_s: Float, there: Float, back: Float, centre: float, half: float) -> "_OffsetBounds":
        """Posterior mean and spread, for drifts within `half` of `centre`.

        Given the drift, the distances of the walls from the shortest possible delays are exponential, with the spacing
        of the shortest delays as their scale. The drift's own posterior has a Gaussian prior, and the heights of the
        walls at the mean time, in units of their scales: minus the sum of all delays above them.
        """
        drift = centre + half * _GRID
        shift = drift[:, None] * t_s
        wall, other = (there - shift).min(axis=1), (back + shift).min(axis=1)
        widest = int(np.argmax(wall + other))
        gap, other_gap = _spacing(there - shift[widest]), _spacing(back + shift[widest])
        middle_time = drift * t_s.mean()
        log = (wall + middle_time) / gap + (other - middle_time) / other_gap
        drift_prior = 100e-6  # sigma; two Pi crystals (+-100 ppm each) differ by less than twice it
        log -= 0.5 * (drift * (1e-9 / drift_prior)) ** 2
        share = np.exp(log - log.max())
        share /= share.sum()
        middle = 0.5 * ((wall - gap) - (other - other_gap))
        offset, mean = float(share @ middle), float(share @ drift)
        variance = float(share @ (middle - offset) ** 2) + 0.25 * (gap * gap + other_gap * other_gap)
        return cls(
            offset=offset,
            sigma=variance**0.5,
            width=float(share @ (wall + other)),
            drift=mean,
            drift_sigma=float(share @ (drift - mean) ** 2) ** 0.5,
            step=float(drift[1] - drift[0]),
        )


def _fit(echoes: deque[_Echo]) -> ClockEstimate:
    """Estimate the clock at the newest echo; the grid of drifts is refined."""
    table = np.array(echoes, dtype=np.int64)
    newest = int(table[-1, 0])
    base = (int(table[-1, 1]) - int(table[-1, 2])) // 2
    t_s = (table[:, 0] - newest).astype(np.float64) * 1e-9
    there, back = (table[:, 1] - base).astype(np.float64), (table[:, 2] + base).astype(np.float64)
    widest_drift = 800e-6  # a clock that is slewed by its time service: 500 ppm
    found = _OffsetBounds.of(t_s, there, back, 0.0, widest_drift * 1e9)
    zooms = 6
    for _ in range(zooms):
        if found.drift_sigma > 2.0 * found.step:
            break
        found = _OffsetBounds.of(t_s, there, back, found.drift, 4.0 * max(found.drift_sigma, found.step))
    return ClockEstimate(
        t_ns=newest,
        offset_ns=base + round(found.offset),
        drift_ppm=found.drift * 1e-3,
        sigma_ns=found.sigma,
        bound_ns=max(0, round(0.5 * found.width)),
        drift_sigma_ppm=max(found.drift_sigma, found.step) * 1e-3,
    )


def _spacing(delay_ns: Float) -> float:
    """Typical spacing [ns] of the shortest delays (n,) [ns]: the shortest's excess."""
    n = len(delay_ns)
    floor_ns = 2_000.0  # scatter of the fastest echoes: scheduling of two threads
    if n < AT_LEAST:
        return max(floor_ns, float(delay_ns.max() - delay_ns.min()))
    edge_share = 8  # one echo in so many determines how sharp the edge of a cloud is
    count = max(AT_LEAST - 1, n // edge_share)
    shortest = np.partition(delay_ns, count)[: count + 1]
    soft_edge = 1.5  # few delays are quite as short as an exponential law would have it
    return max(floor_ns, soft_edge * float(shortest.max() - shortest.min()) / count)
