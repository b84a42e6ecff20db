"""History of the last minute in figures, for the plots.

It covers latency, rates, loss, clocks and temperature. Bounded, pure.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from common.messages import Health
from common.messages.streams import MASTER

SPAN_S = 60.0
STEP_S = 0.5
MAX_SERIES = 256  # senders times quantities; what is beyond is not kept
_CAMERA_HZ, _RECEIVED = "camera_hz.", ".received"
_CLOCK = {".clock_offset_us": ("offset_ms", 1e-3), ".clock_sigma_us": ("offset_sigma_us", 1.0)}


class History:
    """Holds rows of the last minute: when [s], and name -> value.

    Names: `latency_p50_ms`, `latency_p99_ms`, `poses_per_s`, and with the name of a sender behind them
    `rate_hz.`, `lost_per_s.`, `offset_ms.`, `offset_sigma_us.`, `celsius.`. What is not known is absent.
    """

    def __init__(self) -> None:
        """Nothing has happened yet."""
        self._rows: deque[tuple[float, dict[str, float]]] = deque(maxlen=round(SPAN_S / STEP_S))
        self._counts: dict[str, tuple[int, int, float]] = {}

    def push(self, t_s: float, latencies_ms: Sequence[float], health: Mapping[str, Health]) -> None:
        """Add the row of `t_s` [s].

        Args:
            t_s: When, any clock that only rises.
            latencies_ms: Of the poses since the last row.
            health: The newest report of each process that is alive.
        """
        row: dict[str, float] = {}
        before = self._rows[-1][0] if self._rows else None
        if latencies_ms:
            p50, p99 = np.percentile(latencies_ms, [50, 99])
            row |= {"latency_p50_ms": float(p50), "latency_p99_ms": float(p99)}
        if before is not None and t_s > before:
            row["poses_per_s"] = len(latencies_ms) / (t_s - before)
        for source, report in health.items():
            row |= _of_master(report) if source == MASTER else _of_sender(source, report)
            if source == MASTER:
                row |= self._counted(report)
        self._rows.append((t_s, dict(list(row.items())[:MAX_SERIES])))

    def names(self, prefix: str) -> list[str]:
        """All series whose name begins so, sorted."""
        return sorted({name for _, row in self._rows for name in row if name.startswith(prefix)})

    def series(self, name: str) -> list[tuple[float, float]]:
        """(age [s] <= 0, value) of one series, oldest first."""
        rows = list(self._rows)
        return [(t_s - rows[-1][0], row[name]) for t_s, row in rows if name in row]

    def latest(self, name: str) -> float | None:
        """The newest value, or None."""
        rows = list(self._rows)
        return rows[-1][1].get(name) if rows else None

    def _counted(self, report: Health) -> dict[str, float]:
        """Return frame and loss rates per second.

        Frames are those that arrive from each camera; lost messages are counted for each sender.

        A count of the master that is absent is 0: what never happened it does not report.
        """
        out: dict[str, float] = {}
        for count in report.counts:
            name = count.removesuffix(_RECEIVED)
            if name == count:
                continue
            out[f"lost_per_s.{name}"] = self._increase(report, f"{name}.lost")
            if _CAMERA_HZ + name in report.metrics:
                out[f"rate_hz.{name}"] = self._increase(report, count)
        return {name: rate for name, rate in out.items() if not math.isnan(rate)}

    def _increase(self, report: Health, name: str) -> float:
        """What a count grew by per second, between two reports; NaN: not known yet."""
        now = report.counts.get(name, 0)
        then_ns, then, rate = self._counts.get(name, (report.t_ns, now, math.nan))
        count_ns = 900_000_000  # of a master that reports once a second
        if report.t_ns - then_ns >= count_ns:
            rate = max(0, now - then) * 1e9 / (report.t_ns - then_ns)
            then_ns, then = report.t_ns, now
        if report.t_ns < then_ns:  # another master
            then_ns, then = report.t_ns, now
        if name in self._counts or len(self._counts) < MAX_SERIES:
            self._counts[name] = (then_ns, then, rate)
        return rate


def _of_master(report: Health) -> dict[str, float]:
    out: dict[str, float] = {}
    for name, value in report.metrics.items():
        for suffix, (quantity, factor) in _CLOCK.items():
            if name.endswith(suffix):
                out[f"{quantity}.{name.removesuffix(suffix)}"] = factor * value
    return out


def _of_sender(source: str, report: Health) -> dict[str, float]:
    hot = [value for name, value in report.metrics.items() if "celsius" in name]
    return {f"celsius.{source}": max(hot)} if hot else {}
