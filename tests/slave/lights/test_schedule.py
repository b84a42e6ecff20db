"""Exposures are predicted from stamps: with jitter, lost frames, other clocks; not at all where they are not known."""

import numpy as np
import pytest

from slave.lights.controller import AHEAD, LEAST, MARGIN_NS, Pulse, StrobeSchedule
from tests.slave.lights.stage import FIRST_NS, LASER, LED, MS, PERIOD_NS, exposures, stamp


def schedule() -> StrobeSchedule:
    return StrobeSchedule(90.0, 2000.0, 1000.0)


def next_of(one: StrobeSchedule, number: int) -> Pulse:
    pulse = one.after(number)
    assert pulse is not None
    return pulse


def test_nothing_is_known_of_too_few_frames() -> None:
    one = schedule()
    for k in range(LEAST - 1):
        one.push(k, stamp(k))
        assert one.after(k) is None
    one.push(LEAST - 1, stamp(LEAST - 1))
    assert one.after(LEAST) is not None


def test_laser_and_leds_cover_their_exposures_and_no_other() -> None:
    one = schedule()
    for k in range(20):
        one.push(k, stamp(k))
    laser, led = next_of(one, 21), next_of(one, 22)
    assert (laser.number, laser.lit, led.number, led.lit) == (22, LASER, 23, LED)
    for pulse in (laser, led):
        start, stop = exposures(pulse.number)
        assert pulse.on_ns == pytest.approx(start - MS, abs=2000)
        assert pulse.on_ns < pulse.latest_ns < start
        assert pulse.off_ns == pytest.approx(stop + MARGIN_NS, abs=2000)
        assert exposures(pulse.number - 1)[1] < pulse.on_ns
        assert pulse.off_ns < exposures(pulse.number + 1)[0]
        assert pulse.off_ns - pulse.on_ns == pytest.approx(one.length_ns, abs=2)


@pytest.mark.parametrize("seed", range(4))
def test_jitter_and_lost_frames_move_the_prediction_by_a_part_of_the_guard(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one = schedule()
    worst = 0.0
    for k in range(400):
        if rng.random() < 0.2:
            continue
        one.push(k, stamp(k, 60_000.0, rng))
        if k > 50:
            pulse = next_of(one, k + 3)
            worst = max(worst, abs(pulse.on_ns - (exposures(pulse.number)[0] - MS)))
    assert one.restarts == 0
    assert worst < MARGIN_NS


@pytest.mark.parametrize("ppm", [-3000.0, -50.0, 50.0, 3000.0])
def test_another_rate_than_the_nominal_one_is_followed(ppm: float) -> None:
    one = schedule()
    for k in range(60):
        one.push(k, FIRST_NS + round(k * PERIOD_NS * (1.0 + ppm * 1e-6)))
    pulse = next_of(one, 60)
    middle = FIRST_NS + pulse.number * PERIOD_NS * (1.0 + ppm * 1e-6)
    assert pulse.on_ns + 2 * MS == pytest.approx(middle, abs=5000)


def test_stamps_without_order_light_nothing() -> None:
    rng = np.random.default_rng(5)
    one = schedule()
    for k in range(200):
        one.push(k, stamp(k, 1.5e6, rng))
        assert one.after(k) is None or k < 2 * LEAST  # a few may lie well by chance


def test_numbers_are_counted_by_time_not_by_the_driver() -> None:
    one = schedule()
    for seq, k in enumerate(
        [0, 1, 2, 3, 5, 6, 9, 10, 11, 12, 13, 14]
    ):  # a driver that numbers what it delivers
        one.push(seq, stamp(k))
    assert next_of(one, 14).number == 16  # 15 is ambient, as 0 was
    one.push(13, stamp(14))  # the same frame again
    assert next_of(one, 14).on_ns == pytest.approx(exposures(16)[0] - MS, abs=2000)


def test_a_stalled_camera_is_lit_no_further() -> None:
    one = schedule()
    for k in range(30):
        one.push(k, stamp(k))
    numbers, k = [], 29
    while (pulse := one.after(k)) is not None:
        numbers.append(k := pulse.number)
    assert numbers == [k for k in range(30, 30 + AHEAD) if k % 3]


def test_stamps_that_leave_the_line_begin_a_new_one() -> None:
    one = schedule()
    for k in range(30):
        assert one.push(k, stamp(k)) == (k == 0)
    assert one.push(30, stamp(30) + 4 * MS)
    assert one.restarts == 1
    assert one.after(30) is None
    for k in range(31, 31 + LEAST):
        assert not one.push(k, stamp(k) + 4 * MS)
    assert next_of(one, 45).on_ns == pytest.approx(exposures(46)[0] + 3 * MS, abs=2000)
    assert one.push(500, stamp(500))  # after five seconds
    one.forget()
    assert one.after(500) is None


def test_a_longer_exposure_and_late_stamps_are_minded() -> None:
    one = StrobeSchedule(90.0, 2000.0, 1000.0, offset_us=-700.0)
    for k in range(20):
        one.push(k, stamp(k))
    before = next_of(one, 21)
    assert before.on_ns == pytest.approx(exposures(22)[0] - 1.7 * MS, abs=2000)
    one.expose(3000.0)
    after = next_of(one, 21)
    assert (after.on_ns, after.off_ns) == (before.on_ns - MS // 2, before.off_ns + MS // 2)
