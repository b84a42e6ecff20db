"""One row of the benchmark table."""

import statistics
from collections.abc import Callable
from time import perf_counter_ns
from typing import NamedTuple


class Row(NamedTuple):
    """What was measured, how much, in which unit, and what it is held against (goal, baseline, spread)."""

    name: str
    value: float
    unit: str
    note: str


def median_us(step: Callable[[], object], repeats: int = 200, warm: int = 20) -> tuple[float, float]:
    """Median duration of one call and half the distance of the quartiles [us]."""
    for _ in range(warm):
        step()
    samples: list[float] = []
    for _ in range(repeats):
        start = perf_counter_ns()
        step()
        samples.append((perf_counter_ns() - start) * 1e-3)
    low, middle, high = statistics.quantiles(samples, n=4)
    return middle, (high - low) / 2
