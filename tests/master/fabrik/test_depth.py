"""Depth laws: the published table, the ideal pinhole pair, misalignment, and the error budget."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration import (
    AffineDisparityCalibration,
    PowerLawCalibration,
    RigCalibration,
    Volume,
)
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import axis_rotation, rigid
from master.fabrik.depth import (
    AffineDisparity,
    DepthLaw,
    PowerLaw,
    depth_law,
    error_budget,
    ideal_law,
    law_residual,
    tolerable_skew_s,
)

Vector = tuple[float, float, float]
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


def test_one_pixel_of_disparity_costs_its_share_of_the_budget() -> None:
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


def _rig(**parts: object) -> RigCalibration:
    known: dict[str, object] = {
        "version": 1, "name": "desk", "kind": "markers", "cameras": ("left", "right"), "hand": "h",
        "T_rig_camera": {"left": POSE, "right": POSE},
        "power_law": PowerLawCalibration(k_m=45.433, z=-1.035),
        "affine_disparity": AffineDisparityCalibration(a_m_px=37.7, x0_px=2.5),
    }  # fmt: skip
    return RigCalibration(**(known | parts))  # pyright: ignore[reportArgumentType]


def camera(
    rotation: tuple[int, float] = (0, 0.0), at: Vector = (0.075, 0.0, 0.0), f: float = 500.0
) -> CameraModel:
    """A camera of the pair, turned about an axis by an angle [deg]."""
    matrix = np.array([[f, 0.0, 319.5], [0.0, f, 239.5], [0.0, 0.0, 1.0]])
    pose = rigid(axis_rotation(rotation[0], np.radians(rotation[1])), np.array(at))
    return CameraModel(matrix, np.zeros(5), pose, 640, 480, 0.0)


LEFT, RIGHT = camera(at=(0.0, 0.0, 0.0)), camera()


def test_the_rig_file_chooses_the_law() -> None:
    pair = (LEFT, RIGHT)
    assert depth_law(_rig(depth_model="stereo"), pair) is None
    assert depth_law(_rig(depth_model="power_law"), pair) == KALBFLEISCH
    assert depth_law(_rig(depth_model="affine_disparity"), pair) == AffineDisparity(37.7, 2.5)
    with pytest.raises(CalibrationError, match="two cameras"):
        depth_law(_rig(depth_model="power_law", cameras=("a", "b", "c")), (*pair, RIGHT))
    with pytest.raises(CalibrationError, match=r"key 'power_law' is missing.*calibrate depth"):
        depth_law(_rig(depth_model="power_law", power_law=None), pair)


@pytest.mark.parametrize(
    ("right", "why"),
    [
        (camera((1, 5.0)), r"turned by 5\.0 degrees .* at most 3"),
        (camera((2, -3.2)), r"turned by 3\.2 degrees"),
        (camera(at=(0.075, 0.02, 0.0)), "75 mm is off the image rows by 20 mm"),
        (camera(at=(0.075, 0.0, -0.006)), "off the image rows by 6 mm"),
        (camera(at=(-0.075, 0.0, 0.0)), "name the left one first in 'cameras'"),
        (camera(at=(0.0, 0.075, 0.0)), "name the left one first"),
        (camera(f=540.0), "focal lengths differ by 7 %"),
    ],
)
def test_cameras_that_are_not_parallel_side_by_side_have_no_law(right: CameraModel, why: str) -> None:
    for model in ("power_law", "affine_disparity"):
        with pytest.raises(CalibrationError, match=f"'desk': depth_model '{model}' .*{why}.*use 'stereo'"):
            depth_law(_rig(depth_model=model), (LEFT, right))
        assert depth_law(_rig(depth_model="stereo"), (LEFT, right)) is None


def test_cameras_at_the_bound_have_a_law() -> None:
    for right in (camera((1, 2.9)), camera((2, -2.9)), camera(at=(0.075, 0.0036, 0.0)), camera(f=520.0)):
        assert depth_law(_rig(depth_model="power_law"), (LEFT, right)) == KALBFLEISCH


def test_a_law_is_held_against_the_geometry_where_it_is_farthest_off() -> None:
    exact, far = AffineDisparity(37.5, 0.0), AffineDisparity(37.5, 2.0)
    volume = Volume(low_m=(-0.1, -0.1, 0.5), high_m=(0.1, 0.1, 0.75))
    assert law_residual(exact, (LEFT, RIGHT), volume)[0] < 1e-9
    off, depth_m = law_residual(far, (LEFT, RIGHT), volume)
    assert depth_m == pytest.approx(0.75)
    assert off == pytest.approx(1.0 / (1.0 - 2.0 / 50.0) - 1.0)  # 50 px at 0.75 m
    assert law_residual(far, (LEFT, RIGHT), None)[1] == pytest.approx(1.0)
    assert law_residual(AffineDisparity(37.5, 60.0), (LEFT, RIGHT), volume)[0] == np.inf


@pytest.mark.parametrize("bad", [(0.0, 1.0, 640), (0.075, 0.0, 640), (0.075, 4.0, 640), (np.nan, 1.0, 640)])
def test_ideal_law_refuses_what_is_no_camera(bad: tuple[float, float, int]) -> None:
    with pytest.raises(ValueError, match="not a stereo pair"):
        ideal_law(*bad)
