"""Triangulation: exact on exact pixels, honest covariance, NaN where the geometry does not determine a point."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from common.arrays import Float
from common.camera_model import CameraModel
from common.geometry import axis_rotation, rigid
from master.stereo.triangulate import Triangulator

MATRIX = np.array([[503.0, 0.0, 319.5], [0.0, 507.0, 239.5], [0.0, 0.0, 1.0]])
LENS = np.array([0.105, -0.21, 0.0006, -0.0009, 0.05])


def _camera(x: float, yaw_deg: float = 0.0, y: float = 0.0) -> CameraModel:
    pose = rigid(axis_rotation(1, np.radians(yaw_deg)), np.array([x, y, 0.0]))
    return CameraModel(MATRIX, LENS, pose, 640, 480, 0.0)


PAIR = Triangulator.of([_camera(0.0, 0.5), _camera(0.075, -2.0)])
FOUR = Triangulator.of([_camera(0.0), _camera(0.075, -2.0), _camera(0.4, -30.0), _camera(-0.2, 12.0, 0.2)])


def _volume(seed: int, count: int) -> Float:
    return np.random.default_rng(seed).uniform([-0.16, -0.15, 0.44], [0.16, 0.15, 0.84], (count, 3))


def _project(rig: Triangulator, points: Float) -> Float:
    return np.stack([c.project(points) for c in rig.cameras])


@pytest.mark.parametrize("rig", [PAIR, FOUR])
@given(seed=st.integers(0, 10_000), count=st.integers(0, 12))
def test_exact_pixels_give_the_exact_point(rig: Triangulator, seed: int, count: int) -> None:
    points = _volume(seed, count)
    out = rig.triangulate(_project(rig, points))
    assert out.points.shape == (count, 3)
    assert np.abs(out.points - points).max(initial=0.0) * 1e3 < 1e-6  # mm
    assert out.residual_px.max(initial=0.0) < 1e-6
    assert (out.views == len(rig.cameras)).all()


def test_each_marker_has_its_own_cameras() -> None:
    points = _volume(1, 6)
    uv = _project(FOUR, points)
    uv[0, 0] = uv[1, 0] = np.nan
    uv[2:, 1] = np.nan
    uv[1:, 2] = np.nan  # one view
    uv[:, 3] = np.nan  # none
    uv[1, 4, 0] = np.nan  # half a centroid is none
    out = FOUR.triangulate(uv)
    assert out.views.tolist() == [2, 2, 1, 0, 3, 4]
    lost = [2, 3]
    assert np.isnan(out.points[lost]).all()
    assert np.isnan(out.covariance[lost]).all()
    assert np.isnan(out.residual_px[lost]).all()
    assert np.abs(out.points - points)[[0, 1, 4, 5]].max() < 1e-9


@pytest.mark.parametrize("rig", [PAIR, FOUR])
def test_covariance_is_that_of_the_errors(rig: Triangulator) -> None:
    point = np.array([[0.05, -0.04, 0.6]])
    many = np.repeat(_project(rig, point), 4000, axis=1)
    noise = np.random.default_rng(3).normal(0.0, 0.2, many.shape)
    out = rig.triangulate(many + noise, sigma_px=0.2)
    assert np.cov(out.points.T) == pytest.approx(out.covariance.mean(axis=0), rel=0.12, abs=2e-9)
    # expected residual: each view has 2 numbers, 3 are spent on the point
    views = len(rig.cameras)
    expected = 0.2 * np.sqrt((2 * views - 3) / views)
    assert np.sqrt((out.residual_px**2).mean()) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("rig", [PAIR, FOUR])
def test_the_gain_is_the_derivative_of_the_points(rig: Triangulator) -> None:
    points = _volume(4, 5)
    uv, cameras = _project(rig, points), len(rig.cameras)
    sigma = np.random.default_rng(1).uniform(0.05, 0.5, (cameras, 5))
    uv[-1, 2] = np.nan if cameras > 2 else uv[-1, 2]
    out = rig.triangulate(uv, sigma)
    for c in range(cameras):
        for axis in range(2):
            moved = uv.copy()
            moved[c, :, axis] += 1e-3
            slope = (rig.triangulate(moved, sigma).points - out.points) / 1e-3
            np.testing.assert_allclose(out.gain[..., 2 * c + axis], slope, rtol=0.02, atol=2e-5)
    noise = out.gain * np.repeat(sigma.T, 2, axis=1)[:, None]
    np.testing.assert_allclose(noise @ noise.swapaxes(1, 2), out.covariance, rtol=1e-6, atol=1e-14)


def test_depth_noise_at_half_a_metre_by_hand() -> None:
    # parallel pair: sigma_D = sqrt(2) D^2 / (f B) sigma = 1.414 * 0.25 / (503 * 0.075) * 0.1 px = 0.94 mm
    rig = Triangulator.of(
        [
            CameraModel(MATRIX, np.zeros(5), rigid(np.eye(3), np.array([x, 0, 0])), 640, 480, 0.0)
            for x in (0, 0.075)
        ]
    )
    out = rig.triangulate(_project(rig, np.array([[0.0375, 0.0, 0.5]])), sigma_px=0.1)
    assert np.sqrt(out.covariance[0, 2, 2]) * 1e3 == pytest.approx(0.937, abs=0.01)


def test_equals_full_least_squares_on_noisy_pixels() -> None:
    rng = np.random.default_rng(8)
    points = _volume(5, 8)
    uv = _project(FOUR, points) + rng.normal(0.0, 0.3, (4, 8, 2))
    out = FOUR.triangulate(uv, sigma_px=0.3)
    for m in range(8):

        def residual(x: Float, m: int = m) -> Float:
            return (_project(FOUR, x[None])[:, 0] - uv[:, m]).ravel()

        best = least_squares(residual, points[m], x_scale=0.01, xtol=1e-12, ftol=1e-12)
        # far below the noise of 1 mm; what is left is the tangential part of the lens
        assert np.abs(out.points[m] - best.x).max() * 1e3 < 0.02
        rms = np.sqrt((best.fun**2).sum() / 4)
        assert out.residual_px[m] == pytest.approx(rms, rel=0.01)


def test_weights_trust_the_better_camera() -> None:
    points = _volume(2, 1)
    uv = _project(FOUR, points)
    uv[3] += 5.0
    sigma = np.array([[0.1], [0.1], [0.1], [50.0]])
    trusted, even = FOUR.triangulate(uv, sigma), FOUR.triangulate(uv, 0.1)
    assert np.linalg.norm(trusted.points - points) < 1e-5 < np.linalg.norm(even.points - points)
    assert even.residual_px[0] > 1.0


def test_parallel_diverging_and_behind_are_nan_not_far_away() -> None:
    rig = Triangulator.of([_camera(0.0), _camera(0.075)])
    same = np.full((2, 3, 2), [319.5, 239.5])  # parallel: same pixel in parallel cameras
    same[0, 1, 0] -= 20.0  # diverging: meets behind the cameras
    same[0, 2, 0] += 60.0  # meets in front
    out = rig.triangulate(same)
    assert np.isnan(out.points).all(axis=1).tolist() == [True, True, False]
    assert out.points[2, 2] == pytest.approx(503 * 0.075 / 60, rel=1e-2)
    # one and the same camera twice determines nothing
    twice = Triangulator.of([_camera(0.0), _camera(0.0)])
    assert np.isnan(twice.triangulate(_project(twice, _volume(3, 20))).points).all()


def test_moving_the_rig_moves_the_points() -> None:
    points = _volume(6, 5)
    T = rigid(axis_rotation(0, 1.1) @ axis_rotation(2, -2.0), np.array([3.0, -1.0, 2.0]))
    moved = Triangulator.of(
        [CameraModel(c.matrix, c.distortion, T @ c.T_rig_camera, 640, 480, 0.0) for c in PAIR.cameras]
    )
    uv = _project(PAIR, points) + np.random.default_rng(1).normal(0, 0.2, (2, 5, 2))
    a, b = PAIR.triangulate(uv), moved.triangulate(uv)
    assert b.points == pytest.approx(a.points @ T[:3, :3].T + T[:3, 3], abs=1e-9)
    assert b.covariance == pytest.approx(T[:3, :3] @ a.covariance @ T[:3, :3].T, rel=1e-6, abs=1e-14)


def test_wrong_calls_are_refused() -> None:
    with pytest.raises(ValueError, match="two cameras"):
        Triangulator.of([_camera(0.0)])
    with pytest.raises(ValueError, match=r"must be \(2, M, 2\)"):
        PAIR.triangulate(np.zeros((3, 6, 2)))
