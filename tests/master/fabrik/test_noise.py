"""The measured noise of signals: white noise, motion, steps of uneven length, and what it may be at most."""

import numpy as np
import pytest

from common.arrays import Float
from master.fabrik.one_euro import NoiseEstimator

DT_NS = 16_666_667
UNKNOWN = np.full(4, np.nan)


def measured(signals: Float, largest: Float = UNKNOWN) -> Float:
    """Variances (T, 4) [m^2] of signals (T, 4) [m] at 60 Hz."""
    machine = NoiseEstimator()
    return np.array([machine.push(k * DT_NS, x, largest) for k, x in enumerate(signals)])


def noise(seed: int, sigma_m: float, count: int = 900) -> Float:
    return np.random.default_rng(seed).normal(0.0, sigma_m, (count, 4))


@pytest.mark.parametrize("sigma_m", [1e-4, 1e-3])
@pytest.mark.parametrize("speed_m_s", [0.0, 1.0])
def test_noise_is_taken_four_times_as_a_quarter_of_a_hand_s_shows(sigma_m: float, speed_m_s: float) -> None:
    motion = speed_m_s / 60.0 * np.arange(900)[:, None]
    variance = measured(motion + noise(1, sigma_m))[240:].mean(axis=0)
    np.testing.assert_allclose(variance, 4.0 * sigma_m**2, rtol=0.1)


def test_of_noise_that_keeps_seven_tenths_all_is_measured() -> None:
    fresh, signals = noise(2, 1e-3, 6000), np.zeros((6000, 4))
    for k in range(1, len(signals)):
        signals[k] = 0.7 * signals[k - 1] + (1.0 - 0.7**2) ** 0.5 * fresh[k]
    np.testing.assert_allclose(measured(signals)[240:].mean(axis=0), 1e-6, rtol=0.15)


def test_it_is_at_most_what_is_known_of_its_source() -> None:
    largest = np.array([1e-7, 1e-7, np.nan, np.nan])
    t = np.arange(600)[:, None] / 60.0
    variance = measured(0.15 * np.sin(2.0 * np.pi * t) + noise(3, 2e-4, 600), largest)[60:]
    assert variance[:, :2].max() <= 4e-7
    assert variance[:, 2:].min() > 4e-7  # acceleration is in it


def test_steps_of_different_length_are_no_noise_and_nothing_is_known_at_first() -> None:
    machine, t_ns = NoiseEstimator(), 0
    for dt in np.random.default_rng(7).integers(5_000_000, 40_000_000, 400).tolist():
        t_ns += dt
        variance = machine.push(t_ns, np.full(4, 0.3e-9 * t_ns), UNKNOWN)
        assert (variance < 1e-20).all()
