"""Depth laws: the published table, the ideal pinhole pair, misalignment, and the error budget."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration import AffineDisparityCalibration, PowerLawCalibration, RigCalibration
from common.camera_model import CameraModel
from common.errors import CalibrationError
from common.geometry import axis_rotation, rigid
from master.stereo.depth import (
    AffineDisparity,
    DepthLaw,
    PowerLaw,
    depth_law,
    error_budget,
    ideal_law,
    position_at_depth,
    tolerable_skew_s,
)

KALBFLEISCH = PowerLaw(k_m=45.433, z=-1.035)
FOV_RAD = np.radians(62.5)
LAWS = [KALBFLEISCH, AffineDisparity(37.7, 2.5), ideal_law(0.075, FOV_RAD, 640)]
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def test_the_published_table_to_a_hundredth_of_a_pixel() -> None:
    depth = np.array([0.20, 0.30, 0.40, 0.50, 0.60, 0.70, 0.80, 0.90, 1.00])
    published = np.array([189.09, 127.80, 96.79, 78.01, 65.41, 56.36, 49.54, 44.21, 39.93])
    assert np.abs(KALBFLEISCH.disparity(depth) - published).max() < 0.01
    assert np.abs(KALBFLEISCH.depth(published) - depth).max() < 1e-4


def test_ideal_pair_by_hand() -> None:
    # f = 320 / tan(31.25 deg) = 527.3 px; 0.075 m * 527.3 px = 39.55 px at 1 m
    law = ideal_law(0.075, FOV_RAD, 640)
    assert law.a_m_px == pytest.approx(0.075 * 527.35, abs=2e-3)
    assert float(law.disparity(np.array(1.0))) == pytest.approx(39.55, abs=0.005)
    assert 62.5 / 640 == pytest.approx(0.0977, abs=5e-5)


def test_one_pixel_costs_what_i4_says() -> None:
    law = ideal_law(0.075, FOV_RAD, 640)
    at_one = error_budget(law, 1.0, 0.075, sigma_px=0.1, speed_m_s=1.0, skew_s=0.0)
    at_half = error_budget(law, 0.5, 0.075, sigma_px=0.1, speed_m_s=1.0, skew_s=0.0167)
    assert at_one.per_pixel_m == pytest.approx(0.0253, abs=5e-5)
    assert at_half.per_pixel_m == pytest.approx(0.0063, abs=5e-5)
    assert at_half.centroid_m < 0.001  # 0.1 px stays under 1 mm at 50 cm
    assert at_half.sync_m == pytest.approx(0.11, abs=0.002)  # 11 cm
    assert at_one.sync_m == 0.0


def test_two_per_cent_at_a_metre_per_second_needs_a_millisecond_and_a_half() -> None:
    skew = tolerable_skew_s(0.02, 0.075, 1.0)
    assert skew == pytest.approx(1.5e-3)
    for depth in (0.2, 1.0):
        law = ideal_law(0.075, FOV_RAD, 640)
        budget = error_budget(law, depth, 0.075, sigma_px=0.1, speed_m_s=1.0, skew_s=skew)
        assert budget.sync_m == pytest.approx(0.02 * depth)


@pytest.mark.parametrize("law", LAWS)
@given(depth=st.floats(0.1, 5.0))
def test_round_trip_and_slope(law: DepthLaw, depth: float) -> None:
    d = np.array([depth])
    x = law.disparity(d)
    assert law.depth(x) == pytest.approx(d, rel=1e-12)
    h = 1e-5 * x
    numeric = (law.depth(x - h) - law.depth(x + h)) / (2 * h)
    assert law.metres_per_pixel(d) == pytest.approx(numeric, rel=1e-6)


@pytest.mark.parametrize("law", LAWS)
def test_what_is_not_seen_or_impossible_is_nan(law: DepthLaw) -> None:
    out = law.depth(np.array([np.nan, -3.0, -100.0, 60.0]))
    assert np.isnan(out).tolist() == [True, True, True, False]
    assert np.isnan(law.disparity(np.array([np.nan, 0.0, -1.0]))).all()
    assert np.isnan(AffineDisparity(37.7, 2.5).depth(np.array([2.5, 2.0]))).all()
    assert law.depth(np.empty((0, 2))).shape == (0, 2)


def test_affine_law_absorbs_a_yaw_of_the_right_camera() -> None:
    # On the axis a small yaw is a constant disparity offset: f tan(yaw)
    f = 527.3
    left = CameraModel(np.diag([f, f, 1.0]), np.zeros(5), np.eye(4), 640, 480, 0.0)
    yaw = np.radians(-0.27)
    right = CameraModel(
        np.diag([f, f, 1.0]),
        np.zeros(5),
        rigid(axis_rotation(1, yaw), np.array([0.075, 0, 0])),
        640,
        480,
        0.0,
    )
    points = np.stack([np.zeros(9), np.zeros(9), np.linspace(0.4, 1.2, 9)], axis=-1)
    disparity = left.project(points)[:, 0] - right.project(points)[:, 0]
    offset = f * np.tan(-yaw)
    assert abs(offset) == pytest.approx(2.5, abs=0.02)  # px
    fitted = AffineDisparity(f * 0.075, -offset if disparity[-1] < f * 0.075 / 1.2 else offset)
    assert np.abs(fitted.depth(disparity) / points[:, 2] - 1.0).max() < 2e-3


@given(st.floats(0.2, 2.0), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2))
def test_position_from_centroid_and_depth(z: float, x: float, y: float) -> None:
    matrix = np.array([[503.0, 0, 319.5], [0, 503.0, 239.5], [0, 0, 1.0]])
    distortion = np.array([0.105, -0.21, 0.0006, -0.0009, 0.05])
    camera = CameraModel(
        matrix, distortion, rigid(axis_rotation(0, 0.2), np.array([0.1, 0.2, 0.3])), 640, 480, 0
    )
    in_camera = np.array([x * z, y * z, z])
    point = in_camera @ camera.T_rig_camera[:3, :3].T + camera.centre
    assert position_at_depth(camera, camera.project(point), np.array(z)) == pytest.approx(point, abs=1e-6)


def test_position_is_nan_as_a_row() -> None:
    camera = CameraModel(np.diag([500.0, 500.0, 1.0]), np.zeros(5), np.eye(4), 640, 480, 0.0)
    uv = np.array([[1.0, 2.0], [np.nan, np.nan], [3.0, 4.0]])
    out = position_at_depth(camera, uv, np.array([0.5, 0.5, np.nan]))
    assert np.isnan(out).all(axis=1).tolist() == [False, True, True]
    assert np.isfinite(out[0]).all()


def _rig(**parts: object) -> RigCalibration:
    known: dict[str, object] = {
        "version": 1, "name": "desk", "kind": "markers", "cameras": ("left", "right"), "hand": "h",
        "T_rig_camera": {"left": POSE, "right": POSE},
        "power_law": PowerLawCalibration(k_m=45.433, z=-1.035),
        "affine_disparity": AffineDisparityCalibration(a_m_px=37.7, x0_px=2.5),
    }  # fmt: skip
    return RigCalibration(**(known | parts))  # pyright: ignore[reportArgumentType]


def test_the_rig_file_chooses_the_law() -> None:
    assert depth_law(_rig(depth_model="stereo")) is None
    assert depth_law(_rig(depth_model="power_law")) == KALBFLEISCH
    assert depth_law(_rig(depth_model="affine_disparity")) == AffineDisparity(37.7, 2.5)
    with pytest.raises(CalibrationError, match="two cameras"):
        depth_law(_rig(depth_model="power_law", cameras=("a", "b", "c")))
    with pytest.raises(CalibrationError, match="key is missing"):
        depth_law(_rig(depth_model="power_law", power_law=None))


@pytest.mark.parametrize("bad", [(0.0, 1.0, 640), (0.075, 0.0, 640), (0.075, 4.0, 640), (np.nan, 1.0, 640)])
def test_ideal_law_refuses_what_is_no_camera(bad: tuple[float, float, int]) -> None:
    with pytest.raises(ValueError, match="not a stereo pair"):
        ideal_law(*bad)
