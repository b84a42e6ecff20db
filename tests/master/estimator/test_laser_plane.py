"""The laser plane: exact on points put on it, honest about rays that miss it."""

from pathlib import Path

import numpy as np
import pytest

from common.geometry.transforms import axis_rotation
from master.estimator.sensors import PlaneAxes, laser_points
from master.rig.setup import WristSetup
from tests.wrist_run import wrist_setup


@pytest.fixture(scope="module")
def setup(root: Path) -> WristSetup:
    wrist = wrist_setup(root).wrist
    assert wrist is not None
    return wrist


def test_points_on_the_plane_come_back(setup: WristSetup) -> None:
    axes = PlaneAxes.of(setup)
    flat = np.array([[-0.04, 0.08], [0.0, 0.15], [0.03, 0.19], [0.05, 0.07], [-0.02, 0.1]])
    points = axes.origin_m + flat @ axes.axes
    np.testing.assert_allclose(points @ setup.normal, setup.offset_m, atol=1e-15)
    found = laser_points(setup, setup.optics.project(points), np.full(5, 0.2))
    np.testing.assert_allclose(found.point_m, points, atol=1e-9)
    np.testing.assert_allclose(axes.flat(found.point_m), flat, atol=1e-9)


def test_axes_point_to_image_right_and_away(setup: WristSetup) -> None:
    across, along = PlaneAxes.of(setup).axes
    assert across[0] > 0.9
    assert along[2] > 0.9
    np.testing.assert_allclose([across @ setup.normal, along @ setup.normal, across @ along], 0.0, atol=1e-12)


def test_the_covariance_is_that_of_noisy_pixels(setup: WristSetup) -> None:
    rng = np.random.default_rng(4)
    axes = PlaneAxes.of(setup)
    uv = setup.optics.project(axes.origin_m + np.array([[0.01, 0.14]]) @ axes.axes)
    noisy = uv + 0.4 * rng.normal(size=(4000, 2))
    scattered = laser_points(setup, noisy, np.full(4000, 0.4)).point_m
    claimed = laser_points(setup, uv, np.array([0.4])).cov_m2[0]
    np.testing.assert_allclose(np.cov(scattered.T), claimed, atol=0.08 * claimed.max())
    assert claimed[2, 2] > 9.0 * claimed[0, 0]  # seen at a flat angle: three times longer along it at least


def test_a_ray_that_is_parallel_or_looks_away_is_not_seen_and_stays_alone(setup: WristSetup) -> None:
    # The plane lies below the camera and rises towards it: what is far above the middle never meets it.
    flat = setup.optics.project(np.array([[0.0, setup.normal[2], -setup.normal[1]]]) * -1.0)
    uv = np.array([flat[0], [320.0, 2.0], [np.nan, np.nan], [320.0, 400.0], [300.0, 380.0]])
    found = laser_points(setup, uv, np.where(np.isnan(uv[:, 0]), np.nan, 0.2))
    np.testing.assert_array_equal(np.isnan(found.point_m[:, 0]), [True, True, True, False, False])
    assert not np.isinf(found.point_m).any()
    assert not np.isinf(found.cov_m2).any()
    assert (found.point_m[3:, 2] > 0.0).all()


def test_a_plane_behind_the_camera_meets_no_ray(setup: WristSetup) -> None:
    from dataclasses import replace

    behind = replace(setup, normal=axis_rotation(0, np.pi) @ setup.normal)
    uv = np.array([[320.0, 400.0], [300.0, 380.0]])
    assert np.isnan(laser_points(behind, uv, np.full(2, 0.2)).point_m).all()
