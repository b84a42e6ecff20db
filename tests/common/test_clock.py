"""Clocks: a skewed clock inverts exactly, a tick never drifts, an offset is found to microseconds."""

import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.clock import ClockEstimate, OffsetEstimator, SkewedClock, SystemClock, Ticker
from tests.network_helpers import ManualClock

MS = 1_000_000
S = 1_000_000_000
Delay = Callable[[random.Random], float]


def exponential(mean_ns: float) -> Delay:
    return lambda source: source.expovariate(1.0 / mean_ns)


def simulate(
    estimator: OffsetEstimator,
    true: ManualClock,
    remote: SkewedClock,
    seconds: float,
    out: Delay,
    back: Delay,
    base_ns: int = 100_000,
    period_ns: int = 200 * MS,
    loss: float = 0.0,
    seed: int = 1,
) -> None:
    """Let `estimator` echo through a network with its own queueing on each way."""
    source = random.Random(seed)
    end = true.t_ns + round(seconds * S)
    while true.t_ns < end:
        t1 = true.t_ns
        arrive = t1 + base_ns + round(out(source))
        leave = arrive + 20_000
        t4 = leave + base_ns + round(back(source))
        if source.random() >= loss:
            estimator.push(t1, remote.from_true(arrive), remote.from_true(leave), t4)
        true.t_ns = max(t1 + period_ns, t4)


def error_ns(estimator: OffsetEstimator, true: ManualClock, remote: SkewedClock) -> int:
    """Return how wrong the estimate moves a remote time of now [ns]."""
    estimate = estimator.estimate()
    assert estimate is not None
    return estimate.to_local(remote.from_true(true.t_ns)) - true.t_ns


@given(
    st.integers(-(10**15), 10**15), st.floats(-500.0, 500.0), st.integers(0, 10**15), st.integers(0, 10**15)
)
def test_skewed_clock_inverts_to_the_nanosecond(offset: int, ppm: float, epoch: int, t: int) -> None:
    clock = SkewedClock(offset, ppm, ManualClock(epoch))
    assert abs(clock.to_true(clock.from_true(t)) - t) <= 1


def test_skewed_clock_gains_its_rate() -> None:
    true = ManualClock(7 * S)
    clock = SkewedClock(3 * S, 50.0, true)
    assert clock.now_ns() == 10 * S
    true.t_ns += 100 * S
    assert clock.now_ns() == 110 * S + 5 * MS  # 50 ppm of 100 s


def test_a_clock_that_would_stand_still_is_refused() -> None:
    with pytest.raises(ValueError, match="rate_ppm"):
        SkewedClock(0, -1e6)


def test_system_clock_never_runs_backwards() -> None:
    clock = SystemClock()
    times = [clock.now_ns() for _ in range(1000)]
    assert times == sorted(times)


def test_ticks_stay_on_their_grid_and_skip_what_is_over() -> None:
    clock = ManualClock(1000)
    ticker = Ticker(100, clock)
    clock.t_ns = 1130  # the body took 130: the tick at 1100 is late but still the current one
    assert ticker.next() == 1100
    clock.t_ns = 1210
    assert ticker.next() == 1200
    clock.t_ns = 1570  # 1300 and 1400 are over for good
    assert ticker.next() == 1500
    assert ticker.missed == 2
    with pytest.raises(ValueError, match="period_ns"):
        Ticker(0)


def test_a_tick_is_waited_for() -> None:
    clock = SystemClock()
    ticker = Ticker(2 * MS, clock)
    first = ticker.next()
    assert clock.now_ns() >= first
    for _ in range(5):
        tick = ticker.next()
        assert (tick - first) % (2 * MS) == 0
        assert clock.now_ns() >= tick


@given(
    st.integers(0, 10**13),
    st.integers(-(10**15), 10**15),
    st.floats(-500.0, 500.0),
    st.integers(-(10**11), 10**11),
)
def test_to_local_and_to_remote_are_inverse(t: int, offset: int, ppm: float, elapsed: int) -> None:
    estimate = ClockEstimate(t, offset, ppm, 0.0, 0)
    assert abs(estimate.to_local(estimate.to_remote(t + elapsed)) - (t + elapsed)) <= 1
    assert estimate.to_remote(t) == t + offset


def test_one_echo_by_hand() -> None:
    # RFC 5905: offset = ((t2 - t1) + (t3 - t4)) / 2 = ((1100 - 0) + (1150 - 250)) / 2 = 1000
    estimator = OffsetEstimator()
    assert estimator.estimate() is None
    estimator.push(0, 1100, 1150, 250)
    estimate = estimator.estimate()
    assert estimate is not None
    assert (estimate.offset_ns, estimate.bound_ns, estimate.t_ns) == (1000, 100, 125)


@pytest.mark.parametrize("echo", [(10, 5, 5, 9), (0, 9, 8, 20), (0, 0, 30, 20)])
def test_an_impossible_echo_is_refused(echo: tuple[int, int, int, int]) -> None:
    estimator = OffsetEstimator()
    estimator.push(*echo)
    assert estimator.estimate() is None
    assert estimator.refused == 1


@pytest.mark.parametrize("ppm", [-100.0, 0.0, 50.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_symmetric_jitter_leaves_microseconds(ppm: float, seed: int) -> None:
    true = ManualClock(5 * S)
    remote = SkewedClock(-7 * S, ppm, true)
    estimator = OffsetEstimator()
    simulate(estimator, true, remote, 30, exponential(200_000), exponential(200_000), seed=seed)
    assert abs(error_ns(estimator, true, remote)) < 20_000
    estimate = estimator.estimate()
    assert estimate is not None
    assert abs(estimate.drift_ppm - ppm) < 5.0
    assert 1_000 < estimate.sigma_ns < 30_000


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_jitter_on_one_way_only_does_not_pull_the_offset(seed: int) -> None:
    # The mean of all echoes would be off by half of the mean queueing: 1 ms.
    true = ManualClock(5 * S)
    remote = SkewedClock(123 * S, 50.0, true)
    estimator = OffsetEstimator()
    simulate(estimator, true, remote, 30, exponential(2 * MS), lambda _: 0.0, loss=0.2, seed=seed)
    assert abs(error_ns(estimator, true, remote)) < 60_000


def test_half_a_second_is_enough_to_begin() -> None:
    for seed in range(20):
        true = ManualClock(5 * S)
        remote = SkewedClock(-3 * S, 50.0, true)
        estimator = OffsetEstimator()
        simulate(
            estimator, true, remote, 0.4, exponential(MS), exponential(300_000), period_ns=20 * MS, loss=0.36, seed=seed
        )  # fmt: skip
        assert estimator.ready
        assert abs(error_ns(estimator, true, remote)) < 500_000


def test_drift_is_followed_while_no_echo_comes() -> None:
    true = ManualClock()
    remote = SkewedClock(0, 100.0, true)
    estimator = OffsetEstimator()
    simulate(estimator, true, remote, 20, exponential(50_000), exponential(50_000))
    true.t_ns += 5 * S  # without drift the error would be 500 us
    assert abs(error_ns(estimator, true, remote)) < 50_000


@pytest.mark.parametrize("jump_ns", [5 * MS, -5 * MS, -3600 * S, 10**16])
def test_a_stepped_clock_restarts_the_estimate(jump_ns: int) -> None:
    true = ManualClock(S)
    remote = SkewedClock(40 * S, 50.0, true)
    estimator = OffsetEstimator()
    simulate(estimator, true, remote, 20, exponential(100_000), exponential(100_000))
    stepped = SkewedClock(remote.now_ns() - true.t_ns + jump_ns, 50.0, true)
    simulate(estimator, true, stepped, 0.7, exponential(100_000), exponential(100_000), seed=9)
    assert estimator.steps == 1
    assert abs(error_ns(estimator, true, stepped)) < 150_000


def test_no_queueing_however_lopsided_looks_like_a_step() -> None:
    for seed in range(5):
        true = ManualClock(S)
        remote = SkewedClock(40 * S, 80.0, true)
        estimator = OffsetEstimator()
        simulate(estimator, true, remote, 10, exponential(50_000), exponential(50_000), seed=seed)
        simulate(estimator, true, remote, 10, lambda _: 40.0 * MS, exponential(50_000), seed=seed)
        assert estimator.steps == 0
        assert abs(error_ns(estimator, true, remote)) < 100_000


def test_a_long_run_stays_bounded() -> None:
    true = ManualClock()
    remote = SkewedClock(0, 10.0, true)
    estimator = OffsetEstimator(capacity=64)
    simulate(estimator, true, remote, 60, exponential(50_000), exponential(50_000), period_ns=50 * MS)
    assert len(estimator._echoes) == 64
    assert estimator.settled
