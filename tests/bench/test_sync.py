"""The bar of unsynchronised cameras: depth of a hand at 1 m/s, at every offset and rate; and that the measure bites."""

import numpy as np
import pytest

from bench.cameras.sync import CALIBRATION, MOTIONS, Shooting, centroids, outcome
from master.rig.setup import load_setup

RATES_HZ = (30.0, 60.0, 90.0)
SEEDS = range(1)


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("offset_ms", [0.0, 5.0, 8.3, 12.0, 16.7])
@pytest.mark.parametrize("motion", ["crossing", "swing 10 cm"])
def test_depth_is_right_at_every_offset(motion: str, rate_hz: float, offset_ms: float) -> None:
    found = outcome(MOTIONS[motion], Shooting(rate_hz, offset_ms * 1e-3), "interpolate", SEEDS)
    assert len(found.depth) > 100
    assert np.abs(found.depth).max() < 2.0
    assert np.percentile(np.abs(found.depth), 95) < 0.5
    assert np.percentile(found.across_mm, 95) < 0.5
    assert found.waited_s.max() <= 1.0 / rate_hz + 1e-6


def test_uncorrected_it_is_wrong_by_a_fifth_of_the_disparity() -> None:
    """D v dt / B, 22 % at 16.7 ms: of the disparity, so -18 or +29 % of the depth."""
    found = outcome(MOTIONS["crossing"], Shooting(60.0, 16.7e-3), "uncorrected", SEEDS)
    assert 17.0 < np.percentile(np.abs(found.depth), 10) < np.percentile(np.abs(found.depth), 95) < 31.0


def test_a_stamp_that_lies_by_eight_milliseconds_is_seen_in_the_depth() -> None:
    found = outcome(MOTIONS["crossing"], Shooting(60.0, 0.0, t_sigma_s=8e-3), "interpolate", range(3))
    assert np.percentile(np.abs(found.depth), 95) > 8.0


def test_rows_that_are_taken_for_simultaneous_shift_the_hand_sideways() -> None:
    found = outcome(MOTIONS["crossing"], Shooting(60.0, 8.3e-3), "row time ignored", SEEDS)
    assert np.percentile(found.across_mm, 95) > 3.0


@pytest.mark.parametrize("rate_hz", [60.0, 90.0])
@pytest.mark.parametrize("motion", ["crossing", "swing 10 cm", "reach"])
def test_predicted_depth_stays_within_the_bar_from_60_hz_on_and_waits_half_a_period(
    motion: str, rate_hz: float
) -> None:
    worst_s = 0.55 / rate_hz
    found = outcome(MOTIONS[motion], Shooting(rate_hz, worst_s), "predict", SEEDS)
    assert np.abs(found.depth).max() < 2.0
    assert found.waited_s.max() < 1e-6
    found = outcome(MOTIONS[motion], Shooting(rate_hz, 0.45 / rate_hz), "predict", SEEDS)
    assert 0.44 / rate_hz < found.waited_s.max() < 0.51 / rate_hz


@pytest.mark.parametrize("treatment", ["interpolate", "predict"])
@pytest.mark.parametrize("motion", ["rest", "crossing", "swing 20 cm", "swing 10 cm", "swing 5 cm"])
def test_regions_of_95_percent_cover(motion: str, treatment: str) -> None:
    found = outcome(MOTIONS[motion], Shooting(60.0, 9e-3), treatment, range(2))  # pyright: ignore[reportArgumentType]
    assert 90.0 < found.covered < 99.3


@pytest.mark.parametrize("motion", ["crossing", "swing 10 cm"])
def test_regions_cover_also_where_the_stamps_are_unsure(motion: str) -> None:
    shooting = Shooting(60.0, 6e-3, t_sigma_s=0.5e-3)
    found = outcome(MOTIONS[motion], shooting, "interpolate", range(60))
    assert 90.0 < found.covered < 98.5


def test_a_hand_laid_down_is_no_less_steady_than_single_frames() -> None:
    plain = outcome(MOTIONS["rest"], Shooting(60.0, 0.0), "uncorrected", range(2)).depth.std()
    assert outcome(MOTIONS["rest"], Shooting(60.0, 8.3e-3), "interpolate", range(2)).depth.std() < 0.9 * plain
    assert outcome(MOTIONS["rest"], Shooting(60.0, 8.4e-3), "predict", range(2)).depth.std() < 1.1 * plain


def test_each_centroid_is_where_its_own_row_saw_it() -> None:
    camera = load_setup(CALIBRATION, "desk").models["right"]
    motion = MOTIONS["swing 5 cm"](np.random.default_rng(1))
    starts = np.linspace(0.0, 0.04, 5)
    uv = centroids(camera, motion, starts, exposure_s=0.0)
    moments = starts[:, None] + camera.row_time_ns * 1e-9 * uv[..., 1]
    np.testing.assert_allclose(camera.project(motion(moments)), uv, atol=1e-4)
    # 20 m/s^2 over an exposure of 10 ms: the mean lags behind the middle by a T^2 / 24 at most.
    blurred = centroids(camera, motion, starts, exposure_s=0.01)
    assert 0.01 < np.abs(blurred - uv).max() < 1.3 * 994.0 * 20.0 * 0.01**2 / 24.0
