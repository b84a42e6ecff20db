"""What a wrist device knows of itself: rays meet the laser plane."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from common.calibration.rig import LaserPlane
from slave.wrist.led_image import WristView
from tests.slave.wrist.wrist_frames import CAMERA, HAND, RIG, VIEW


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
    connection_lost = np.array([0.0, -1.0, 1.0])
    uv = np.vstack([VIEW.optics.project(np.array([along, connection_lost])), [[np.nan, 1.0]]])
    points = VIEW.on_plane(uv)
    assert np.isnan(points[1:]).all()
    assert np.isnan(points[0]).all() or np.linalg.norm(points[0]) > 1e3
