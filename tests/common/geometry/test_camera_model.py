"""The camera against OpenCV, and the way from a point to a pixel and back."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from common.arrays import Float
from common.calibration import CameraCalibration, Intrinsics
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import axis_rotation, invert, rigid, transform

DISTORTION = (0.105, -0.21, 0.0006, -0.0009, 0.05)  # a Camera v1, from the description of the file format
T_RIG_CAMERA = rigid(axis_rotation(1, -0.05) @ axis_rotation(0, 0.02), np.array([0.075, 0.001, -0.002]))


def calibration(intrinsics: Intrinsics | None) -> CameraCalibration:
    return CameraCalibration(
        version=1,
        name="left",
        width_px=640,
        height_px=480,
        frame_rate_hz=60.0,
        exposure_us=6000.0,
        analogue_gain=1.25,
        colour_gains=(1.5, 1.2),
        row_time_us=20.6,
        intrinsics=intrinsics,
    )


def model(distortion: tuple[float, float, float, float, float] = DISTORTION) -> CameraModel:
    k = Intrinsics(fx_px=503.0, fy_px=501.0, cx_px=319.5, cy_px=239.5, distortion=distortion)
    return CameraModel.of(calibration(k), T_RIG_CAMERA)


coefficients = st.tuples(
    st.floats(-0.2, 0.2),
    st.floats(-0.1, 0.1),
    st.floats(-0.002, 0.002),
    st.floats(-0.002, 0.002),
    st.floats(0, 0.05),
)
# Points in the view: the image is about +-0.64 by +-0.48 in normalized units.
views = arrays(np.float64, (7, 2), elements=st.floats(-0.6, 0.6))


@given(coefficients, views, st.floats(0.1, 3.0))
def test_project_is_opencvs(
    distortion: tuple[float, float, float, float, float], xy: Float, depth: float
) -> None:
    camera = model(distortion)
    points = transform(T_RIG_CAMERA, depth * np.concatenate([xy, np.ones((7, 1))], axis=1))
    T = invert(T_RIG_CAMERA)
    rotation = np.asarray(cv2.Rodrigues(T[:3, :3])[0], dtype=np.float64)
    expected = np.asarray(
        cv2.projectPoints(points.reshape(-1, 1, 3), rotation, T[:3, 3], camera.matrix, camera.distortion)[0]
    )
    np.testing.assert_allclose(camera.project(points), expected.reshape(-1, 2), atol=1e-8)


@given(coefficients, views)
def test_undistort_undoes_distort(distortion: tuple[float, float, float, float, float], xy: Float) -> None:
    camera = model(distortion)
    np.testing.assert_allclose(camera.undistort(camera.distort(xy)), xy, atol=1e-7)  # 5e-5 px


@given(views, st.floats(0.1, 3.0))
def test_the_ray_through_a_projected_point_meets_the_point(xy: Float, depth: float) -> None:
    camera = model()
    points = transform(T_RIG_CAMERA, depth * np.concatenate([xy, np.ones((7, 1))], axis=1))
    rays = camera.ray(camera.project(points))
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-12)
    away = points - camera.centre
    miss_m = np.linalg.norm(np.cross(away, rays), axis=-1)
    assert miss_m.max() < 1e-7
    assert (np.sum(away * rays, axis=-1) > 0).all()


def test_the_optical_axis_meets_the_principal_point() -> None:
    camera = model()
    ahead = transform(T_RIG_CAMERA, np.array([0.0, 0.0, 0.6]))
    np.testing.assert_allclose(camera.project(ahead), [319.5, 239.5], atol=1e-9)
    np.testing.assert_allclose(camera.ray(np.array([319.5, 239.5])), T_RIG_CAMERA[:3, 2], atol=1e-9)


def test_right_is_right_and_down_is_down() -> None:
    # By hand: 0.1 m right and 0.05 m down at 1 m with f = 503 and 501 px, no distortion.
    k = Intrinsics(fx_px=503.0, fy_px=501.0, cx_px=319.5, cy_px=239.5)
    camera = CameraModel.of(calibration(k), np.eye(4))
    np.testing.assert_allclose(
        camera.project(np.array([0.1, 0.05, 1.0])), [319.5 + 50.3, 239.5 + 25.05], atol=1e-9
    )


def test_points_behind_or_missing_are_nan_and_stay_alone() -> None:
    camera = CameraModel.of(calibration(Intrinsics(fx_px=500, fy_px=500, cx_px=320, cy_px=240)), np.eye(4))
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]])
    np.testing.assert_array_equal(np.isnan(camera.project(points)).any(axis=1), [False, True, True, True])


def test_pixels_that_were_not_seen_give_no_ray_and_stay_alone() -> None:
    camera = model()
    uv = np.array([[100.0, 50.0], [np.nan, np.nan], [600.0, 400.0]])
    rays = camera.ray(uv)
    np.testing.assert_array_equal(np.isnan(rays).all(axis=1), [False, True, False])
    np.testing.assert_allclose(rays[[0, 2]], camera.ray(uv[[0, 2]]), atol=1e-12)


@pytest.mark.parametrize("shape", [(2,), (0, 2), (6, 2), (3, 6, 2)])
def test_every_shape_comes_back(shape: tuple[int, ...]) -> None:
    camera = model()
    uv = np.full(shape, 200.0)
    assert camera.undistort(uv).shape == shape
    assert camera.ray(uv).shape == (*shape[:-1], 3)
    assert camera.project(camera.ray(uv)).shape == shape


def test_a_camera_without_intrinsics_says_what_its_file_needs() -> None:
    with pytest.raises(CalibrationError, match=r"'left' has no 'intrinsics'.*fx_px"):
        CameraModel.of(calibration(None), np.eye(4))


def test_row_time_is_kept_in_nanoseconds() -> None:
    assert model().row_time_ns == pytest.approx(20_600.0)
