"""Tests of the question whether rays meet: the quantiles against scipy, the misfit against its own distribution."""

import numpy as np
import pytest
from scipy.stats import chi2

from common.camera_model import CameraModel
from master.stereo.misfit import RIG_PX, chi_square_quantile, chi_square_survival, limits
from master.stereo.place import Placement
from tests.hand_helpers import camera_models, rig_file

PAIR = tuple(camera_models(rig_file()).values())
THREE = tuple(camera_models(rig_file(("left", "right", "top"))).values())


@pytest.mark.parametrize("degrees", [1, 2, 3, 5, 8, 29, 61])
def test_chi_square_is_that_of_scipy(degrees: int) -> None:
    for exceeded in (0.5, 0.01, 1e-6):
        value = chi_square_quantile(exceeded, degrees)
        assert value == pytest.approx(float(chi2.isf(exceeded, degrees)), rel=1e-9)
        assert chi_square_survival(value, degrees) == pytest.approx(exceeded, rel=1e-6)


def test_the_limit_of_two_cameras_is_4_9_sigmas_and_one_camera_has_none() -> None:
    assert limits(3)[:2].tolist() == [np.inf, np.inf]
    assert np.sqrt(limits(3)[2]) == pytest.approx(4.8916, abs=1e-4)  # two-sided normal, one in a million
    assert limits(3)[3] == pytest.approx(30.665, abs=1e-3)  # three degrees


@pytest.mark.parametrize(("cameras", "degrees"), [(PAIR, 1), (THREE, 3)])
def test_noise_gives_the_distribution_the_limit_is_made_of(
    cameras: tuple[CameraModel, ...], degrees: int
) -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-0.1, -0.1, 0.4], [0.15, 0.1, 0.6], (4000, 3))
    exact = np.stack([camera.project(points) for camera in cameras])
    sigma = 0.3
    noise = rng.normal(0.0, np.hypot(sigma, RIG_PX), exact.shape)
    placed = Placement(cameras)(exact + noise, np.full(exact.shape[:2], sigma))
    assert placed.misfit.mean() == pytest.approx(degrees, rel=0.08)
    assert (placed.misfit > chi2.isf(0.01, degrees)).mean() == pytest.approx(0.01, abs=0.006)
    assert (placed.misfit <= placed.limit).all()


def test_a_camera_that_sees_something_else_is_told_from_noise() -> None:
    points = np.tile([0.02, 0.01, 0.5], (3, 1))
    uv = np.stack([camera.project(points) for camera in PAIR])
    uv[1, :, 1] += [0.0, 5.0, 7.0]  # limit: 4.9 sqrt(2 (0.1^2 + 0.85^2)) = 5.9 px
    placed = Placement(PAIR)(uv, np.full((2, 3), 0.1))
    assert (placed.misfit <= placed.limit).tolist() == [True, True, False]
    doubtful = Placement(PAIR)(uv, np.full((2, 3), 2.0))
    assert (doubtful.misfit <= doubtful.limit).all()


def test_a_marker_of_one_camera_has_neither_point_nor_misfit() -> None:
    uv = np.full((2, 1, 2), np.nan)
    uv[0, 0] = 320.0, 240.0
    placed = Placement(PAIR)(uv, np.where(np.isnan(uv[..., 0]), np.nan, 0.1))
    assert np.isnan(placed.misfit).all()
    assert np.isnan(placed.points).all()
