"""What a wrist device knows of itself: files that do not fit are refused by name, and rays meet the laser plane."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from common.errors import CalibrationError
from common.wrist_calibration import LaserPlane
from slave.wrist.view import WristView
from tests.slave.wrist.wrist_frames import CAMERA, HAND, RIG, VIEW


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"kind": "markers"}, "kind is 'markers'"),
        ({"cameras": ("other",)}, "cameras: other"),
        ({"laser_plane": None}, "laser_plane is missing"),
        ({"T_camera_palm": None}, "T_camera_palm is missing"),
        (
            {"T_camera_palm": ((2.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0))},
            "not a rotation",
        ),
        (
            {"T_camera_palm": ((1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, -1.0, 0), (0, 0, 0, 1.0))},
            "not a rotation",
        ),
    ],
)
def test_a_rig_that_does_not_fit_is_refused_with_its_name_and_the_key(
    change: dict[str, object], says: str
) -> None:
    with pytest.raises(CalibrationError, match=f"rig 'wrist': .*{says}"):
        WristView.of(replace(RIG, **change), CAMERA, HAND)


def test_a_camera_without_intrinsics_is_refused() -> None:
    with pytest.raises(CalibrationError, match="intrinsics"):
        WristView.of(RIG, replace(CAMERA, intrinsics=None), HAND)


def test_a_rounded_normal_is_a_unit_vector_and_its_plane_stays_where_it_is() -> None:
    assert RIG.laser_plane is not None
    x, y, z = RIG.laser_plane.normal
    rounded = LaserPlane(normal=(1.005 * x, 1.005 * y, 1.005 * z), offset_m=1.005 * RIG.laser_plane.offset_m)
    view = WristView.of(replace(RIG, laser_plane=rounded), CAMERA, HAND)
    np.testing.assert_allclose(np.linalg.norm(view.normal), 1.0, rtol=1e-12)
    np.testing.assert_allclose(view.offset_m, VIEW.offset_m, rtol=1e-12)


@given(st.floats(-0.06, 0.06), st.floats(0.07, 0.2))
def test_a_point_of_the_plane_seen_in_the_image_is_found_again(x: float, z: float) -> None:
    y = (VIEW.offset_m - VIEW.normal[0] * x - VIEW.normal[2] * z) / VIEW.normal[1]
    point = np.array([x, y, z])
    np.testing.assert_allclose(VIEW.on_plane(VIEW.optics.project(point)), point, atol=1e-9)


def test_a_ray_along_the_plane_or_away_from_it_has_no_point() -> None:
    along = np.array([0.0, -VIEW.normal[2] / VIEW.normal[1], 1.0])
    away = np.array([0.0, -1.0, 1.0])
    uv = np.vstack([VIEW.optics.project(np.array([along, away])), [[np.nan, 1.0]]])
    points = VIEW.on_plane(uv)
    assert np.isnan(points[1:]).all()
    assert np.isnan(points[0]).all() or np.linalg.norm(points[0]) > 1e3
