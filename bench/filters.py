"""1 € filter on 18 signals against the reference style, one object per signal, in the same process."""

import math
import statistics
import time
from collections.abc import Callable

import numpy as np

from master.filters import OneEuro

_ROUNDS = 9
_SAMPLES = 400


class _LowPass:
    def __init__(self) -> None:
        self.last: float | None = None

    def filter(self, value: float, alpha: float) -> float:
        self.last = value if self.last is None else alpha * value + (1.0 - alpha) * self.last
        return self.last


class _Signal:
    """Casiez's filter as it is usually written: one object per signal, two low passes inside."""

    def __init__(self, min_cutoff: float, beta: float, d_cutoff: float) -> None:
        self.min_cutoff, self.beta, self.d_cutoff = min_cutoff, beta, d_cutoff
        self.x, self.dx = _LowPass(), _LowPass()
        self.time: float | None = None

    def alpha(self, cutoff: float, dt: float) -> float:
        return 1.0 / (1.0 + 1.0 / (2.0 * math.pi * cutoff) / dt)

    def filter(self, value: float, t: float) -> float:
        dt = t - self.time if self.time is not None else 1.0 / 120.0
        self.time = t
        change = (value - self.x.last) / dt if self.x.last is not None else 0.0
        speed = self.dx.filter(change, self.alpha(self.d_cutoff, dt))
        return self.x.filter(value, self.alpha(self.min_cutoff + self.beta * abs(speed), dt))


def _median_us(run: Callable[[], None], calls: int) -> float:
    times: list[float] = []
    for _ in range(_ROUNDS):
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) / calls * 1e6)
    return statistics.median(times)


def rows() -> list[tuple[str, float, str, str]]:
    """(name, value, unit, goal) of each measurement."""
    samples = np.cumsum(np.random.default_rng(1).normal(0.0, 1e-3, (_SAMPLES, 6, 3)), axis=0)
    flat: list[list[float]] = samples.reshape(_SAMPLES, 18).tolist()
    period = 8_333_333
    theirs: list[list[float]] = []
    ours: list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]] = []

    def reference() -> None:
        signals = [_Signal(1.0, 0.1, 1.0) for _ in range(18)]
        theirs[:] = [
            [s.filter(v, k * period * 1e-9) for s, v in zip(signals, row, strict=True)]
            for k, row in enumerate(flat)
        ]

    def machine() -> None:
        one_euro = OneEuro(1.0, 0.1, 1.0)
        ours[:] = [one_euro.push(k * period, sample) for k, sample in enumerate(samples)]

    slow, fast = _median_us(reference, _SAMPLES), _median_us(machine, _SAMPLES)
    difference = float(np.abs(np.stack(ours).reshape(_SAMPLES, 18) - np.array(theirs)).max())
    return [
        ("1 €, 18 signals, one object per signal (baseline)", slow, "µs", ""),
        ("1 €, 18 signals, Phalanx", fast, "µs", ""),
        ("1 €, ratio", slow / fast, "x", ">= 5"),
        ("1 €, largest difference to the reference", difference, "m", "<= 1e-9"),
    ]
