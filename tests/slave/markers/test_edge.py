import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slave.markers.track import Ellipse, centre_of, fits_occlusion

OVER = 8


def covered_ellipse(
    a: float, b: float, rotation: float, u: float, v: float, share: float, side: float
) -> tuple[np.ndarray, float, float]:
    """Shares of an ellipse whose outermost `share` on the side `side` is covered, and the centroid of the rest."""
    fine = (np.arange(48 * OVER) + 0.5) / OVER - 0.5
    x, y = np.meshgrid(fine, fine)
    c, s = math.cos(rotation), math.sin(rotation)
    p, q = (c * (x - u) + s * (y - v)) / a, (c * (y - v) - s * (x - u)) / b
    inside = p * p + q * q <= 1.0
    along = p * math.cos(side) + q * math.sin(side)
    inside &= along <= np.quantile(along[inside], 1.0 - share)
    shares = inside.reshape(48, OVER, 48, OVER).mean(axis=(1, 3)).astype(np.float32)
    return shares, float(x[inside].mean()), float(y[inside].mean())


def moments(a: float, b: float, rotation: float) -> Ellipse:
    c, s = math.cos(rotation), math.sin(rotation)
    xx, yy = a * a / 4.0, b * b / 4.0
    return Ellipse(c * c * xx + s * s * yy, c * s * (xx - yy), s * s * xx + c * c * yy)


@given(
    st.floats(6.0, 12.0),
    st.floats(0.75, 1.0),
    st.floats(0.0, math.pi),
    st.floats(0.08, 0.2),
    st.floats(0.0, 2.0 * math.pi),
)
def test_the_centre_of_a_covered_ellipse_is_found_from_its_own_edge(
    a: float, aspect: float, rotation: float, share: float, side: float
) -> None:
    u, v = 24.3, 23.6
    shares, seen_u, seen_v = covered_ellipse(a, a * aspect, rotation, u, v, share, side)
    found = centre_of(shares, moments(a, a * aspect, rotation), seen_u, seen_v)
    assert found is not None
    connection_lost = math.hypot(found.u - u, found.v - v)
    assert connection_lost < 0.3
    assert connection_lost < 0.6 * math.hypot(seen_u - u, seen_v - v)


@given(
    st.floats(5.0, 12.0),
    st.floats(0.5, 1.0),
    st.floats(0.0, math.pi),
    st.floats(0.06, 0.45),
    st.floats(0.0, 2.0 * math.pi),
)
def test_a_straight_edge_is_followed_as_far_as_its_shift_and_not_twice_as_far(
    a: float, aspect: float, rotation: float, share: float, side: float
) -> None:
    _, seen_u, seen_v = covered_ellipse(a, a * aspect, rotation, 24.3, 23.6, share, side)
    du, dv = 24.3 - seen_u, 23.6 - seen_v
    shape = moments(a, a * aspect, rotation)
    assert fits_occlusion(share, shape, du, dv)
    assert not fits_occlusion(
        share, shape, 2.0 * du + math.copysign(1.5, du), 2.0 * dv + math.copysign(1.5, dv)
    )


def test_a_loss_of_a_tenth_does_not_move_a_small_cap_by_its_radius() -> None:
    # A finger that turns its end to the camera: a crescent is left, whose edge fits an ellipse far away.
    assert not fits_occlusion(0.1, Ellipse(12.0, 1.6, 4.5), 3.0, 1.5)
    assert not fits_occlusion(0.1, Ellipse(0.0, 0.0, 0.0), 0.0, 0.0)


def test_a_part_that_is_too_small_for_the_shape_is_no_answer() -> None:
    shares, u, v = covered_ellipse(3.0, 3.0, 0.0, 24.0, 24.0, 0.0, 0.0)
    assert centre_of(shares, moments(9.0, 8.0, 0.3), u, v) is None


def test_a_shape_that_is_no_ellipse_of_that_size_is_refused() -> None:
    shares = np.zeros((48, 48), np.float32)
    shares[20:24, 4:44] = 1.0
    assert centre_of(shares, moments(9.0, 9.0, 0.0), 23.5, 21.5) is None


@pytest.mark.parametrize("shape", [Ellipse(0.0, 0.0, 0.0), Ellipse(4.0, 5.0, 4.0)])
def test_moments_of_nothing_are_refused(shape: Ellipse) -> None:
    shares, u, v = covered_ellipse(8.0, 8.0, 0.0, 24.0, 24.0, 0.1, 0.0)
    assert centre_of(shares, shape, u, v) is None


def test_a_crescent_whose_centroid_lies_next_to_its_marker_is_no_answer() -> None:
    y, x = np.mgrid[0:48, 0:48]
    far = np.hypot(x - 24.0, y - 24.0)
    shares = ((far > 9.0) & (far < 11.0) & (x > 24)).astype(np.float32)
    assert centre_of(shares, moments(11.0, 11.0, 0.0), 24.0, 24.0) is None
