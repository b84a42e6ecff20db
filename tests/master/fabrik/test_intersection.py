"""Rays intersect: exact on exact pixels, covariance as the scatter, NaN where no point is determined; the gate."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import chi2

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import axis_rotation, rigid
from master.estimator.sensors import CameraArrays
from master.fabrik.caps import CapTables
from master.fabrik.intersection import Triangulation, limits_of, triangulate
from master.fabrik.rays import RayTriangulator
from master.fabrik.settings import RAYS
from tests.hand_helpers import camera_models, rig_file

MATRIX = np.array([[503.0, 0.0, 319.5], [0.0, 507.0, 239.5], [0.0, 0.0, 1.0]])
LENS = np.array([0.105, -0.21, 0.0006, -0.0009, 0.05])


def _camera(x: float, yaw_deg: float = 0.0, y: float = 0.0) -> CameraModel:
    pose = rigid(axis_rotation(1, np.radians(yaw_deg)), np.array([x, y, 0.0]))
    return CameraModel(MATRIX, LENS, pose, 640, 480, 0.0)


class Rig(NamedTuple):
    """Cameras, and the same as arrays."""

    cameras: tuple[CameraModel, ...]
    arrays: CameraArrays

    @classmethod
    def of(cls, *cameras: CameraModel) -> "Rig":
        return cls(cameras, CameraArrays.of(cameras))

    def triangulate(self, uv: Float, sigma_px: float | Float = 0.1) -> Triangulation:
        return triangulate(self.arrays, uv, sigma_px)


PAIR = Rig.of(*[_camera(0.0, 0.5), _camera(0.075, -2.0)])
FOUR = Rig.of(*[_camera(0.0), _camera(0.075, -2.0), _camera(0.4, -30.0), _camera(-0.2, 12.0, 0.2)])


def _volume(seed: int, count: int) -> Float:
    return np.random.default_rng(seed).uniform([-0.16, -0.15, 0.44], [0.16, 0.15, 0.84], (count, 3))


def _project(rig: Rig, points: Float) -> Float:
    return np.stack([c.project(points) for c in rig.cameras])


@pytest.mark.parametrize("rig", [PAIR, FOUR])
@given(seed=st.integers(0, 10_000), count=st.integers(0, 12))
def test_exact_pixels_give_the_exact_point(rig: Rig, seed: int, count: int) -> None:
    points = _volume(seed, count)
    out = rig.triangulate(_project(rig, points))
    assert out.points_m.shape == (count, 3)
    assert np.abs(out.points_m - points).max(initial=0.0) * 1e3 < 1e-6  # mm
    assert out.residual_px.max(initial=0.0) < 1e-4
    assert not out.outliers.any()


def test_each_marker_has_its_own_cameras() -> None:
    points = _volume(1, 6)
    uv = _project(FOUR, points)
    uv[0, 0] = uv[1, 0] = np.nan
    uv[2:, 1] = np.nan
    uv[1:, 2] = np.nan  # one view
    uv[:, 3] = np.nan  # none
    uv[1, 4, 0] = np.nan  # half a centroid is none
    out = FOUR.triangulate(uv)
    lost = [2, 3]
    assert np.isnan(out.points_m[lost]).all()
    assert np.isnan(out.cov_m2[lost]).all()
    assert np.isnan(out.residual_px[lost]).all()
    assert np.abs(out.points_m - points)[[0, 1, 4, 5]].max() < 1e-9


@pytest.mark.parametrize("rig", [PAIR, FOUR])
def test_the_covariance_is_that_of_the_points_derivative_by_the_pixels(rig: Rig) -> None:
    points = _volume(4, 5)
    uv, cameras = _project(rig, points), len(rig.cameras)
    sigma = np.random.default_rng(1).uniform(0.05, 0.5, (cameras, 5))
    uv[-1, 2] = np.nan if cameras > 2 else uv[-1, 2]
    out, cov = rig.triangulate(uv, sigma), np.zeros((5, 3, 3))
    for c in range(cameras):
        for axis in range(2):
            high, low = uv.copy(), uv.copy()
            high[c, :, axis] += 1e-3
            low[c, :, axis] -= 1e-3
            derivative = (rig.triangulate(high, sigma).points_m - rig.triangulate(low, sigma).points_m) / 2e-3
            cov += np.where(np.isnan(uv[c, :, 0]), 0.0, sigma[c] ** 2)[:, None, None] * (
                derivative[:, :, None] * derivative[:, None, :]
            )
    np.testing.assert_allclose(out.cov_m2, cov, rtol=1e-4, atol=1e-12)


def test_depth_noise_at_half_a_metre_by_hand() -> None:
    # parallel pair: sigma_D = sqrt(2) D^2 / (f B) sigma = 1.414 * 0.25 / (503 * 0.075) * 0.1 px = 0.94 mm
    rig = Rig.of(
        *[
            CameraModel(MATRIX, np.zeros(5), rigid(np.eye(3), np.array([x, 0, 0])), 640, 480, 0.0)
            for x in (0, 0.075)
        ]
    )
    out = rig.triangulate(_project(rig, np.array([[0.0375, 0.0, 0.5]])), sigma_px=0.1)
    assert np.sqrt(out.cov_m2[0, 2, 2]) * 1e3 == pytest.approx(0.937, abs=0.01)


def test_equals_full_least_squares_on_noisy_pixels() -> None:
    rng = np.random.default_rng(8)
    points = _volume(5, 8)
    uv = _project(FOUR, points) + rng.normal(0.0, 0.3, (4, 8, 2))
    out = FOUR.triangulate(uv, sigma_px=0.3)
    for m in range(8):

        def residual(x: Float, m: int = m) -> Float:
            return (_project(FOUR, x[None])[:, 0] - uv[:, m]).ravel()

        best = least_squares(residual, points[m], x_scale=0.01, xtol=1e-12, ftol=1e-12)
        assert np.abs(out.points_m[m] - best.x).max() < 1e-8
        rms = np.sqrt((best.fun**2).sum() / 4)
        assert out.residual_px[m] == pytest.approx(rms, rel=1e-6)


def test_weights_trust_the_better_camera() -> None:
    points = _volume(2, 1)
    uv = _project(FOUR, points)
    uv[3] += 5.0
    sigma = np.array([[0.1], [0.1], [0.1], [50.0]])
    trusted, even = FOUR.triangulate(uv, sigma), FOUR.triangulate(uv, 0.1)
    assert np.linalg.norm(trusted.points_m - points) < 1e-5 < np.linalg.norm(even.points_m - points)
    assert even.residual_px[0] > 1.0


def test_parallel_diverging_and_behind_are_nan_not_far_away() -> None:
    rig = Rig.of(*[_camera(0.0), _camera(0.075)])
    same = np.full((2, 3, 2), [319.5, 239.5])  # parallel: same pixel in parallel cameras
    same[0, 1, 0] -= 20.0  # diverging: meets behind the cameras
    same[0, 2, 0] += 60.0  # meets in front
    out = rig.triangulate(same)
    assert np.isnan(out.points_m).all(axis=1).tolist() == [True, True, False]
    assert out.points_m[2, 2] == pytest.approx(503 * 0.075 / 60, rel=1e-2)
    # one and the same camera twice determines nothing
    twice = Rig.of(*[_camera(0.0), _camera(0.0)])
    assert np.isnan(twice.triangulate(_project(twice, _volume(3, 20))).points_m).all()


def test_moving_the_rig_moves_the_points() -> None:
    points = _volume(6, 5)
    T = rigid(axis_rotation(0, 1.1) @ axis_rotation(2, -2.0), np.array([3.0, -1.0, 2.0]))
    moved = Rig.of(
        *[CameraModel(c.matrix, c.distortion, T @ c.T_rig_camera, 640, 480, 0.0) for c in PAIR.cameras]
    )
    uv = _project(PAIR, points) + np.random.default_rng(1).normal(0, 0.2, (2, 5, 2))
    a, b = PAIR.triangulate(uv), moved.triangulate(uv)
    assert b.points_m == pytest.approx(a.points_m @ T[:3, :3].T + T[:3, 3], abs=1e-9)
    assert b.cov_m2 == pytest.approx(T[:3, :3] @ a.cov_m2 @ T[:3, :3].T, rel=1e-6, abs=1e-14)


def test_wrong_calls_are_refused() -> None:
    with pytest.raises(ValueError, match="two cameras"):
        triangulate(CameraArrays.of([_camera(0.0)]), np.zeros((1, 6, 2)))
    with pytest.raises(ValueError, match="two cameras"):
        RayTriangulator([_camera(0.0)], CapTables.flat(6))
    with pytest.raises(ValueError, match=r"must be \(2, M, 2\)"):
        PAIR.triangulate(np.zeros((3, 6, 2)))


# -- do the rays meet? ---------------------------------------------------------------------------------------------

LEVEL = Rig.of(*camera_models(rig_file()).values())
THREE = Rig.of(*camera_models(rig_file(("left", "right", "top"))).values())


def test_the_limit_of_two_cameras_is_4_9_sigmas_and_one_camera_has_none() -> None:
    assert limits_of(3)[:2].tolist() == [np.inf, np.inf]
    assert np.sqrt(limits_of(3)[2]) == pytest.approx(4.8916, abs=1e-4)  # two-sided normal, one in a million
    assert limits_of(3)[3] == pytest.approx(30.665, abs=1e-3)  # three degrees


@pytest.mark.parametrize(("rig", "degrees"), [(LEVEL, 1), (THREE, 3)])
def test_noise_gives_the_distribution_the_limit_is_made_of(rig: Rig, degrees: int) -> None:
    rng = np.random.default_rng(5)
    exact = _project(rig, rng.uniform([-0.1, -0.1, 0.4], [0.15, 0.1, 0.6], (4000, 3)))
    found = rig.triangulate(exact + rng.normal(0.0, np.hypot(0.3, RAYS.rig_px), exact.shape), 0.3)
    assert found.chi_square.mean() == pytest.approx(degrees, rel=0.08)
    assert (found.chi_square > chi2.isf(0.01, degrees)).mean() == pytest.approx(0.01, abs=0.006)
    assert not found.outliers.any()


def test_a_camera_that_sees_something_else_is_distinguished_from_noise() -> None:
    uv = _project(LEVEL, np.tile([0.02, 0.01, 0.5], (3, 1)))
    uv[1, :, 1] += [0.0, 5.0, 7.0]  # limit: 4.9 sqrt(2 (0.1^2 + 0.85^2)) = 5.9 px
    assert LEVEL.triangulate(uv).outliers.tolist() == [False, False, True]
    assert not LEVEL.triangulate(uv, 2.0).outliers.any()


def test_a_marker_of_one_camera_has_neither_point_nor_residual_and_is_no_outlier() -> None:
    uv = np.full((2, 1, 2), np.nan)
    uv[0, 0] = 320.0, 240.0
    found = LEVEL.triangulate(uv, np.where(np.isnan(uv[..., 0]), np.nan, 0.1))
    assert np.isnan(found.chi_square).all()
    assert np.isnan(found.points_m).all()
    assert not found.outliers.any()


def test_more_cameras_and_better_ones_make_a_point_surer() -> None:
    rig = Rig.of(*camera_models(rig_file(("a", "b", "c", "d"))).values())
    uv = _project(rig, np.tile([0.1, 0.02, 0.5], (6, 1)))
    sd: list[float] = []
    for cameras in (2, 3, 4):
        some = np.where(np.arange(4)[:, None, None] < cameras, uv, np.nan)
        sd.append(float(np.sqrt(rig.triangulate(some).cov_m2[0, 2, 2])))
    assert sd[0] > sd[1] > sd[2]
    vague = np.full((4, 6), 0.1)
    vague[2:] = 50.0  # two that hardly measure anything: as good as two cameras
    assert np.sqrt(rig.triangulate(uv, vague).cov_m2[0, 2, 2]) == pytest.approx(sd[0], rel=0.01)


def test_what_a_calibration_leaves_is_part_of_the_covariance_and_not_of_the_gate() -> None:
    uv = _project(LEVEL, _volume(3, 6)) + np.random.default_rng(2).normal(0.0, 0.1, (2, 6, 2))
    exact, real = LEVEL.triangulate(uv), triangulate(LEVEL.arrays, uv, 0.1, 0.3)
    np.testing.assert_allclose(real.cov_m2, exact.cov_m2 * (0.1**2 + 0.3**2) / 0.1**2, rtol=1e-6)
    np.testing.assert_allclose(real.chi_square, exact.chi_square, rtol=1e-9)  # that has its own allowance
