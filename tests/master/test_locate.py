"""Tests of covariances: what noise, tilt, calibration and depth laws contribute, against worked numbers and spread."""

from dataclasses import replace

import numpy as np
import pytest

from common.arrays import Float
from common.calibration import Provenance
from common.camera_model import CameraModel
from common.geometry import rigid
from common.hand_model import TIPS, HandJoints
from master.ik.hand import HandSolution
from master.stereo.caps import TURN_RAD_S, CapModel
from master.stereo.locate import CapLocator, Located
from master.stereo.place import CalibrationResidual, Placement
from tests.hand_helpers import MARKERS, RIGHT, camera_models, natural_angles, palm, rig_file

RIG = rig_file()
CAMERAS = tuple(camera_models(RIG).values())
FOUR = tuple(camera_models(rig_file(("a", "b", "c", "d"))).values())
CAPS = CapModel(RIGHT, MARKERS)
UNSTATED = np.full((2, 6), np.nan)  # px^2: without areas nothing is known to be hidden
SIGMA = np.full((2, 6), 0.1)


def hand(tilt_rad: float, joints: HandJoints | None = None) -> HandSolution:
    """A hand whose finger ends are unsure by `tilt_rad` each way across."""
    joints = RIGHT.forward(palm(), np.radians(np.full((5, 4), 20.0))) if joints is None else joints
    ends = joints.rotation[TIPS]
    tilt = tilt_rad**2 * (np.eye(3) - ends[:, :, 2:] @ ends[:, :, 2:].swapaxes(1, 2))
    nothing = np.zeros((26, 3, 3))
    fitted = np.zeros(6), 0.0, 1, 1.0, np.eye(22), np.zeros((26, 3, 22))
    return HandSolution(palm(), np.zeros((5, 4)), joints, nothing, tilt, 100.0 * tilt, *fitted)


def locate(
    known: HandSolution | None, uv: Float, age_s: float = 0.0, place: Placement | None = None
) -> Located:
    locator = CapLocator(CAMERAS, CAPS, place or Placement(CAMERAS))
    return locator(uv, SIGMA, UNSTATED, known, age_s)


def seen(joints: HandJoints) -> tuple[Float, Float]:
    """Cap centroids (6, 3) and what the cameras see of them (2, 6, 2)."""
    points = RIGHT.marker_points(joints, MARKERS)
    return points, np.stack([c.project(points) for c in CAMERAS]) + CAPS.bias_px(joints, points, CAMERAS)


def centroid_errors(rng: np.random.Generator, sigma_px: float = 0.1) -> Float:
    """Errors (2, 6, 2) [px], three quarters of whose variance are the same in both cameras."""
    alike, own = rng.normal(0.0, sigma_px, (1, 6, 2)), rng.normal(0.0, sigma_px, (2, 6, 2))
    return np.sqrt(0.75) * alike + np.sqrt(0.25) * own


def test_a_known_hand_gives_its_caps_back() -> None:
    known = hand(0.0)
    points, uv = seen(known.joints)
    found = locate(known, uv)
    np.testing.assert_allclose(
        found.points_m, points, atol=2e-4
    )  # caps are looked at from where they roughly are
    assert not found.apart.any()
    np.testing.assert_allclose(found.repeated, 0.0, atol=1e-15)


def test_the_covariance_is_the_spread_of_the_errors_that_unsure_tilts_make() -> None:
    rng = np.random.default_rng(5)
    sd, believed = 0.1, hand(0.1)
    tilts = rng.normal(0.0, sd, (1500, 5, 2))
    _, uv = seen(believed.joints)
    truth = RIGHT.marker_points(believed.joints, MARKERS)
    errors: list[Float] = []
    for tilt in tilts:
        rotation = believed.joints.rotation.copy()
        R = rotation[TIPS]
        ahead = -R[:, :, 2] + np.einsum("kij,kj->ki", R[:, :, :2], tilt)
        rotation[TIPS, :, 2] = -ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        _, uv = seen(replace(believed.joints, rotation=rotation))
        errors.append(locate(believed, uv + centroid_errors(rng)).points_m - truth)
    spread = np.array(errors)
    cov = locate(believed, seen(believed.joints)[1]).cov_m2
    for m in range(5):
        nees = np.einsum("ni,ij,nj->n", spread[:, m], np.linalg.inv(cov[m]), spread[:, m])
        assert 0.90 < (nees < 7.815).mean() <= 1.0, MARKERS[m]
        sd_m = np.sqrt(np.diag(np.cov(spread[:, m].T)))
        assert (np.sqrt(np.diag(cov[m])) < 1.6 * sd_m + 1e-4).all(), MARKERS[m]


def test_errors_that_cameras_have_alike_move_a_point_and_not_its_depth() -> None:
    rng = np.random.default_rng(3)
    known = hand(0.0)
    _, uv = seen(known.joints)
    found = np.array([locate(known, uv + centroid_errors(rng)).points_m for _ in range(2000)])
    locator = CapLocator(CAMERAS, CAPS, Placement(CAMERAS))
    claimed = locate(known, uv).cov_m2 - locator(uv, 1e-3 * SIGMA, UNSTATED, known, 0.0).cov_m2
    spread = np.array([np.cov(found[:, m].T) for m in range(6)])
    np.testing.assert_allclose(
        np.diagonal(claimed, axis1=1, axis2=2), np.diagonal(spread, axis1=1, axis2=2), rtol=0.12
    )
    # Depth is sure to half of what each camera's own errors would make of it: a quarter of the variance.
    np.testing.assert_allclose(claimed[:, 2, 2], 0.25 * locate(known, uv).noise_m2[:, 2, 2], rtol=0.2)


def test_cameras_share_nothing_of_a_cap_that_is_partly_hidden() -> None:
    known = hand(0.0)
    points, uv = seen(known.joints)
    whole = CAPS.look(-known.joints.rotation[TIPS][None, :, :, 2], points, CAMERAS).whole_m2[0]
    away = np.stack([np.linalg.norm(points - camera.centre, axis=1) for camera in CAMERAS])
    area = whole * (500.0 / away) ** 2
    area[:, 5] = np.nan
    covered = area.copy()
    covered[1, 3] *= 0.5
    locator = CapLocator(CAMERAS, CAPS, Placement(CAMERAS))
    before, after = (locator(uv, SIGMA, seen_px2, known, 0.0) for seen_px2 in (area, covered))
    assert (before.cov_m2 - before.noise_m2)[3, 2, 2] < 0.0
    assert (after.cov_m2 - after.noise_m2)[3, 2, 2] > 0.0
    np.testing.assert_allclose(np.delete(after.cov_m2, 3, axis=0), np.delete(before.cov_m2, 3, axis=0))


@pytest.mark.parametrize("cameras", [CAMERAS, FOUR])
def test_covariances_stay_positive_whoever_sees_a_marker_and_however_surely(
    cameras: tuple[CameraModel, ...],
) -> None:
    rng = np.random.default_rng(8)
    locator = CapLocator(cameras, CAPS, Placement(cameras))
    points = RIGHT.marker_points(hand(0.0).joints, MARKERS)
    for _ in range(100):
        uv = np.stack([camera.project(points) for camera in cameras])
        uv[rng.random(uv.shape[:2]) < 0.2] = np.nan
        sigma = np.where(np.isnan(uv[..., 0]), np.nan, 10.0 ** rng.uniform(-2.0, 1.0, uv.shape[:2]))
        found = locator(uv, sigma, np.full(sigma.shape, np.nan), hand(0.0), 0.0)
        placed = np.isfinite(found.points_m[:, 0])
        assert (np.linalg.eigvalsh(found.cov_m2[placed]) > 0.0).all()
        np.testing.assert_array_equal(placed, np.isfinite(found.cov_m2).all(axis=(1, 2)))


def test_an_unsure_pose_widens_most_along_the_sight_and_age_adds_to_it() -> None:
    _, uv = seen(hand(0.0).joints)
    sure, unsure = locate(hand(0.0), uv), locate(hand(0.2), uv)
    more = np.sqrt(np.diagonal(unsure.cov_m2 - sure.cov_m2, axis1=1, axis2=2)[:5])
    assert (more[:, 2] > 2.0 * more[:, :2].max(axis=1)).all()
    old, turned = locate(hand(0.0), uv, 0.02), locate(hand(0.02 * TURN_RAD_S), uv)
    size = [np.trace(found.cov_m2[:5] - sure.cov_m2[:5], axis1=1, axis2=2) for found in (old, turned)]
    np.testing.assert_allclose(*size, rtol=0.05)


def test_a_fit_is_told_of_the_motion_that_it_believes_in() -> None:
    """Here the fit's walk makes a variance 100 dt^2 times as large: at 0.1 s it is doubled."""
    _, uv = seen(hand(0.0).joints)
    known, age_s = hand(0.3), 0.1
    found = locate(known, uv, age_s)
    tilted = found.cov_m2 - locate(hand(0.0), uv).cov_m2
    ours = 2 * 0.3**2 + 2 * (TURN_RAD_S * age_s) ** 2
    fits = 2 * 0.3**2 + 100.0 * age_s**2 * 2 * 0.3**2
    np.testing.assert_allclose(found.repeated[:5], (fits / ours - 1.0) * tilted[:5], rtol=0.05, atol=1e-9)
    np.testing.assert_array_equal(found.repeated[5], 0.0)


def test_without_a_hand_a_cap_may_point_anywhere() -> None:
    rng = np.random.default_rng(2)
    inside: list[bool] = []
    for _ in range(80):
        joints = RIGHT.forward(palm(rng.uniform(-30, 30, 3)), natural_angles(rng))
        points, uv = seen(joints)
        found = locate(None, uv)
        off = (found.points_m - points)[:5]
        nees = np.vecdot(off, np.linalg.solve(found.cov_m2[:5], off[..., None])[..., 0])
        eye = points[:5] / np.linalg.norm(points[:5], axis=1, keepdims=True)
        shown = np.vecdot(-joints.rotation[TIPS][:, :, 2], eye) < np.cos(
            np.radians(45.0)
        )  # bent away by 135 at most
        inside += list(nees[shown] < 7.815)
    assert len(inside) > 100
    assert np.mean(inside) > 0.9


def test_more_cameras_and_better_ones_make_a_point_surer() -> None:
    points = np.tile([0.1, 0.02, 0.5], (6, 1))
    uv = np.stack([camera.project(points) for camera in FOUR])
    place = Placement(FOUR)
    sd: list[float] = []
    for cameras in (2, 3, 4):
        some = np.where(np.arange(4)[:, None, None] < cameras, uv, np.nan)
        sd.append(float(np.sqrt(place(some, np.full((4, 6), 0.1)).cov[0, 2, 2])))
    assert sd[0] > sd[1] > sd[2]
    vague = np.full((4, 6), 0.1)
    vague[2:] = 50.0  # two that hardly tell anything: as good as two cameras
    assert np.sqrt(place(uv, vague).cov[0, 2, 2]) == pytest.approx(sd[0], rel=0.01)


def provenance(**residual: float) -> Provenance:
    return Provenance(date="2026-11-21T12:00:00Z", tool="test", data=("here",), residual=residual)


def test_what_a_calibration_leaves_is_part_of_the_covariance() -> None:
    rig = rig_file(provenance={"T_rig_camera": provenance(rms_px=0.3)})
    assert CalibrationResidual.of(RIG) == CalibrationResidual()
    left = CalibrationResidual.of(rig)
    assert left == CalibrationResidual(rays_px=0.3)
    uv = seen(hand(0.0).joints)[1]
    exact, real = Placement(CAMERAS)(uv, SIGMA), Placement(CAMERAS, left)(uv, SIGMA)
    np.testing.assert_allclose(real.cov, exact.cov * (0.1**2 + 0.3**2) / 0.1**2, rtol=1e-6)
    np.testing.assert_allclose(real.misfit, exact.misfit, atol=1e-12)  # that has its own allowance


def test_covariances_turn_with_the_rig() -> None:
    turn = rigid(palm(np.array([30.0, -20.0, 70.0]))[:3, :3], np.array([1.0, 2.0, 3.0]))
    moved = tuple(replace(c, T_rig_camera=turn @ c.T_rig_camera) for c in CAMERAS)
    uv = seen(hand(0.0).joints)[1]
    here, there = Placement(CAMERAS)(uv, SIGMA).cov, Placement(moved)(uv, SIGMA).cov
    np.testing.assert_allclose(there, turn[:3, :3] @ here @ turn[:3, :3].T, rtol=1e-6, atol=1e-14)
