"""All cameras at once see what each sees alone."""

import numpy as np
import pytest

from common.camera_model import CameraModel
from master.stereo.together import Together, together

STRONG = (-0.32, 0.11, 0.002, -0.001, -0.02)  # a cheap wide lens
LENSES = ((0.06, -0.12, 0.0004, -0.0006, 0.03), STRONG, (0.0, 0.0, 0.0, 0.0, 0.0))


def camera(k: int, lens: tuple[float, ...]) -> CameraModel:
    """The k-th camera of a rig, beside and turned against the first one."""
    angle = 0.1 * k
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [0.05 * k, -0.02 * k, 0.01 * k]
    matrix = np.array([[480.0 + 5 * k, 0.0, 320.0 + k], [0.0, 490.0 - 3 * k, 240.0 - k], [0.0, 0.0, 1.0]])
    return CameraModel(matrix, np.array(lens), pose, 640, 480, 0.0)


CAMERAS = tuple(camera(k, LENSES[k % len(LENSES)]) for k in range(7))


def test_points_are_projected_as_by_each_camera() -> None:
    points = np.random.default_rng(1).uniform([-0.2, -0.2, 0.4], [0.2, 0.2, 0.8], (7, 20, 3))
    points[2, 3], points[4, 5, 2] = np.nan, -0.5  # not there; behind the camera
    expected = np.stack([one.project(seen) for one, seen in zip(CAMERAS, points, strict=True)])
    found = Together.of(CAMERAS).project(points)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10)  # px
    assert np.isnan(found[[2, 4], [3, 5]]).all()
    assert np.isnan(found).sum() == 4


@pytest.mark.parametrize("count", [2, 7])
def test_pixels_are_undistorted_as_by_each_camera(count: int) -> None:
    uv = np.random.default_rng(2).uniform([0.0, 0.0], [639.0, 479.0], (count, 50, 2))
    uv[1, 4] = np.nan
    cameras = CAMERAS[:count]
    expected = np.stack([one.undistort(seen) for one, seen in zip(cameras, uv, strict=True)])
    found = Together.of(cameras).undistort(uv)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11)
    assert np.isnan(found[1, 4]).all()
    assert np.isnan(found).sum() == 2


def test_what_no_lens_shows_is_as_opencv_leaves_it() -> None:
    uv = np.full((7, 2, 2), 300.0)
    uv[1, 0] = [5000.0, -4000.0]  # beyond the fold of a barrel lens
    found = Together.of(CAMERAS).undistort(uv)
    np.testing.assert_array_equal(found[1], CAMERAS[1].undistort(uv[1]))
    np.testing.assert_allclose(found[0], CAMERAS[0].undistort(uv[0]), rtol=0.0, atol=1e-11)


def test_the_same_cameras_are_laid_out_once() -> None:
    assert together(CAMERAS) is together(CAMERAS)
    assert together(CAMERAS[:2]) is not together(CAMERAS)
