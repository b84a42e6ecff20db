"""The low pass that measures the noise of its signals: jitter, lag, parts that go on together, odd steps of time."""

import numpy as np
import pytest

from common.arrays import Float
from master.ik.part_filter import PartFilter

JITTER_M = 3e-4
DT_S = 1 / 60
UNKNOWN = np.full(4, np.nan)


def run(signals: Float, parts: tuple[int, ...] = (3, 1), most: Float = UNKNOWN, dt_s: float = DT_S) -> Float:
    """Filtered signals (T, 4) [m]."""
    machine = PartFilter(parts, JITTER_M)
    return np.array([machine.push(dt_s, values, most) for values in signals])


def noise(seed: int, sigma_m: float, count: int = 900) -> Float:
    return np.random.default_rng(seed).normal(0.0, sigma_m, (count, 4))


@pytest.mark.parametrize("sigma_m", [5e-4, 1e-3, 3e-3])
def test_noise_that_is_new_in_every_sample_is_taken_away_at_rest(sigma_m: float) -> None:
    # A part of three is open as long as its liveliest signal moves beyond three standard deviations.
    rest = run(noise(1, sigma_m))[240:]
    assert rest.std(axis=0).max() < 0.35 * sigma_m


def test_less_noise_than_the_jitter_is_left_alone() -> None:
    quiet = noise(2, 1e-5)
    np.testing.assert_allclose(run(quiet), quiet, atol=1e-12)


@pytest.mark.parametrize("speed_m_s", [0.5, 1.0, 2.0])
def test_a_fast_motion_is_a_millimetre_late_at_most(speed_m_s: float) -> None:
    true = speed_m_s * DT_S * np.arange(900)[:, None] * [1.0, 0.0, 0.0, 0.0]
    seen = true + noise(3, 1e-3)
    late_m = (true - run(seen))[240:, 0].mean()
    assert abs(late_m) < 1e-3  # less than its noise


def test_where_a_motion_begins_it_is_followed_in_a_few_samples() -> None:
    still, moving = np.zeros((240, 4)), DT_S * np.arange(1, 60)[:, None] * np.array([0.5, 0.0, 0.0, 0.0])
    seen = np.concatenate([still, moving]) + noise(4, 1e-3, 299)
    off = np.abs(run(seen)[240:, 0] - moving[:, 0])
    assert off[3:].max() < 4e-3


def test_a_part_goes_on_together_and_another_stays() -> None:
    # The second signal of the moving part drifts too slowly to be told from noise; the part's first one tells.
    t = DT_S * np.arange(900)[:, None]
    drift = t * np.array([1.0, 0.01, 0.0, 0.01])
    out = run(drift + noise(5, 1e-3))
    late_m = (drift - out)[240:].mean(axis=0)
    assert abs(late_m[1]) < 2e-4 < 5e-4 < late_m[3]


def test_acceleration_is_not_taken_for_noise_where_the_noise_is_known() -> None:
    t = DT_S * np.arange(600)[:, None]
    sway = 0.15 * np.sin(2.0 * np.pi * t) * np.array([1.0, 0.0, 0.0, 0.0])
    seen = sway + noise(6, 2e-4, 600)
    known, unknown = (
        np.abs(run(seen, most=most) - sway)[240:, 0].max() for most in (np.full(4, 4e-8), np.full(4, np.nan))
    )
    assert known < 1.5e-3
    assert known < unknown


def test_steps_of_different_length_are_no_noise() -> None:
    machine, t = PartFilter((4,), JITTER_M), 0.0
    late: list[float] = []
    for dt in np.random.default_rng(7).uniform(0.005, 0.04, 400):
        t += dt
        out = machine.push(float(dt), np.full(4, 0.3 * t), UNKNOWN)
        late.append(float(np.abs(out - 0.3 * t).max()))
    assert max(late) < 1e-9
