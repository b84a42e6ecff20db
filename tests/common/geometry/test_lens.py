"""Where a lens folds, by hand and by a dense search; and the way back from pixels of lenses that bend strongly."""

import math

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.lens import Lens, contraction, distorted, fold_of, undistorted

SIZE = (640, 480)
CENTRE = (319.5, 239.5)
CORNER_PX = math.hypot(320, 240)


def lens(*distortion: float, focal: float = 350.0, centre: tuple[float, float] = CENTRE) -> Lens:
    k1, k2, p1, p2, k3 = distortion
    return Lens(SIZE, (focal, focal), centre, (k1, k2, p1, p2, k3))


@pytest.mark.parametrize("share", [0.3, 0.9, 0.99, 1.01, 1.1, 2.0])
def test_a_barrel_folds_where_a_calculation_by_hand_says(share: float) -> None:
    # r (1 + k1 r^2) rises up to r = 1 / sqrt(-3 k1), where it is 2/3 r.
    wanted_px = share * CORNER_PX
    r = 1.5 * wanted_px / 350.0
    fold = fold_of(lens(-1.0 / (3.0 * r * r), 0, 0, 0, 0))
    if share > 1.0:
        assert fold is None
    else:
        assert fold is not None
        assert fold.radius_px == pytest.approx(wanted_px, rel=2e-3)
        assert math.hypot(fold.u - CENTRE[0], fold.v - CENTRE[1]) == pytest.approx(fold.radius_px)


@pytest.mark.parametrize(
    ("distortion", "folds"),
    [
        ((0.0, 0.0, 0.0, 0.0, 0.0), False),
        ((-0.2786, 0.0677, 0.0012, -0.0001, 0.0), False),  # OpenCV's sample pictures, left
        ((-0.3, 0.1, 0.0, 0.0, 0.0), False),
        ((-0.3, 0.0, 0.0, 0.0, 0.0), True),
        ((0.0, 0.0, 0.3, 0.0, 0.0), True),  # tangential: 1 + 6 p1 y is 0 at y = -0.56
        ((-1e6, 1e6, 0.0, 0.0, 1e6), True),  # within a thousandth of a pixel, then inside out
        ((1e6, 1e6, 0.0, 0.0, 1e6), False),
    ],
)
def test_lenses_that_fold_and_lenses_that_do_not(
    distortion: tuple[float, float, float, float, float], folds: bool
) -> None:
    assert (fold_of(lens(*distortion)) is not None) == folds


def test_a_fold_between_the_axis_and_a_picture_next_to_it_counts() -> None:
    assert fold_of(lens(-0.3, 0, 0, 0, 0, centre=(-600.0, 240.0))) is not None
    assert fold_of(lens(-0.01, 0, 0, 0, 0, centre=(-600.0, 240.0))) is None
    # On the other side of the axis it does not.
    assert fold_of(lens(0, 0, 0, -0.14, 0, centre=(-2.0, 240.0))) is not None
    assert fold_of(lens(0, 0, 0, 0.14, 0, centre=(-2.0, 240.0))) is None


coefficients = st.tuples(
    st.floats(-0.5, 0.5),
    st.floats(-0.3, 0.3),
    st.floats(-0.05, 0.05),
    st.floats(-0.05, 0.05),
    st.floats(-0.2, 0.2),
)


@given(coefficients, st.floats(280.0, 900.0))
@example((-0.1875, 0.03125, 0.0, 0.03125, 0.0), 280.0)
def test_every_pixel_of_a_lens_that_does_not_fold_has_one_direction(
    distortion: tuple[float, float, float, float, float], focal: float
) -> None:
    one = lens(*distortion, focal=focal)
    assume(fold_of(one) is None)
    pixels = _grid()
    seen = (pixels - CENTRE) / focal
    np.testing.assert_allclose(distorted(one, undistorted(one, seen)), seen, atol=1e-6 / focal)
    np.testing.assert_allclose(_model(one).distort(_model(one).undistort(pixels)), pixels, atol=1e-3)


@pytest.mark.parametrize(
    ("distortion", "focal"),
    [
        ((-0.3, 0.1, 0.0, 0.0, 0.05), 350.0),
        ((-0.5, 0.2, 0.0, 0.0, 0.0), 350.0),
        ((3.0, 0.0, 0.0, 0.0, 0.0), 500.0),
        ((-0.1875, 0.03125, 0.0, 0.03125, 0.0), 280.0),  # by its tangential terms
    ],
)
def test_the_way_back_is_found_where_opencvs_iteration_diverges(
    distortion: tuple[float, float, float, float, float], focal: float
) -> None:
    one = lens(*distortion, focal=focal)
    assert contraction(one) > 0.5
    model = _model(one)
    assert model.steep is not None
    pixels = _grid()
    np.testing.assert_allclose(model.distort(model.undistort(pixels)), pixels, atol=1e-6)
    assert np.isnan(model.undistort(np.array([[np.nan, 3.0], [np.nan, np.nan]]))).all()
    assert model.undistort(np.empty((0, 2))).shape == (0, 2)
    assert model.undistort(np.array(CENTRE)) == pytest.approx(np.zeros(2), abs=1e-12)


def test_a_pixel_that_no_direction_has_is_nan() -> None:
    model = _model(lens(-0.22, 0, 0, 0, 0, focal=500.0))  # folds beyond the corner
    assert model.steep is not None
    far = model.undistort(np.array([[2000.0, 240.0], [320.0, 240.0]]))
    assert np.isnan(far).any(axis=1).tolist() == [True, False]


def _grid() -> Float:
    x, y = np.linspace(-0.5, SIZE[0] - 0.5, 9), np.linspace(-0.5, SIZE[1] - 0.5, 9)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _model(of: Lens) -> CameraModel:
    (fx, fy), (cx, cy) = of.focal_px, of.centre_px
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return CameraModel(matrix, np.array(of.distortion), np.eye(4), *of.size_px, 0.0)
