"""What a soak says: does memory grow or step, does latency grow, was anything lost?

Memory and latency on a machine that others use as well are noisy, and noise has outliers: slopes are those of Theil and
Sen (median of the slopes of all pairs, P. K. Sen, "Estimates of the regression coefficient based on Kendall's tau",
1968), with Sen's interval of 95 %, widened where what is left is correlated. A process that keeps more and more raises
the least, too, whoever else is busy: of latency the quietest minute of every five is judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan, sqrt

import numpy as np

from bench.soak_monitor import Minute, SoakHistory
from bench.soak_steps import STEP_MB, Step, steps_of
from common.arrays import Float

MB_PER_H = 1.0
GROWS_MS, GROWS_SHARE = (
    1.0,
    0.05,
)  # latency that grew by less over the run, or by less of itself, did not grow
WARM_UP_S, WARM_UP_SHARE = 300.0, 1.0 / 6.0
BLOCK_S, QUIET_MINUTES = 60.0, 5
LEAST_S = 600.0  # after the warm-up; a shorter run cannot tell 1 MB/h from the last arenas that are filled
_Z95 = 1.96
_FEWEST = 4


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
    """Theil and Sen's slope of `values` (N,) over times (N,) [s]; NaN values are left out."""
    t, y = np.asarray(times_s, np.float64) / 3600.0, np.asarray(values, np.float64)
    t, y = t[np.isfinite(y)], y[np.isfinite(y)]
    n = len(t)
    if n < _FEWEST:
        return Slope(nan, nan, nan)
    one, other = np.triu_indices(n, 1)
    pairs = np.sort((y[other] - y[one]) / (t[other] - t[one]))
    middle = float(np.median(pairs))
    left = y - middle * t
    left -= left.mean()
    power = float(left @ left)
    r = float(left[1:] @ left[:-1]) / power if power > 0 else 0.0
    wider = sqrt((1.0 + max(r, 0.0)) / (1.0 - min(max(r, 0.0), 0.95)))
    spread = _Z95 * wider * sqrt(n * (n - 1) * (2 * n + 5) / 18.0)
    low = round((len(pairs) - spread) / 2.0)
    high = round((len(pairs) + spread) / 2.0)
    return Slope(middle, float(pairs[max(low, 0)]), float(pairs[min(high, len(pairs) - 1)]))


def warm_up_s(length_s: float) -> float:
    """What is left out at the beginning of a run: files are read, tables and rings filled, learners settle."""
    return min(WARM_UP_S, WARM_UP_SHARE * length_s)


def memory_slope(history: SoakHistory, process: str, quantity: str = "rss_mb") -> Slope:
    """Of a process, by medians of minutes, after the warm-up [MB/h]."""
    times, values = np.array(history.times_s), np.array(history.series(process, quantity))
    if not len(times) or times[-1] - warm_up_s(times[-1]) < LEAST_S:
        return Slope(nan, nan, nan)
    block = (times // BLOCK_S).astype(np.int64)
    late = times >= warm_up_s(times[-1])
    blocks = [k for k in np.unique(block) if (late & (block == k)).any()]
    chosen = [late & (block == k) for k in blocks]
    return slope(
        [float(np.median(times[which])) for which in chosen],
        [float(np.median(values[which])) for which in chosen],
    )


def latency_slope(minutes: Sequence[Minute], quantity: str) -> Slope:
    """Of `p50_ms` or `p99_ms`, by the quietest minute of every five, after the warm-up [ms/h]."""
    if not minutes or minutes[-1].t_s - warm_up_s(minutes[-1].t_s) < LEAST_S:
        return Slope(nan, nan, nan)
    late = [one for one in minutes if one.t_s > warm_up_s(minutes[-1].t_s)]
    size = QUIET_MINUTES if len(late) >= _FEWEST * QUIET_MINUTES else 1
    groups = [late[k : k + size] for k in range(0, len(late) - size + 1, size)]
    least = [min(group, key=lambda one: getattr(one, quantity)) for group in groups]
    return slope([one.t_s for one in least], [getattr(one, quantity) for one in least])


def judge(history: SoakHistory, ended: Sequence[str]) -> list[Finding]:
    """The verdict; `ended` are processes that ended by themselves."""
    findings = [Finding("processes that ended", ", ".join(ended) or "none", "none", not ended)]
    for process in history.footprints:
        found = memory_slope(history, process)
        findings.append(
            Finding(
                f"memory of {process}",
                "too short to say"
                if np.isnan(found.per_h)
                else f"{found.per_h:+.2f} MB/h ({found.low:+.2f} ... {found.high:+.2f})",
                f"{MB_PER_H:g} MB/h",
                None if np.isnan(found.per_h) else found.per_h <= MB_PER_H,
            )
        )
    findings += [_steps(history, process) for process in history.footprints]
    findings += [_latency(history.minutes, name) for name in ("p50", "p99")]
    counts = history.minutes[-1].counts if history.minutes else {}
    for what in ("lost", "dropped", "refused", "blocked"):
        findings.append(
            Finding(what, str(counts.get(what, 0)), "0", counts.get(what, 0) == 0 if counts else None)
        )
    return findings


def _steps(history: SoakHistory, process: str) -> Finding:
    found, what = steps_of(history.times_s, history.series(process, "rss_mb")), f"steps of {process}"
    limit = f"none of {STEP_MB:g} MB"
    if found is None:
        return Finding(what, "too short to say", limit, None)
    text = "; ".join(_text_of_step(history, process, step) for step in found)
    return Finding(what, text or "none", limit, not found)


def _text_of_step(history: SoakHistory, process: str, step: Step) -> str:
    """By how much, when, and where: what grew in that minute or the one before, for a median is late."""
    near = [one for one in history.minutes if step.minute - 1 <= one.t_s // BLOCK_S - 1 <= step.minute]
    where = [f"{name} +{mb:.1f}" for one in near for name, mb in one.grown.get(process, {}).items()]
    places = ", ".join(where) or "mapping not known"
    return f"+{step.mb:.1f} MB in minute {step.minute} ({places})"


def _latency(minutes: Sequence[Minute], name: str) -> Finding:
    found = latency_slope(minutes, f"{name}_ms")
    if np.isnan(found.per_h):
        return Finding(f"latency {name}", "too short to say", "does not grow", None)
    hours = minutes[-1].t_s / 3600.0
    typical = float(np.nanmedian([getattr(one, f"{name}_ms") for one in minutes]))
    grew = found.low > 0.0 and found.per_h * hours > max(GROWS_MS, GROWS_SHARE * typical)
    value = f"{typical:.1f} ms, {found.per_h:+.2f} ms/h ({found.low:+.2f} ... {found.high:+.2f})"
    return Finding(f"latency {name}", value, "does not grow", not grew)
