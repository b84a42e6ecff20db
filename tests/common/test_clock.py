"""Clocks: a skewed clock inverts exactly, an offset is found to microseconds."""

import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.clock import SkewedClock, SystemClock
from common.link.clock_offset import ClockEstimate, OffsetEstimator
from tests.network_helpers import ManualClock

MS = 1_000_000
S = 1_000_000_000
ECHO_FAST_NS = 10 * MS  # as master.run.link asks in the first two seconds
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
    overlap: bool = False,
) -> None:
    """Let `estimator` echo through a network with its own queueing on each way.

    With `overlap` an echo is asked for every period, also while others are under way; else after the answer.
    """
    source = random.Random(seed)
    end = true.t_ns + round(seconds * S)
    under_way: list[tuple[int, int, int, int]] = []
    while true.t_ns < end:
        t1 = true.t_ns
        arrive = t1 + base_ns + round(out(source))
        leave = arrive + 20_000
        t4 = leave + base_ns + round(back(source))
        if source.random() >= loss:
            under_way.append((t4, t1, remote.from_true(arrive), remote.from_true(leave)))
        true.t_ns = t1 + period_ns if overlap else max(t1 + period_ns, t4)
        under_way.sort()
        while under_way and under_way[0][0] <= true.t_ns:
            t4, t1, t2, t3 = under_way.pop(0)
            estimator.push(t1, t2, t3, t4)


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


BOTH_WAYS: dict[str, tuple[Delay, Delay]] = {
    "exponential": (exponential(5 * MS), exponential(5 * MS)),
    "uniform": (lambda r: r.uniform(0.0, 5.0 * MS), lambda r: r.uniform(0.0, 5.0 * MS)),
    "half normal": (lambda r: abs(r.gauss(0.0, 5.0 * MS)), lambda r: abs(r.gauss(0.0, 5.0 * MS))),
    "one way queues": (exponential(5 * MS), exponential(100_000)),
    "the other way queues": (exponential(100_000), exponential(5 * MS)),
}


@pytest.mark.parametrize(("period_ns", "loss"), [(ECHO_FAST_NS, 0.3), (2 * ECHO_FAST_NS, 0.0)])
@pytest.mark.parametrize("kind", BOTH_WAYS)
def test_two_seconds_know_the_offset_to_half_a_millisecond(kind: str, period_ns: int, loss: float) -> None:
    # 5 ms of jitter and 100 ppm; a master asks every 10 ms, a busy one half as often. The worst of 30 runs.
    out, back = BOTH_WAYS[kind]
    inside = 0
    for seed in range(30):
        true = ManualClock(5 * S)
        remote = SkewedClock(-7 * S, (100.0, -100.0)[seed % 2], true)
        estimator = OffsetEstimator()
        simulate(
            estimator, true, remote, 2, out, back, period_ns=period_ns, overlap=True, loss=loss, seed=seed
        )
        error = abs(error_ns(estimator, true, remote))
        assert error < 500_000
        estimate = estimator.estimate()
        assert estimate is not None
        assert estimate.scatter_at(true.t_ns) < 300_000
        inside += error < 1.96 * estimate.scatter_at(true.t_ns)
    assert inside >= 25  # 95 % of 30 less what chance allows (binomial, one in a hundred)


def test_bursts_that_block_the_network_half_of_the_time_are_survived() -> None:
    for seed in range(20):
        true = ManualClock(5 * S)
        remote = SkewedClock(-7 * S, 100.0, true)
        estimator = OffsetEstimator()

        def burst(r: random.Random, true: ManualClock = true) -> float:
            return r.expovariate(1 / (5.0 * MS)) + (30.0 * MS if true.t_ns // (300 * MS) % 2 else 0.0)

        simulate(estimator, true, remote, 2, burst, burst, period_ns=ECHO_FAST_NS, overlap=True, seed=seed)
        assert abs(error_ns(estimator, true, remote)) < 500_000
        assert estimator.steps == 0


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_constant_difference_of_the_ways_is_inside_the_stated_bound(share: float) -> None:
    # 2 ms of constant delay, any share of it on the way there: no echo can tell, but the bound and sigma cover it.
    true = ManualClock(5 * S)
    remote = SkewedClock(3 * S, 50.0, true)
    estimator = OffsetEstimator()
    way = 2.0 * MS
    simulate(estimator, true, remote, 5, lambda _: share * way, lambda _: (1.0 - share) * way)
    estimate = estimator.estimate()
    assert estimate is not None
    error = abs(error_ns(estimator, true, remote))
    assert error <= estimate.bound_ns + 1_000
    assert error < 1.96 * estimate.sigma_at(true.t_ns)


def test_sigma_grows_while_no_echo_comes() -> None:
    true = ManualClock(5 * S)
    remote = SkewedClock(3 * S, 50.0, true)
    estimator = OffsetEstimator()
    simulate(estimator, true, remote, 20, exponential(50_000), exponential(50_000))
    estimate = estimator.estimate()
    assert estimate is not None
    now, later = (estimate.scatter_at(true.t_ns + wait) for wait in (0, 60 * S))
    assert later > now + 50_000  # a crystal that wanders by 1 ppm
    # The error of the extrapolation stays within it.
    true.t_ns += 60 * S
    assert abs(error_ns(estimator, true, remote)) < 3.0 * later


def test_setting_the_wall_clock_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SystemClock()
    before = clock.now_ns()
    for name in ("time", "time_ns"):
        monkeypatch.setattr(f"common.clock.time.{name}", lambda: 0)  # as if somebody had set it to 1970
    assert 0 <= clock.now_ns() - before < 10 * S


@pytest.mark.parametrize("slept", ["slave", "master"])
def test_a_suspended_machine_is_a_step_and_known_again_half_a_second_later(slept: str) -> None:
    # CLOCK_MONOTONIC stands still while its machine sleeps: an hour on one clock only.
    true = ManualClock(S)
    remote = SkewedClock(40 * S, 50.0, true)
    estimator = OffsetEstimator()
    simulate(estimator, true, remote, 20, exponential(MS), exponential(MS))
    hour = 3600 * S
    after = SkewedClock(remote.now_ns() - true.t_ns + (-hour if slept == "slave" else hour), 50.0, true)
    # The echo under way when it fell asleep: its times contradict each other, or prove the sleep.
    t1 = true.t_ns
    estimator.push(t1, remote.from_true(t1 + MS), after.from_true(t1 + 2 * MS), t1 + 3 * MS)
    simulate(estimator, true, after, 0.5, exponential(MS), exponential(MS), period_ns=ECHO_FAST_NS, seed=4)
    assert estimator.steps == 1
    assert abs(error_ns(estimator, true, after)) < 500_000


@pytest.mark.parametrize("ppm", [500.0, -500.0])
def test_a_clock_that_is_slewed_is_followed(ppm: float) -> None:
    # A time service corrects its machine's clock, the monotonic one too, by at most 500 ppm (adjtimex).
    true = ManualClock(S)
    remote = SkewedClock(40 * S, 20.0, true)
    estimator = OffsetEstimator()
    simulate(estimator, true, remote, 20, exponential(100_000), exponential(100_000))
    slewed = SkewedClock(remote.now_ns() - true.t_ns, 20.0 + ppm, true)
    worst = 0
    for part in range(50):
        simulate(estimator, true, slewed, 0.2, exponential(100_000), exponential(100_000), seed=part)
        worst = max(worst, abs(error_ns(estimator, true, slewed)))
    assert worst < 1_000_000
    assert abs(error_ns(estimator, true, slewed)) < 200_000


@pytest.mark.parametrize("jump_ns", [20 * MS, -20 * MS])
def test_a_step_is_seen_through_five_milliseconds_of_jitter(jump_ns: int) -> None:
    for seed in range(10):
        true = ManualClock(S)
        remote = SkewedClock(40 * S, 100.0, true)
        estimator = OffsetEstimator()
        simulate(estimator, true, remote, 10, exponential(5 * MS), exponential(5 * MS), seed=seed)
        assert estimator.steps == 0
        stepped = SkewedClock(remote.now_ns() - true.t_ns + jump_ns, 100.0, true)
        simulate(
            estimator, true, stepped, 2, exponential(5 * MS), exponential(5 * MS), period_ns=ECHO_FAST_NS,
            overlap=True, seed=seed + 50,
        )  # fmt: skip
        assert estimator.steps == 1
        assert abs(error_ns(estimator, true, stepped)) < 500_000


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
