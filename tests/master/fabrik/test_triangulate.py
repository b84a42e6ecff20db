"""Disparity to points: exact geometry, the axis and off it, covariance by spread, caps, rows, bad input."""

import numpy as np
import pytest

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import axis_rotation, rigid
from master.estimator.epoch import SolvedHand
from master.fabrik.caps import CapTables
from master.fabrik.depth import AffineDisparity, PowerLaw, disparity_on_axis
from master.fabrik.triangulate import DepthTriangulator, disparity_tables, place_centroids
from tests.hand_helpers import MARKERS, RIGHT, cap_areas_px2, cap_bias_px, natural_angles, palm

DISTORTED = np.array([0.105, -0.21, 0.0006, -0.0009, 0.05])
SIGMA = np.full((2, 6), 0.1)
ROWS_PX, LIMIT = 1.2, 24.0


def camera(name: int, R: Float, at: tuple[float, float, float], distortion: Float) -> CameraModel:
    matrix = np.array([[500.0 + name, 0.0, 321.3 - name], [0.0, 500.0 + name, 238.1], [0.0, 0.0, 1.0]])
    return CameraModel(matrix, distortion, rigid(R, np.array(at)), 640, 480, 0.0)


EXACT = (
    camera(0, np.eye(3), (0.0, 0.0, 0.0), np.zeros(5)),
    camera(0, np.eye(3), (0.075, 0.0, 0.0), np.zeros(5)),
)
ROTATED = axis_rotation(2, 0.005) @ axis_rotation(1, -0.015)
MADE_BY_HAND = (
    camera(0, axis_rotation(0, 0.02), (0.01, 0.0, 0.0), DISTORTED),
    camera(1, axis_rotation(0, 0.025) @ ROTATED, (0.085, 0.001, 0.0), DISTORTED),
)
PINHOLE = AffineDisparity(500.0 * 0.075, 0.0)
FLAT = CapTables.flat(6)  # on no hand: what is seen of them is their centroid
CAPS = CapTables.of(RIGHT, MARKERS)


def triangulator(
    cameras: tuple[CameraModel, ...],
    law: PowerLaw | AffineDisparity = PINHOLE,
    caps: CapTables = FLAT,
    law_error: float = 0.0,
) -> DepthTriangulator:
    return DepthTriangulator(disparity_tables(cameras, law, law_error, ROWS_PX, LIMIT), caps)


def seen(cameras: tuple[CameraModel, ...], points: Float) -> Float:
    return np.stack([one.project(points) for one in cameras])


def hand(angles_rad: Float | None = None, tilt_rad: float = 0.0) -> SolvedHand:
    angles = np.radians(np.full((5, 4), 15.0)) if angles_rad is None else angles_rad
    joints = RIGHT.forward(palm(), angles)
    tilt = np.tile(tilt_rad**2 * np.eye(3), (5, 1, 1))
    return SolvedHand(palm(), angles, joints, np.zeros((26, 3, 3)), tilt, np.zeros((5, 3, 3)))


def axis_law(cameras: tuple[CameraModel, ...]) -> AffineDisparity:
    """The law that target and ruler before the middle of the pair give."""
    depth = np.linspace(0.4, 1.0, 13)
    x = disparity_on_axis(cameras, depth)
    a, x0 = np.polyfit(1.0 / depth, x, 1)
    return AffineDisparity(float(a), float(x0))


@pytest.mark.parametrize("law", [PINHOLE, PowerLaw(37.5, -1.0)])
def test_a_parallel_pair_gives_its_points_back_by_either_law(law: PowerLaw | AffineDisparity) -> None:
    points = np.random.default_rng(1).uniform([-0.15, -0.12, 0.45], [0.2, 0.12, 0.85], (6, 3))
    found = triangulator(EXACT, law)(seen(EXACT, points), SIGMA, np.full((2, 6), np.nan), None, 0.0)
    np.testing.assert_allclose(found.points_m, points, atol=1e-6)
    assert not found.outliers.any()


def test_off_the_axis_a_pair_made_by_hand_is_as_right_as_on_it() -> None:
    """Rolled, yawed, pitched and distorted: raw disparity is off by 7 mm there, what is corrected by the law alone."""
    law, rng = axis_law(MADE_BY_HAND), np.random.default_rng(2)
    place, worst, raw = triangulator(MADE_BY_HAND, law), 0.0, 0.0
    for _ in range(100):
        points = rng.uniform([-0.12, -0.12, 0.45], [0.18, 0.12, 0.85], (6, 3))
        uv = seen(MADE_BY_HAND, points)
        inside = ((uv > 0.0) & (uv < [640.0, 480.0])).all(axis=(0, 2))
        found = place(uv, SIGMA, np.full((2, 6), np.nan), None, 0.0)
        worst = max(worst, float(np.abs(found.points_m - points)[inside].max(initial=0.0)))
        z = (points - MADE_BY_HAND[0].centre) @ MADE_BY_HAND[0].T_rig_camera[:3, 2]
        raw = max(raw, float(np.abs(law.depth(uv[0, :, 0] - uv[1, :, 0]) - z)[inside].max(initial=0.0)))
        assert not found.outliers[inside].any()
    assert worst < 2e-3
    assert raw > 6e-3


def test_the_covariance_is_the_spread_of_the_centroids_noise() -> None:
    rng, points = np.random.default_rng(3), np.tile([0.08, -0.06, 0.6], (6, 1))
    place, uv = triangulator(MADE_BY_HAND, axis_law(MADE_BY_HAND)), seen(MADE_BY_HAND, points)
    sigma = np.stack([np.full(6, 0.1), np.full(6, 0.3)])
    nothing = np.full((2, 6), np.nan)
    noisy = [uv + sigma[..., None] * rng.normal(size=uv.shape) for _ in range(2000)]
    spread = np.concatenate([place(one, sigma, nothing, None, 0.0).points_m for one in noisy])
    claimed = place(uv, sigma, nothing, None, 0.0).noise_m2[0]
    np.testing.assert_allclose(claimed, np.cov(spread.T), rtol=0.05, atol=3e-9)


def test_what_the_fit_of_the_law_left_is_part_of_the_covariance_along_the_sight() -> None:
    points, nothing = np.tile([0.0, 0.0, 0.5], (6, 1)), np.full((2, 6), np.nan)
    sure, rough = (
        triangulator(EXACT, law_error=e)(seen(EXACT, points), SIGMA, nothing, None, 0.0) for e in (0.0, 0.02)
    )
    np.testing.assert_allclose((rough.cov_m2 - sure.cov_m2)[0], np.diag([0.0, 0.0, 0.01**2]), atol=1e-12)
    np.testing.assert_array_equal(rough.noise_m2, sure.noise_m2)


def test_caps_of_a_known_hand_are_where_it_has_them() -> None:
    known = hand(natural_angles(np.random.default_rng(4)))
    points = RIGHT.marker_points(known.joints, MARKERS)
    uv = seen(EXACT, points) + cap_bias_px(known.joints, points, EXACT)
    whole = cap_areas_px2(known.joints, EXACT)
    warm_start = triangulator(EXACT, caps=CAPS)(uv, SIGMA, whole, known, 0.0)
    blind = triangulator(EXACT, caps=CAPS)(uv, SIGMA, whole, None, 0.0)
    assert np.linalg.norm(warm_start.points_m - points, axis=1).max() < 2e-4
    assert np.linalg.norm(blind.points_m - points, axis=1)[:5].max() > 2e-3


def test_a_hand_that_points_elsewhere_is_covered_by_what_its_tilt_is_unsure_by() -> None:
    rng, squared = np.random.default_rng(5), list[float]()
    place, tilt = triangulator(EXACT, caps=CAPS), np.radians(10.0)
    for _ in range(60):
        angles = natural_angles(rng)
        true = hand(angles)
        points = RIGHT.marker_points(true.joints, MARKERS)
        uv = seen(EXACT, points) + cap_bias_px(true.joints, points, EXACT)
        estimated = hand(RIGHT.clamp(angles + rng.normal(0.0, tilt / np.sqrt(3.0), (5, 4))), tilt)
        found = place(uv, SIGMA, cap_areas_px2(true.joints, EXACT), estimated, 0.0)
        off = (found.points_m - points)[:5]
        squared += np.vecdot(off, np.linalg.solve(found.cov_m2[:5], off[..., None])[..., 0]).tolist()
    assert 0.9 < np.mean(np.array(squared) < 7.81)


def test_rows_that_disagree_are_two_things() -> None:
    points = np.tile([0.05, 0.02, 0.6], (6, 1))
    uv = seen(EXACT, points)
    uv[1, :, 1] += [0.0, 3.0, -3.0, 10.0, -10.0, 40.0]
    found = triangulator(EXACT)(uv, SIGMA, np.full((2, 6), np.nan), None, 0.0)
    assert found.outliers.tolist() == [False, False, False, True, True, True]
    assert np.isnan(found.points_m).all(axis=1).tolist() == found.outliers.tolist()


def test_what_is_not_seen_or_has_no_depth_is_nan_and_nothing_raises() -> None:
    uv = seen(EXACT, np.tile([0.0, 0.0, 0.6], (6, 1)))
    uv[0, 0] = np.nan
    uv[1, 1, 0] = np.nan
    uv[1, 2, 0] = uv[0, 2, 0] + 5.0  # behind the cameras
    uv[1, 3, 0] = uv[0, 3, 0]  # infinitely far
    uv[0, 4] = 1e9
    with np.errstate(all="raise"):
        for law in (PINHOLE, PowerLaw(37.5, -1.0)):
            found = triangulator(EXACT, law)(uv, SIGMA, np.full((2, 6), np.nan), hand(), 0.0)
            assert np.isnan(found.points_m[:4]).all()
            assert np.isfinite(found.points_m[5]).all()
            assert (
                np.isnan(found.points_m).any(axis=1).tolist()
                == np.isnan(found.cov_m2).any(axis=(1, 2)).tolist()
            )


def test_a_centroid_beyond_the_picture_uses_the_last_cell() -> None:
    tables, ray, point = disparity_tables(EXACT, PINHOLE, 0.0, ROWS_PX, LIMIT), np.empty(3), np.empty(3)
    z, rows = place_centroids(tables, -50.0, 600.0, -110.0, 600.0, ray, point)
    assert z == pytest.approx(37.5 / 60.0, rel=1e-6)
    assert rows == pytest.approx(0.0, abs=1e-6)
