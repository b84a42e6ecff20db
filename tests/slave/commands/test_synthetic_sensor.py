"""The synthetic IMU keeps time like a real one: on its own clock, and never in a backlog."""

import threading

import numpy as np
import pytest

from common.clock import Clock, SkewedClock
from common.messages import ImuSample
from common.sim.sensors import SimulatedImu
from slave.commands.simulated import SyntheticSensor
from tests.slave.wrist.wrist_frames import scene

PERIOD_NS = 1e9 / 120.0
EPOCH_NS = 7_000_000_000_000
AHEAD_NS = 3_000_000_000


IMU = SimulatedImu.of(scene("standard"))


class Stage(threading.Event, Clock):
    """A true clock that moves only when somebody waits or the test says so; set after `until` waits."""

    def __init__(self, t_ns: int, until: int = 10**9) -> None:
        super().__init__()
        self.t_ns, self.left = t_ns, until

    def now_ns(self) -> int:
        return self.t_ns

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.t_ns += max(round(timeout * 1e9), 1)
        self.left -= 1
        if self.left == 0:
            self.set()
        return self.is_set()


def imu(stage: Stage, ppm: float = 0.0) -> SyntheticSensor[ImuSample]:
    return SyntheticSensor(IMU.sample, IMU.rate_hz, EPOCH_NS, SkewedClock(AHEAD_NS, ppm, stage), stage)


def numbers(source: SyntheticSensor[ImuSample], count: int) -> list[int]:
    return [sample.seq for _ in range(count) if (sample := source.read()) is not None]


def test_samples_come_one_per_period_when_they_are_measured() -> None:
    stage = Stage(EPOCH_NS - 100_000_000)
    source = imu(stage)
    for k in range(5):
        sample = source.read()
        assert sample is not None
        assert (sample.source, sample.seq, sample.session) == ("imu", k, 0)
        assert abs(sample.t_ns - AHEAD_NS - EPOCH_NS - k * PERIOD_NS) < 2
        assert 0 <= stage.t_ns - (sample.t_ns - AHEAD_NS) < 1_000


def test_what_it_says_is_that_of_the_scene_at_the_true_time_of_the_sample() -> None:
    stage = Stage(EPOCH_NS - 1)
    clock = SkewedClock(AHEAD_NS, 200.0, stage)
    stage.t_ns += 20_000_000_000
    sample = SyntheticSensor(IMU.sample, IMU.rate_hz, EPOCH_NS, clock, stage).read()
    assert sample is not None
    true_ns = clock.to_true(sample.t_ns)
    assert abs(true_ns - stage.t_ns) < 1_000
    exact = IMU.sample(sample.seq, (true_ns - EPOCH_NS) * 1e-9, 0)
    np.testing.assert_array_equal(sample.orientation_wxyz, exact.orientation_wxyz)
    np.testing.assert_array_equal(sample.gyro_rad_s, exact.gyro_rad_s)
    np.testing.assert_array_equal(sample.accel_m_s2, exact.accel_m_s2)
    nominal = IMU.sample(sample.seq, sample.seq / 120.0, 0)  # 4 ms of skew beside it
    assert not np.array_equal(sample.gyro_rad_s, nominal.gyro_rad_s)


@pytest.mark.parametrize("ppm", [-500.0, 0.0, 500.0])
def test_the_rate_is_that_of_its_own_clock(ppm: float) -> None:
    stage = Stage(EPOCH_NS)
    source = imu(stage, ppm)
    first = source.read()
    stage.t_ns += 10_000_000_000
    last = source.read()
    assert first is not None
    assert last is not None
    assert abs(last.t_ns - first.t_ns - (last.seq - first.seq) * PERIOD_NS) < 3
    assert (last.seq - first.seq) / 1200 == pytest.approx(1.0 + ppm * 1e-6, abs=2 / 1200)


def test_joins_at_any_time_with_the_number_of_that_moment() -> None:
    stage = Stage(EPOCH_NS + 10_000_000_000)
    assert numbers(imu(stage), 2) == [1201, 1202]
    assert stage.t_ns - EPOCH_NS - 10_000_000_000 < 2 * PERIOD_NS + 2


def test_a_slow_process_leaves_samples_out_and_builds_no_backlog() -> None:
    stage = Stage(EPOCH_NS - 1)
    source = imu(stage)
    assert numbers(source, 1) == [0]
    stage.t_ns += round(5.2 * PERIOD_NS)
    sample = source.read()
    assert sample is not None
    assert sample.seq == 6
    assert stage.t_ns + AHEAD_NS - sample.t_ns < 1_000  # and is on time again
    assert numbers(source, 2) == [7, 8]


def test_a_little_lateness_costs_no_sample() -> None:
    stage = Stage(EPOCH_NS - 1)
    source = imu(stage)
    seen = numbers(source, 2)
    stage.t_ns += round(1.4 * PERIOD_NS)
    assert seen + numbers(source, 3) == [0, 1, 2, 3, 4]


def test_it_ends_when_closed_or_stopped_also_while_it_waits() -> None:
    stage = Stage(EPOCH_NS)
    source = imu(stage)
    source.close()
    source.close()
    assert source.read() is None
    told = Stage(EPOCH_NS - 10**12, until=1)  # before a scene that begins in a quarter of an hour
    assert imu(told).read() is None


def test_a_stop_in_the_middle_of_a_wait_ends_it_at_once() -> None:
    stop = threading.Event()
    clock = SkewedClock(0, 0.0)
    source = SyntheticSensor(IMU.sample, IMU.rate_hz, clock.now_ns() + 3600 * 10**9, clock, stop)
    ended = threading.Event()
    thread = threading.Thread(target=lambda: source.read() is None and ended.set())
    thread.start()
    stop.set()
    thread.join(20.0)
    assert ended.is_set()
