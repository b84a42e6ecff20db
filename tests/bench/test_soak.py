"""What a soak finds in courses whose truth is known: a leak is found, noise is none, a loss is never hidden."""

import mmap
import os
from collections.abc import Generator
from contextlib import contextmanager

import numpy as np
import pytest

from bench.rigs.local import Footprint, footprint, losses
from bench.rigs.soak_verdict import (
    Minute,
    SoakHistory,
    judge,
    latency_slope,
    memory_slope,
    slope,
)
from common.messages import Health

_EVERY_S, _HOUR_S = 5.0, 3600.0


def minute(t_s: float, p50_ms: float = 20.0, **counts: int) -> Minute:
    return Minute(t_s, 10.0, p50_ms, 3.0 * p50_ms, 1.0, {}, counts, {})


def history(
    mb_per_h: float, length_s: float = _HOUR_S, seed: int = 3, grows_ms: float = 0.0, **counts: int
) -> SoakHistory:
    """A process that leaks, in steps of a page as memory does, and reads that wobble now and then."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, length_s, _EVERY_S)
    mb = 150.0 + np.floor(mb_per_h * times / 3600.0 / 0.135) * 0.135 + 20.0 * np.exp(-times / 60.0)
    mb += np.where(rng.uniform(size=len(times)) < 0.02, rng.uniform(0.0, 8.0, len(times)), 0.0)
    minutes = [
        minute(60.0 * k, 20.0 + grows_ms * k / 60.0 + rng.exponential(6.0), **counts)
        for k in range(1, round(length_s / 60.0) + 1)
    ]
    reads = [Footprint(float(x), float(x), 0.0) for x in mb]
    return SoakHistory(list(times), {"master": reads}, minutes)


def verdict(of: SoakHistory) -> dict[str, bool | None]:
    return {one.what: one.ok for one in judge(of, [])}


@pytest.mark.parametrize("per_h", [-3.0, 0.0, 0.7, 12.0])
def test_the_slope_is_that_of_the_line_whatever_outliers_say(per_h: float) -> None:
    t = np.linspace(0.0, _HOUR_S, 60)
    y = 100.0 + per_h * t / 3600.0 + np.random.default_rng(1).normal(size=60) * 0.05
    y[::9] += 40.0
    found = slope(t, y)
    assert found.per_h == pytest.approx(per_h, abs=0.1)
    assert found.low <= per_h <= found.high


def test_too_few_points_give_no_trend_and_gaps_are_left_out() -> None:
    assert np.isnan(slope([0.0, 1.0, 2.0], [1.0, 2.0, 3.0]).per_h)
    assert slope([0.0, 3600.0, 7200.0, 9000.0, 10800.0], [0.0, 1.0, 2.0, np.nan, 3.0]).per_h == pytest.approx(
        1.0
    )


def test_a_leak_is_found_and_a_process_that_settles_is_none() -> None:
    assert memory_slope(history(3.0), "master").per_h == pytest.approx(3.0, abs=0.3)
    assert verdict(history(3.0))["memory of master"] is False
    assert verdict(history(0.0))["memory of master"] is True


def test_latency_that_creeps_up_is_found_below_the_noise_of_a_busy_machine() -> None:
    assert verdict(history(0.0, grows_ms=20.0))["latency p50"] is False
    assert verdict(history(0.0))["latency p50"] is True
    assert latency_slope(history(0.0, grows_ms=20.0).minutes, "p50_ms").per_h == pytest.approx(20.0, abs=6.0)


def test_a_run_of_minutes_says_that_it_is_too_short() -> None:
    short = verdict(history(9.0, 300.0, lost=0))
    assert short["memory of master"] is None
    assert short["latency p99"] is None
    assert short["lost"] is True


@pytest.mark.parametrize("what", ["lost", "dropped", "refused", "blocked"])
def test_one_message_that_is_gone_is_no_pass_and_one_never_sent_is_distinguished(what: str) -> None:
    assert verdict(history(0.0, **{what: 1}))[what] is False
    assert "skipped" not in verdict(history(0.0, skipped=900))


def test_the_counts_of_all_processes_are_summed_by_what_they_mean() -> None:
    master = Health("master", 1, 1, {"left.lost": 1, "imu.lost": 2, "left.skipped": 5, "queue.dropped": 3,
                                     "refused.stale": 4, "would_block": 1}, {})  # fmt: skip
    left = Health("left", 1, 1, {"send_failed": 2, "sent": 100}, {})
    expected = {"lost": 3, "skipped": 5, "dropped": 3, "refused": 4, "blocked": 3}
    assert losses({"master": master, "left": left}) == expected


@contextmanager
def fresh_pages(size: int) -> Generator[None]:
    """Pages of the kernel, in use: an array might get what this process freed before, and leave what it frees."""
    with mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as kept:
        for place in range(0, size, mmap.PAGESIZE):
            kept[place] = 1
        yield


def test_memory_of_a_process_is_read_as_the_kernel_has_it() -> None:
    before = footprint(os.getpid())
    with fresh_pages(32_000_000):
        after = footprint(os.getpid())
    assert after.anonymous_mb - before.anonymous_mb == pytest.approx(32.0, abs=3.0)
    assert after.anonymous_mb <= after.rss_mb
