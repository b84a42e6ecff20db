"""A sensor's clock on the slave's, from arrivals that are late, jittered and bunched."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from slave.clocks import IMPOSSIBLE_NS, SUSPECTS, ClockSteppedError, DeviceClock

PERIOD_NS = 7_500_000
BEGAN_NS = 40_000_000_000  # on the slave's clock, when the sensor's shows 0


def arrivals(
    count: int, rate_error: float, jitter_ns: float, least_ns: int, seed: int
) -> tuple[list[int], ...]:
    """Stamps, the slave's times of them, and when they arrived, never before an earlier one."""
    dice = np.random.default_rng(seed)
    stamps = [k * PERIOD_NS for k in range(1, count + 1)]
    true = [BEGAN_NS + round(stamp * (1.0 + rate_error)) for stamp in stamps]
    delays = least_ns + dice.exponential(jitter_ns, count)
    came = np.maximum.accumulate(np.array(true) + delays)
    return stamps, true, [int(t) for t in came]


def times(clock: DeviceClock, stamps: list[int], came: list[int], together: int = 1) -> Float:
    """What the clock makes of each stamp when it comes, `together` at once."""
    found: list[int] = []
    for k in range(0, len(stamps), together):
        bunch = slice(k, k + together)
        for stamp, arrival in zip(stamps[bunch], came[bunch], strict=True):
            assert clock.observe(stamp, arrival)
        found += [clock.at(stamp) for stamp in stamps[bunch]]
    return np.array(found, float)


@pytest.mark.parametrize(("rate_error", "seed"), [(-120e-6, 0), (0.0, 1), (80e-6, 2)])
def test_jitter_and_drift_are_seen_through(rate_error: float, seed: int) -> None:
    stamps, true, came = arrivals(16_000, rate_error, 4e6, 300_000, seed)
    clock = DeviceClock(200e-6, 300_000)
    error_us = 1e-3 * (times(clock, stamps, came) - np.array(true))
    assert np.abs(error_us[1000:]).max() < 150.0, "7.5 s after it began"
    assert np.std(error_us[8000:]) < 40.0
    assert np.std(np.array(came) - np.array(true)) > 3e6, "which arrivals themselves are far from"


def test_samples_in_bunches_get_their_own_times() -> None:
    stamps, true, came = arrivals(4000, 50e-6, 1e5, 0, 1)
    held = [max(came[k : (k // 20 + 1) * 20]) for k in range(len(came))]  # handed over by twenties
    got = times(DeviceClock(200e-6), stamps, held, 20)
    assert np.abs(np.diff(got) - PERIOD_NS).max() < 0.1 * PERIOD_NS, "from the first on"
    assert np.abs(got - np.array(true))[200:].max() < 0.3e6


@settings(max_examples=30)
@given(st.integers(0, 2**30), st.floats(0.0, 3e7), st.floats(-1e-3, 1e-3))
def test_nothing_is_measured_after_it_arrived(seed: int, jitter_ns: float, rate_error: float) -> None:
    stamps, _, came = arrivals(300, rate_error, jitter_ns, 0, seed)
    assert (times(DeviceClock(2e-3), stamps, came) <= np.array(came)).all()


def test_a_pause_of_the_machine_moves_nothing() -> None:
    stamps, true, came = arrivals(3000, 0.0, 1e5, 0, 2)
    late = [max(t, came[1500]) if 1000 <= k < 1500 else t for k, t in enumerate(came)]
    got = times(DeviceClock(200e-6), stamps, late)
    assert np.abs(got - np.array(true))[500:].max() < 0.4e6


def test_one_impossible_stamp_is_left_out_and_a_set_clock_is_reported() -> None:
    clock = DeviceClock(200e-6)
    for k in range(1, 10):
        assert clock.observe(k * PERIOD_NS, BEGAN_NS + k * PERIOD_NS)
    now = BEGAN_NS + 10 * PERIOD_NS
    assert not clock.observe(10 * PERIOD_NS + 2 * IMPOSSIBLE_NS, now), "bytes that were hit"
    assert not clock.observe(9 * PERIOD_NS, now), "not after the last"
    assert clock.observe(10 * PERIOD_NS, now), "one good stamp, and all is well"
    assert clock.at(10 * PERIOD_NS) == now
    for k in range(1, SUSPECTS):
        assert not clock.observe(k * PERIOD_NS, now + k * PERIOD_NS)
    with pytest.raises(ClockSteppedError):
        clock.observe(SUSPECTS * PERIOD_NS, now + SUSPECTS * PERIOD_NS)
