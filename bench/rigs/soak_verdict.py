"""The verdict of a soak: does memory grow or step, does latency grow, was anything lost?

Slopes are those of Theil and Sen (median of the slopes of all pairs, P. K. Sen 1968), with Sen's interval of 95 %,
widened where what is left is correlated. Of latency the quietest minute of every five is judged: a process that keeps
more and more raises the least, too.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from math import nan, sqrt
from statistics import NormalDist

import numpy as np
from scipy.stats import theilslopes  # pyright: ignore[reportUnknownVariableType]

from bench.rigs.local import Footprint
from common.arrays import Float

# Latency that grew by less over the run, or by less of itself, did not grow.
GROWS_MS, GROWS_SHARE = 1.0, 0.05
BLOCK_S = 60.0
LEAST_S = 600.0  # after the warm-up; a shorter run cannot tell 1 MB/h from the last arenas that are filled
_FEWEST = 4


@dataclass(frozen=True, slots=True)
class Minute:
    """What a minute was like."""

    t_s: float  # its end, since the start of the soak
    poses_hz: float  # poses of hands
    p50_ms: float  # latency: from the hand-over of the last frame that contributed to publication
    p99_ms: float
    load: float  # load average of the machine, which others may use as well
    cores: dict[str, float]  # process -> processor time in seconds a second
    counts: dict[str, int]  # of the master since the start: lost, skipped, dropped, refused, blocked
    clock_offset_us: dict[str, float]  # sender -> by how much its clock is ahead of the master's


@dataclass(slots=True)
class SoakHistory:
    """All that was measured: times since the start [s], footprints by process, minutes."""

    times_s: list[float] = field(default_factory=list[float])
    footprints: dict[str, list[Footprint]] = field(default_factory=dict[str, list[Footprint]])
    minutes: list[Minute] = field(default_factory=list[Minute])
    counts: dict[str, dict[str, int]] = field(default_factory=dict[str, dict[str, int]])

    def series(self, process: str, quantity: str) -> list[float]:
        """Return a quantity of a `Footprint`, of each reading."""
        return [float(getattr(one, quantity)) for one in self.footprints[process]]

    def plain(self) -> dict[str, object]:
        """Return it for JSON; arrays by process and quantity."""
        quantities = Footprint.__dataclass_fields__
        return {
            "t_s": self.times_s,
            "footprint": {name: {q: self.series(name, q) for q in quantities} for name in self.footprints},
            "minutes": [asdict(one) for one in self.minutes],
            "counts": self.counts,
        }


@dataclass(frozen=True, slots=True)
class Slope:
    """Change per hour, with the interval that holds it with 95 %; NaN: too short to say."""

    per_h: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the verdict. `ok` None: too short a run to say."""

    what: str
    value: str
    limit: str
    ok: bool | None


def slope(times_s: Sequence[float] | Float, values: Sequence[float] | Float) -> Slope:
    """Return Theil and Sen's slope of `values` (N,) over times (N,) [s]; NaN values are left out."""
    t, y = np.asarray(times_s, np.float64) / 3600.0, np.asarray(values, np.float64)
    t, y = t[np.isfinite(y)], y[np.isfinite(y)]
    if len(t) < _FEWEST:
        return Slope(nan, nan, nan)
    left = y - np.asarray(theilslopes(y, t), np.float64)[0] * t
    left -= left.mean()
    power = float(left @ left)
    r = max(float(left[1:] @ left[:-1]) / power, 0.0) if power > 0 else 0.0
    wider = sqrt((1.0 + r) / (1.0 - min(r, 0.95)))
    found = np.asarray(theilslopes(y, t, 2.0 * NormalDist().cdf(1.96 * wider) - 1.0), np.float64)
    return Slope(*found[[0, 2, 3]].tolist())


def warm_up_s(length_s: float) -> float:
    """What is left out at the beginning of a run: files are read, tables and rings filled, learners settle."""
    return min(300.0, 1.0 / 6.0 * length_s)


def memory_slope(course: SoakHistory, process: str, quantity: str = "rss_mb") -> Slope:
    """Of a process, by medians of minutes, after the warm-up [MB/h]."""
    times, values = np.array(course.times_s), np.array(course.series(process, quantity))
    if not len(times) or times[-1] - warm_up_s(times[-1]) < LEAST_S:
        return Slope(nan, nan, nan)
    block = (times // BLOCK_S).astype(np.int64)
    late = times >= warm_up_s(times[-1])
    blocks = [k for k in np.unique(block) if (late & (block == k)).any()]
    chosen = [late & (block == k) for k in blocks]
    return slope(*([float(np.median(of[which])) for which in chosen] for of in (times, values)))


def latency_slope(minutes: Sequence[Minute], quantity: str) -> Slope:
    """Of `p50_ms` or `p99_ms`, by the quietest minute of every five, after the warm-up [ms/h]."""
    if not minutes or minutes[-1].t_s - warm_up_s(minutes[-1].t_s) < LEAST_S:
        return Slope(nan, nan, nan)
    late = [one for one in minutes if one.t_s > warm_up_s(minutes[-1].t_s)]
    quiet_minutes = 5
    size = quiet_minutes if len(late) >= _FEWEST * quiet_minutes else 1
    groups = [late[k : k + size] for k in range(0, len(late) - size + 1, size)]
    least = [min(group, key=lambda one: getattr(one, quantity)) for group in groups]
    return slope([one.t_s for one in least], [getattr(one, quantity) for one in least])


def judge(course: SoakHistory, ended: Sequence[str]) -> list[Finding]:
    """Return the verdict; `ended` are processes that ended by themselves."""
    findings = [Finding("processes that ended", ", ".join(ended) or "none", "none", not ended)]
    for process in course.footprints:
        found, mb_per_h, value, ok = memory_slope(course, process), 1.0, "too short to say", None
        if not np.isnan(found.per_h):
            value = f"{found.per_h:+.2f} MB/h ({found.low:+.2f} ... {found.high:+.2f})"
            ok = found.per_h <= mb_per_h
        findings.append(Finding(f"memory of {process}", value, f"{mb_per_h:g} MB/h", ok))
    findings += [_latency(course.minutes, name) for name in ("p50", "p99")]
    counts = course.minutes[-1].counts if course.minutes else {}
    for what in ("lost", "dropped", "refused", "blocked"):
        gone = counts.get(what, 0)
        findings.append(Finding(what, str(gone), "0", gone == 0 if counts else None))
    return findings


def _latency(minutes: Sequence[Minute], name: str) -> Finding:
    found = latency_slope(minutes, f"{name}_ms")
    if np.isnan(found.per_h):
        return Finding(f"latency {name}", "too short to say", "does not grow", None)
    hours = minutes[-1].t_s / 3600.0
    typical = float(np.nanmedian([getattr(one, f"{name}_ms") for one in minutes]))
    grew = found.low > 0.0 and found.per_h * hours > max(GROWS_MS, GROWS_SHARE * typical)
    value = f"{typical:.1f} ms, {found.per_h:+.2f} ms/h ({found.low:+.2f} ... {found.high:+.2f})"
    return Finding(f"latency {name}", value, "does not grow", not grew)
