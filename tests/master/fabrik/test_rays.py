"""Tests of covariances: what noise, tilt, calibration and depth laws contribute, against worked numbers and spread."""

from dataclasses import replace

import numpy as np
import pytest

from common.arrays import Float
from common.calibration import Provenance
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rigid
from common.hand.model import TIPS, HandJoints
from master.estimator.epoch import MarkerPositions, SolvedHand
from master.fabrik.caps import CapTables
from master.fabrik.depth import CalibrationResidual
from master.fabrik.rays import RayTriangulator
from master.fabrik.settings import CAPS
from tests.hand_helpers import (
    MARKERS,
    RIGHT,
    camera_models,
    cap_areas_px2,
    cap_bias_px,
    natural_angles,
    palm,
    rig_file,
)

RIG = rig_file()
CAMERAS = tuple(camera_models(RIG).values())
FOUR = tuple(camera_models(rig_file(("a", "b", "c", "d"))).values())
TABLES = CapTables.of(RIGHT, MARKERS)
UNSTATED = np.full((2, 6), np.nan)  # px^2: without areas nothing is known to be hidden
SIGMA = np.full((2, 6), 0.1)


def hand(tilt_rad: float, joints: HandJoints | None = None) -> SolvedHand:
    """A hand whose finger ends are unsure by `tilt_rad` each way across."""
    joints = RIGHT.forward(palm(), np.radians(np.full((5, 4), 20.0))) if joints is None else joints
    ends = joints.rotation[TIPS]
    tilt = tilt_rad**2 * (np.eye(3) - ends[:, :, 2:] @ ends[:, :, 2:].swapaxes(1, 2))
    nothing = np.zeros((26, 3, 3))
    process_noise = 100.0 * np.trace(tilt, axis1=1, axis2=2)
    return SolvedHand(palm(), np.zeros((5, 4)), joints, nothing, tilt, process_noise)


def correct_centres(
    known: SolvedHand | None,
    uv: Float,
    age_s: float = 0.0,
    sigma_px: Float = SIGMA,
    area_px2: Float = UNSTATED,
) -> MarkerPositions:
    return RayTriangulator(CAMERAS, TABLES)(uv, sigma_px, area_px2, known, age_s)


def seen(joints: HandJoints) -> tuple[Float, Float]:
    """Cap centroids (6, 3) and what the cameras see of them (2, 6, 2)."""
    points = RIGHT.marker_points(joints, MARKERS)
    return points, np.stack([c.project(points) for c in CAMERAS]) + cap_bias_px(joints, points, CAMERAS)


def centroid_errors(rng: np.random.Generator, sigma_px: float = 0.1) -> Float:
    """Errors (2, 6, 2) [px], three quarters of whose variance are the same in both cameras."""
    alike, own = rng.normal(0.0, sigma_px, (1, 6, 2)), rng.normal(0.0, sigma_px, (2, 6, 2))
    return np.sqrt(0.75) * alike + np.sqrt(0.25) * own


def test_a_known_hand_gives_its_caps_back() -> None:
    known = hand(0.0)
    points, uv = seen(known.joints)
    found = correct_centres(known, uv)
    np.testing.assert_allclose(
        found.points_m, points, atol=2e-4
    )  # caps are looked at from where they roughly are
    assert not found.outliers.any()


def test_the_covariance_is_the_spread_of_the_errors_that_unsure_tilts_make() -> None:
    rng = np.random.default_rng(5)
    sd, estimated = 0.1, hand(0.1)
    tilts = rng.normal(0.0, sd, (1500, 5, 2))
    _, uv = seen(estimated.joints)
    truth = RIGHT.marker_points(estimated.joints, MARKERS)
    errors: list[Float] = []
    for tilt in tilts:
        rotation = estimated.joints.rotation.copy()
        R = rotation[TIPS]
        ahead = -R[:, :, 2] + np.einsum("kij,kj->ki", R[:, :, :2], tilt)
        rotation[TIPS, :, 2] = -ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        _, uv = seen(replace(estimated.joints, rotation=rotation))
        errors.append(correct_centres(estimated, uv + centroid_errors(rng)).points_m - truth)
    spread = np.array(errors)
    cov = correct_centres(estimated, seen(estimated.joints)[1]).cov_m2
    for m in range(5):
        nees = np.einsum("ni,ij,nj->n", spread[:, m], np.linalg.inv(cov[m]), spread[:, m])
        assert 0.90 < (nees < 7.815).mean() <= 1.0, MARKERS[m]
        sd_m = np.sqrt(np.diag(np.cov(spread[:, m].T)))
        assert (np.sqrt(np.diag(cov[m])) < 1.6 * sd_m + 1e-4).all(), MARKERS[m]


def test_errors_that_cameras_have_alike_move_a_point_and_not_its_depth() -> None:
    rng = np.random.default_rng(3)
    known = hand(0.0)
    _, uv = seen(known.joints)
    found = np.array([correct_centres(known, uv + centroid_errors(rng)).points_m for _ in range(2000)])
    claimed = correct_centres(known, uv).cov_m2 - correct_centres(known, uv, 0.0, 1e-3 * SIGMA).cov_m2
    spread = np.array([np.cov(found[:, m].T) for m in range(6)])
    np.testing.assert_allclose(
        np.diagonal(claimed, axis1=1, axis2=2), np.diagonal(spread, axis1=1, axis2=2), rtol=0.12
    )
    # Depth is sure to half of what each camera's own errors would make of it: a quarter of the variance.
    np.testing.assert_allclose(
        claimed[:, 2, 2], 0.25 * correct_centres(known, uv).noise_m2[:, 2, 2], rtol=0.2
    )


def test_cameras_share_nothing_of_a_cap_that_is_partly_hidden() -> None:
    known = hand(0.0)
    uv, area = seen(known.joints)[1], cap_areas_px2(known.joints, CAMERAS)
    area[:, 5] = np.nan
    covered = area.copy()
    covered[1, 3] *= 0.5
    before, after = (correct_centres(known, uv, 0.0, SIGMA, seen_px2) for seen_px2 in (area, covered))
    assert (before.cov_m2 - before.noise_m2)[3, 2, 2] < 0.0
    assert (after.cov_m2 - after.noise_m2)[3, 2, 2] > 0.0
    np.testing.assert_allclose(np.delete(after.cov_m2, 3, axis=0), np.delete(before.cov_m2, 3, axis=0))


@pytest.mark.parametrize("cameras", [CAMERAS, FOUR])
def test_covariances_stay_positive_whoever_sees_a_marker_and_however_surely(
    cameras: tuple[CameraModel, ...],
) -> None:
    rng = np.random.default_rng(8)
    locator = RayTriangulator(cameras, TABLES)
    points = RIGHT.marker_points(hand(0.0).joints, MARKERS)
    for _ in range(100):
        uv = np.stack([camera.project(points) for camera in cameras])
        uv[rng.random(uv.shape[:2]) < 0.2] = np.nan
        sigma = np.where(np.isnan(uv[..., 0]), np.nan, 10.0 ** rng.uniform(-2.0, 1.0, uv.shape[:2]))
        found = locator(uv, sigma, np.full(sigma.shape, np.nan), hand(0.0), 0.0)
        triangulated = np.isfinite(found.points_m[:, 0])
        assert (np.linalg.eigvalsh(found.cov_m2[triangulated]) > 0.0).all()
        np.testing.assert_array_equal(triangulated, np.isfinite(found.cov_m2).all(axis=(1, 2)))


def test_an_unsure_pose_widens_most_along_the_sight_and_age_adds_to_it() -> None:
    _, uv = seen(hand(0.0).joints)
    sure, unsure = correct_centres(hand(0.0), uv), correct_centres(hand(0.2), uv)
    more = np.sqrt(np.diagonal(unsure.cov_m2 - sure.cov_m2, axis1=1, axis2=2)[:5])
    assert (more[:, 2] > 2.0 * more[:, :2].max(axis=1)).all()
    old, rotated = correct_centres(hand(0.0), uv, 0.02), correct_centres(hand(0.02 * CAPS.rotation_rad_s), uv)
    size = [np.trace(found.cov_m2[:5] - sure.cov_m2[:5], axis1=1, axis2=2) for found in (old, rotated)]
    np.testing.assert_allclose(*size, rtol=0.05)


def test_without_a_hand_a_cap_may_point_anywhere() -> None:
    rng = np.random.default_rng(2)
    inside: list[bool] = []
    for _ in range(80):
        joints = RIGHT.forward(palm(rng.uniform(-30, 30, 3)), natural_angles(rng))
        points, uv = seen(joints)
        found = correct_centres(None, uv)
        off = (found.points_m - points)[:5]
        nees = np.vecdot(off, np.linalg.solve(found.cov_m2[:5], off[..., None])[..., 0])
        eye = points[:5] / np.linalg.norm(points[:5], axis=1, keepdims=True)
        shown = np.vecdot(-joints.rotation[TIPS][:, :, 2], eye) < np.cos(
            np.radians(45.0)
        )  # bent away by 135 at most
        inside += list(nees[shown] < 7.815)
    assert len(inside) > 100
    assert np.mean(inside) > 0.9


def provenance(**residual: float) -> Provenance:
    return Provenance(date="2026-11-21T12:00:00Z", tool="test", data=("here",), residual=residual)


def test_what_a_calibration_leaves_is_what_its_file_states() -> None:
    rig = rig_file(provenance={"T_rig_camera": provenance(rms_px=0.3)})
    assert CalibrationResidual.of(RIG) == CalibrationResidual()
    left = CalibrationResidual.of(rig)
    assert left == CalibrationResidual(rays_px=0.3)


def test_points_and_covariances_turn_with_the_rig() -> None:
    rotation = rigid(palm(np.array([30.0, -20.0, 70.0]))[:3, :3], np.array([1.0, 2.0, 3.0]))
    moved = tuple(replace(c, T_rig_camera=rotation @ c.T_rig_camera) for c in CAMERAS)
    known, R = hand(0.1), rotation[:3, :3]
    joints = replace(known.joints, rotation=R @ known.joints.rotation)
    rotated = replace(known, joints=joints, tilt_cov_rad2=R @ known.tilt_cov_rad2 @ R.T)
    uv = seen(known.joints)[1]
    here, there = (
        correct_centres(known, uv),
        RayTriangulator(moved, TABLES)(uv, SIGMA, UNSTATED, rotated, 0.0),
    )
    np.testing.assert_allclose(there.points_m, here.points_m @ R.T + rotation[:3, 3], atol=1e-9)
    np.testing.assert_allclose(there.cov_m2, R @ here.cov_m2 @ R.T, rtol=1e-6, atol=1e-12)


def test_what_is_seen_of_a_flat_marker_is_its_centroid_within_the_relief() -> None:
    points, uv = seen(hand(0.0).joints)
    found = correct_centres(hand(0.3), uv)
    np.testing.assert_allclose(found.points_m[5], points[5], atol=1e-9)
    np.testing.assert_allclose(
        found.cov_m2[5] - found.noise_m2[5], correct_centres(hand(0.0), uv).cov_m2[5] - found.noise_m2[5]
    )


def test_as_seen_the_correction_is_uncertainty_alone() -> None:
    _, uv = seen(hand(0.0).joints)
    place = RayTriangulator(CAMERAS, TABLES)
    found, corrected = (place(uv, SIGMA, UNSTATED, None, 0.0, as_seen=flag) for flag in (True, False))
    plain = place.triangulate(uv, 0.1)
    np.testing.assert_allclose(found.points_m, plain.points_m, atol=1e-7)
    moved = np.linalg.norm(corrected.points_m - found.points_m, axis=1)[:5]
    assert (moved > 1e-3).all()
    assert (np.sqrt(np.trace(found.cov_m2[:5], axis1=1, axis2=2)) > moved).all()


def test_nan_stays_with_its_own_marker_and_camera() -> None:
    known, place = hand(0.1), RayTriangulator(FOUR, TABLES)
    points = RIGHT.marker_points(known.joints, MARKERS)
    uv = np.stack([c.project(points) for c in FOUR])
    sigma, area = np.full((4, 6), 0.1), cap_areas_px2(known.joints, FOUR)
    whole = place(uv, sigma, area, known, 0.0)
    uv[:, 1] = np.nan
    uv[1:, 2] = np.nan
    uv[0, 3, 1] = np.nan
    sigma[2, 4] = np.nan
    found = place(uv, sigma, area, known, 0.0)
    assert np.isnan(found.points_m).all(axis=1).tolist() == [False, True, True, False, False, False]
    assert np.isnan(found.cov_m2).any(axis=(1, 2)).tolist() == [False, True, True, False, False, False]
    assert not found.outliers.any()
    np.testing.assert_array_equal(found.points_m[[0, 5]], whole.points_m[[0, 5]])
    assert np.abs(found.points_m - whole.points_m)[[3, 4]].max() < 1e-3


def test_the_camera_that_sees_less_of_a_cap_counts_less() -> None:
    known = hand(0.0)
    uv, area = seen(known.joints)[1], cap_areas_px2(known.joints, CAMERAS)
    uv[1, 3, 1] += 4.0
    covered = area.copy()
    covered[1, 3] *= 0.4
    even, uneven = (correct_centres(known, uv, 0.0, SIGMA, px2) for px2 in (area, covered))
    rows = [np.stack([c.project(found.points_m[3]) for c in CAMERAS])[:, 1] for found in (even, uneven)]
    wanted = uv[0, 3, 1] - cap_bias_px(known.joints, even.points_m, CAMERAS)[0, 3, 1]
    assert abs(rows[1][0] - wanted) < 0.1 * abs(rows[0][0] - wanted)


def example() -> list[list[float]]:
    """Points, covariances and flags of markers that four cameras see, some wrongly, in three kinds of call."""
    known, rng, found = hand(0.1), np.random.default_rng(12), list[list[float]]()
    points = RIGHT.marker_points(known.joints, MARKERS)
    place = RayTriangulator(FOUR, TABLES, 0.2)
    uv = np.stack([c.project(points) for c in FOUR]) + rng.normal(0.0, 0.1, (4, 6, 2))
    uv[1, 2] += [0.0, 30.0]
    uv[:3, 4] = np.nan
    sigma, area = np.full((4, 6), 0.1), cap_areas_px2(known.joints, FOUR) * rng.uniform(0.4, 1.0, (4, 6))
    for one, as_seen in ((known, False), (None, False), (None, True)):
        out = place(uv, sigma, area, one, 0.02, as_seen=as_seen)
        for values in (out.points_m, 1e3 * out.cov_m2, 1e3 * out.noise_m2, out.outliers, out.rejected):
            found.append(values.ravel().astype(np.float64).tolist())
    return found
