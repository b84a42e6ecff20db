import time

import pytest

from common.clock import Clock, SystemClock
from slave.clocks import OLDEST_NS, TRIES, ForeignClock, clock_of, system_clock

PERIOD_NS = 16_666_667
LATENCY_NS = 25_000_000


class Clocks(Clock):
    """The slave's clock and a foreign one, both driven by the test."""

    def __init__(self, offset_ns: int) -> None:
        self.t_ns = 1_000_000_000_000
        self.offset_ns = offset_ns
        self.stolen_ns: list[int] = []  # what the system takes between two readings
        self.rate_ppm = 0

    def now_ns(self) -> int:
        self.t_ns += 100
        return self.t_ns

    def foreign_ns(self) -> int:
        self.t_ns += self.stolen_ns.pop(0) if self.stolen_ns else 0
        return self.at(self.t_ns)

    def at(self, t_ns: int) -> int:
        return t_ns + self.offset_ns + t_ns * self.rate_ppm // 10**6


@pytest.mark.parametrize("offset_ns", [0, 1_700_000_000_000_000_000, -123_456_789])
def test_a_stamp_is_converted_to_a_microsecond(offset_ns: int) -> None:
    clocks = Clocks(offset_ns)
    foreign = ForeignClock(clocks, clocks.foreign_ns)
    for _ in range(10):
        clocks.t_ns += PERIOD_NS
        taken_ns = clocks.t_ns - LATENCY_NS
        assert abs(foreign.to_own(clocks.at(taken_ns)) - taken_ns) <= 1_000
    assert foreign.steps == 0


@pytest.mark.parametrize("step_ns", [50_000_000, -50_000_000, 3_600_000_000_000, -1_500_000])
@pytest.mark.parametrize("stamped_before", [True, False])
def test_a_stepped_wall_clock_moves_no_frame(step_ns: int, stamped_before: bool) -> None:
    clocks = Clocks(1_700_000_000_000_000_000)
    foreign = ForeignClock(clocks, clocks.foreign_ns)
    for number in range(20):
        clocks.t_ns += PERIOD_NS
        taken_ns = clocks.t_ns - LATENCY_NS
        stamp_ns = clocks.at(taken_ns)
        if number == 10:  # the clock is set while this frame is on its way, or just before it is stamped
            clocks.offset_ns += step_ns
            stamp_ns += 0 if stamped_before else step_ns
        assert abs(foreign.to_own(stamp_ns) - taken_ns) <= 1_000, number
    assert foreign.steps == 1


def test_a_slewed_clock_is_followed_and_is_no_step() -> None:
    clocks = Clocks(0)
    clocks.rate_ppm = 500  # as fast as Linux slews
    foreign = ForeignClock(clocks, clocks.foreign_ns)
    for _ in range(200):
        clocks.t_ns += PERIOD_NS
        taken_ns = clocks.t_ns - LATENCY_NS
        assert abs(foreign.to_own(clocks.at(taken_ns)) - taken_ns) <= 15_000  # 500 ppm of the age
    assert foreign.steps == 0


def test_an_interrupted_reading_is_made_again() -> None:
    clocks = Clocks(777)
    foreign = ForeignClock(clocks, clocks.foreign_ns)
    clocks.stolen_ns = [8_000_000, 3_000_000, 50]
    taken_ns = clocks.t_ns
    assert abs(foreign.to_own(clocks.at(taken_ns)) - taken_ns) <= 1_000
    clocks.stolen_ns = [8_000_000, 300_000] + [8_000_000] * (
        TRIES - 2
    )  # never undisturbed: the narrowest counts
    assert abs(foreign.to_own(clocks.at(taken_ns)) - taken_ns) <= 150_100


def test_the_clock_of_a_stamp_is_found_on_this_machine() -> None:
    assert clock_of(time.monotonic_ns() - LATENCY_NS) == "monotonic"
    assert clock_of(time.time_ns() - LATENCY_NS) == "wall"
    assert clock_of(time.time_ns() - 2 * OLDEST_NS) is None
    assert clock_of(0) is None
    own = SystemClock()
    stamp_ns = time.time_ns()
    expected_ns = own.now_ns()
    assert abs(ForeignClock(own, system_clock("wall")).to_own(stamp_ns) - expected_ns) < 50_000_000
