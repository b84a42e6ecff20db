"""The orientation filter: level from any side, exact turns, bias at rest and in motion, sensors that err."""

from collections.abc import Iterable

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.geometry.transforms import axis_rotation, matrix_to_rotation_vector, quaternion_to_matrix
from common.imu.fusion import OrientationFilter, Stillness
from common.messages import ImuSample
from tests.hand_helpers import any_rotation

RATE_HZ = 120.0
STEP_NS = round(1e9 / RATE_HZ)
G = np.array([0.0, 0.0, 9.81])
NO_RATE, NONE, NO_QUATERNION = np.zeros(3), np.full(3, np.nan), np.full(4, np.nan)


def sample(k: float, gyro: Float, accel: Float) -> ImuSample:
    return ImuSample("imu", 3, 7, round(k * STEP_NS), gyro, accel, NONE, NO_QUATERNION)


def still(first: float, seconds: float, gyro: Float = NO_RATE, accel: Float = G) -> list[ImuSample]:
    return [sample(first + k, gyro, accel) for k in range(round(seconds * RATE_HZ))]


def swayed(first: int, seconds: float, bias: Float, rotation: float = 0.6) -> list[tuple[ImuSample, Float]]:
    """Samples of a forearm that sways about two level axes, and how it lies (3, 3)."""

    def at(t: float) -> Float:
        return axis_rotation(0, rotation * np.sin(3.0 * t)) @ axis_rotation(1, rotation * np.sin(2.0 * t))

    made: list[tuple[ImuSample, Float]] = []
    for k in range(first, first + round(seconds * RATE_HZ)):
        t = (k - first) / RATE_HZ
        rate = (
            matrix_to_rotation_vector(at(t - 1.0 / RATE_HZ).T @ at(t)) * RATE_HZ
        )  # the mean since the last one
        arm = at(t).T @ (G + np.array([np.sin(6.0 * t), np.cos(6.0 * t), 0.0]))  # and moves with 1 m/s^2
        made.append((sample(k, rate + bias, arm), at(t)))
    return made


def run(fusion: OrientationFilter, samples: Iterable[ImuSample]) -> ImuSample:
    return [fusion.push(one) for one in samples][-1]


def tilt_deg(found: ImuSample, truth: Float) -> float:
    up = quaternion_to_matrix(found.orientation_wxyz)[2]
    return float(np.degrees(np.arccos(min(up @ truth[2], 1.0))))


def heading_deg(found: ImuSample) -> float:
    R = quaternion_to_matrix(found.orientation_wxyz)
    return float(np.degrees(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])))


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_at_rest_up_is_where_the_force_points_from_whatever_side(seed: int) -> None:
    world_imu = any_rotation(np.random.default_rng(seed))
    fusion = OrientationFilter(RATE_HZ)
    found = run(fusion, still(0, 0.9, accel=world_imu.T @ G))
    assert np.linalg.norm(found.orientation_wxyz) == pytest.approx(1.0, abs=1e-12)
    assert tilt_deg(found, world_imu) < 0.05
    assert not fusion.counts


def test_upside_down_and_what_is_not_its_own_stays() -> None:
    one = msgspec.structs.replace(sample(0, np.zeros(3), -G), mag_ut=np.array([20.0, 0.0, -40.0]))
    fusion = OrientationFilter(RATE_HZ)
    first = fusion.push(one)
    assert np.isnan(first.orientation_wxyz).all()  # not settled
    assert (first.source, first.session, first.seq, first.t_ns) == ("imu", 3, 7, 0)
    np.testing.assert_array_equal(first.mag_ut, one.mag_ut)
    found = run(fusion, still(1, 1.0, accel=-G))
    assert tilt_deg(found, np.diag([1.0, -1.0, -1.0])) < 0.05


def test_it_is_known_after_nine_tenths_of_a_second() -> None:
    found = [
        OrientationFilter.push(fusion, one) for fusion in [OrientationFilter(RATE_HZ)] for one in still(0, 1)
    ]
    known = [bool(np.isfinite(one.orientation_wxyz).all()) for one in found]
    assert known == sorted(known)
    assert 0.6 < known.index(True) / RATE_HZ < 0.9


@pytest.mark.parametrize("every", [1, 2, 5])
def test_a_quarter_turn_is_a_quarter_turn_at_any_rate(every: int) -> None:
    fusion = OrientationFilter(RATE_HZ / every)
    begun = heading_deg(run(fusion, still(0, 2.0)[::every]))
    rotation = np.array([0.0, 0.0, 5.0])  # rad/s, for pi / 10 s; half a step more at either end
    k = 240 + np.arange(0.0, np.pi / 10.0 * RATE_HZ - every, every)
    run(fusion, [sample(240 - 1e-3, rotation, G), *(sample(one, rotation, G) for one in k[1:])])
    last = 240 + np.pi / 10.0 * RATE_HZ
    found = run(fusion, [sample(last, rotation, G), sample(last + 1e-3, np.zeros(3), G)])
    assert heading_deg(found) - begun == pytest.approx(90.0, abs=2.5 * every)  # trapezoid where it begins
    assert tilt_deg(found, np.eye(3)) < 0.1


def test_steps_are_taken_from_the_stamps() -> None:
    rng = np.random.default_rng(4)
    made = swayed(0, 6.0, np.zeros(3))
    fusion = OrientationFilter(RATE_HZ)
    off = [
        tilt_deg(found, truth)
        for one, truth in made
        if rng.uniform() < 0.6 and np.isfinite((found := fusion.push(one)).orientation_wxyz).all()
    ]
    assert len(off) > 300
    assert np.sqrt(np.mean(np.square(off[120:]))) < 0.8
    assert not fusion.counts


def test_rest_measures_the_bias_and_the_heading_stays_after_it() -> None:
    bias = np.radians([4.0, -2.0, 2.0])  # beyond the three degrees per second of the library's own
    fusion = OrientationFilter(RATE_HZ)
    run(fusion, still(0, 1.4, bias))
    assert not fusion.at_rest
    begun = heading_deg(run(fusion, still(168, 3.0, bias)))
    assert fusion.at_rest
    np.testing.assert_allclose(np.degrees(fusion.bias_rad_s), [4.0, -2.0, 2.0], atol=0.1)
    grown = fusion.heading_sigma_rad
    made = swayed(528, 30.0, bias)
    found = run(fusion, [one for one, _ in made])
    assert not fusion.at_rest
    assert tilt_deg(found, made[-1][1]) < 0.7
    rotated = quaternion_to_matrix(found.orientation_wxyz) @ made[-1][1].T  # about the vertical, nearly
    drift = abs(np.degrees(np.arctan2(rotated[1, 0], rotated[0, 0])) - begun)
    assert drift < 3.0 * np.degrees(np.sqrt(fusion.heading_sigma_rad**2 - grown**2)) < 10.0
    assert drift < 1.0


def test_without_rest_gravity_measures_the_bias_of_level_axes() -> None:
    bias = np.radians([3.0, -3.0, 0.0])
    fusion = OrientationFilter(RATE_HZ)
    made = swayed(0, 25.0, bias)
    off = [tilt_deg(fusion.push(one), truth) for one, truth in made]
    assert np.sqrt(np.mean(np.square(off[1200:]))) < 1.5  # a gain of 0.3 alone would leave 3 / 0.3 = 10
    assert np.degrees(fusion.bias_rad_s) @ [1.0, -1.0, 0.0] > 3.0  # of 6


def test_the_sigma_of_the_heading_is_that_of_the_bias_until_it_has_rested() -> None:
    fusion = OrientationFilter(RATE_HZ)
    run(fusion, [one for one, _ in swayed(0, 4.0, np.zeros(3))])
    assert (
        7.0 < np.degrees(fusion.heading_sigma_rad) < 2.5 * 4.0
    )  # gravity tells a little of the bias that turns it
    run(fusion, still(480, 10.0))
    rested = fusion.heading_sigma_rad
    run(fusion, [one for one, _ in swayed(1680, 60.0, np.zeros(3))])
    minute = np.degrees(np.sqrt(fusion.heading_sigma_rad**2 - rested**2))
    assert (
        0.03 * 60.0 < minute < 0.2 * 60.0
    )  # the bias to a few hundredths, its walk, and what it meant before


@pytest.mark.parametrize("rate_deg_s", [1.0, 3.0])
def test_a_slow_tilt_is_no_rest(rate_deg_s: float) -> None:
    machine, still_at = Stillness(), 0
    for k in range(600):
        angle = np.radians(rate_deg_s) * k / RATE_HZ
        machine.push(
            1.0 / RATE_HZ, np.array([np.radians(rate_deg_s), 0.0, 0.0]), axis_rotation(0, angle).T @ G
        )
        still_at += machine.still
    assert still_at < 0.1 * 600
    for _ in range(240):  # and it bites: the same sensor laid down
        machine.push(1.0 / RATE_HZ, np.zeros(3), G)
    assert machine.still


@pytest.mark.parametrize(
    ("gyro", "accel", "reason"),
    [
        (np.array([0.0, np.nan, 0.0]), G, "fusion.missing"),
        (np.zeros(3), NONE, "fusion.no_gravity"),
        (np.zeros(3), np.zeros(3), "fusion.no_gravity"),
    ],
)
def test_what_is_no_measurement_is_counted_and_harms_nothing(gyro: Float, accel: Float, reason: str) -> None:
    fusion = OrientationFilter(RATE_HZ)
    fusion.push(sample(-1, gyro, accel))  # not even as the first
    run(fusion, still(0, 1.0))
    bad = fusion.push(sample(120, gyro, accel))
    assert np.isfinite(bad.orientation_wxyz).all() == (reason == "fusion.no_gravity")
    assert fusion.counts == {reason: 2}
    assert tilt_deg(run(fusion, still(121, 0.1)), np.eye(3)) < 1e-3


def test_a_turn_without_gravity_is_still_a_turn() -> None:
    fusion = OrientationFilter(RATE_HZ)
    run(fusion, still(0, 2.0))
    spin = np.array([1.0, 0.0, 0.0])
    found = run(fusion, [sample(240 + k, spin, NONE) for k in range(61)])
    assert tilt_deg(found, axis_rotation(0, 61 / RATE_HZ)) < 0.1


def test_a_late_sample_changes_nothing() -> None:
    ones, others = OrientationFilter(RATE_HZ), OrientationFilter(RATE_HZ)
    for fusion in (ones, others):
        run(fusion, still(0, 1.0, np.array([0.1, 0.0, 0.0])))
    for k in (119, 100):  # again, and older
        late = ones.push(sample(k, np.array([9.0, 9.0, 9.0]), -G))
        assert np.isnan(late.orientation_wxyz).all()
    assert ones.counts == {"fusion.late": 2}
    a, b = (run(fusion, still(120, 0.1)) for fusion in (ones, others))
    np.testing.assert_array_equal(a.orientation_wxyz, b.orientation_wxyz)


@pytest.mark.parametrize("away_s", [0.5, 3600.0, -3600.0])
def test_after_a_gap_it_settles_anew_and_its_heading_is_unsure(away_s: float) -> None:
    fusion = OrientationFilter(RATE_HZ)
    bias = np.radians([1.0, 0.0, 0.0])
    run(fusion, still(0, 4.0, bias))
    sure = fusion.heading_sigma_rad
    lies = axis_rotation(0, 0.7)
    back = [fusion.push(one) for one in still(480 + away_s * RATE_HZ, 1.0, bias, lies.T @ G)]
    assert fusion.counts == {"fusion.gap": 1}
    assert np.isnan(back[0].orientation_wxyz).all()
    assert tilt_deg(back[-1], lies) < 0.2
    assert fusion.heading_sigma_rad > min(sure + 0.5, 1.8)
    assert fusion.heading_sigma_rad < 1.82
    assert np.degrees(fusion.bias_rad_s[0]) == pytest.approx(1.0, abs=0.1)  # it is still that sensor


def test_one_sample_of_the_future_does_not_shut_out_those_that_follow() -> None:
    fusion = OrientationFilter(RATE_HZ)
    run(fusion, still(0, 1.0))
    fusion.push(ImuSample("imu", 0, 0, 2**62, np.zeros(3), G, NONE, NO_QUATERNION))
    assert tilt_deg(run(fusion, still(121, 1.0)), np.eye(3)) < 0.05
    assert fusion.counts == {"fusion.gap": 2}


@pytest.mark.parametrize(
    ("parts", "within_deg"),
    [
        (
            [(4.0, 5.0), (20.0, 0.0)],
            60.0,
        ),  # learnt in a turn: 4 s of it and 6.5 s of rest with 5 deg/s are lost
        ([(10.0, 0.0), (4.0, 5.0), (20.0, 0.0)], 3.0),  # a turn after rest moves what that has told by little
        (
            [(10.0, 0.0), (12.0, 3.0), (20.0, 0.0)],
            45.0,
        ),  # so long an even turn is taken for rest, until there is some
    ],
)
def test_an_even_turn_that_looks_like_rest_is_found_out(
    parts: list[tuple[float, float]], within_deg: float
) -> None:
    fusion, first, rotated_deg = OrientationFilter(RATE_HZ), 0, 0.0
    found = run(fusion, still(-60, 0.5))
    for seconds, upright_deg_s in parts:
        found = run(fusion, still(first, seconds, np.radians([0.2, -0.2, upright_deg_s])))
        first += round(seconds * RATE_HZ)
        rotated_deg += seconds * upright_deg_s
    off_deg = abs((heading_deg(found) - rotated_deg + 180.0) % 360.0 - 180.0)
    assert off_deg < within_deg
    assert off_deg < 2.0 * np.degrees(found.heading_sigma_rad)
    assert np.degrees(fusion.bias_rad_s) == pytest.approx([0.2, -0.2, 0.0], abs=0.05)


def test_a_slow_sensor_has_no_gap_between_its_samples() -> None:
    fusion = OrientationFilter(8.0)
    found = run(fusion, still(0, 5.0)[::15])
    assert tilt_deg(found, np.eye(3)) < 0.05
    assert not fusion.counts
