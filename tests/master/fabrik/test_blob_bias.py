"""The centroid of a bent outline against the integral over the bent area, and the centre that is found back."""

import numpy as np
import pytest

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from master.fabrik.caps import LensShift, card_outline, centre_of_blob, round_outline

MATRIX = np.array([[503.0, 0.0, 319.5], [0.0, 503.0, 239.5], [0.0, 0.0, 1.0]])
LENS = np.array([0.105, -0.21, 0.0006, -0.0009, 0.05])
CAMERA = CameraModel(MATRIX, LENS, np.eye(4), 640, 480, 0.0)
SHAPES = [("round", round_outline()), ("card", card_outline(75, 50))]


def inside(shape: str, n: int) -> Float:
    """Points (K, 2) that fill the shape of unit area evenly."""
    axis = (np.arange(n) + 0.5) / n - 0.5
    x, y = np.meshgrid(axis, axis)
    if shape == "card":
        return np.stack([x.ravel() * np.sqrt(1.5), y.ravel() / np.sqrt(1.5)], axis=1)
    grid = np.stack([x.ravel(), y.ravel()], axis=1) * 2.0 / np.sqrt(np.pi)
    return grid[np.hypot(*grid.T) < 1.0 / np.sqrt(np.pi)]


def image_of(shape: str, centre: Float, size: float) -> tuple[Float, float]:
    """Centroid (2,) and area [px^2] of the image: the integral over the shape of the lens' magnification."""
    points = centre + size * inside(shape, 400)
    step = 1e-5
    jacobian = [
        (CAMERA.distort(points + step * e) - CAMERA.distort(points - step * e)) / (2 * step)
        for e in np.eye(2)
    ]
    weight = np.abs(jacobian[0][:, 0] * jacobian[1][:, 1] - jacobian[0][:, 1] * jacobian[1][:, 0])
    uv = CAMERA.distort(points)
    return (uv * weight[:, None]).sum(axis=0) / weight.sum(), float(weight.mean()) * size**2


@pytest.mark.parametrize(("shape", "outline"), SHAPES)
@pytest.mark.parametrize("centre", [(0.19, 0.0), (-0.3, 0.2), (0.0, 0.0)])
def test_the_centre_of_a_large_target_is_found_back(
    shape: str, outline: Float, centre: tuple[float, float]
) -> None:
    at = np.array(centre)
    uv, area = image_of(shape, at, size=0.3)  # 23 000 px^2
    truth = CAMERA.distort(at)
    found = centre_of_blob(CAMERA, uv[None], np.array([area]), outline)[0]
    assert np.linalg.norm(found - truth) < 0.01
    if centre != (0.0, 0.0):
        assert np.linalg.norm(uv - truth) > 0.3  # that much would be wrong without


def test_a_lens_without_distortion_shifts_nothing() -> None:
    plain = CameraModel(MATRIX, np.zeros(5), np.eye(4), 640, 480, 0.0)
    uv = np.array([[500.0, 100.0], [20.0, 400.0]])
    assert centre_of_blob(plain, uv, np.array([2e4, 500.0]), round_outline()) == pytest.approx(uv, abs=1e-9)


def test_a_finger_cap_is_shifted_by_hundredths_of_a_pixel() -> None:
    uv = np.array([[480.0, 120.0]])
    found = centre_of_blob(CAMERA, uv, np.array([500.0]), round_outline())
    assert 0.001 < np.linalg.norm(found - uv) < 0.05


def test_what_is_not_seen_or_of_unknown_size_stays_as_it_is() -> None:
    uv = np.array([[480.0, 120.0], [np.nan, np.nan], [480.0, 120.0]])
    found = centre_of_blob(CAMERA, uv, np.array([np.nan, 500.0, 5000.0]), round_outline())
    assert found[0].tolist() == [480.0, 120.0]
    assert np.isnan(found[1]).all()
    assert not np.allclose(found[2], uv[2])
    assert centre_of_blob(CAMERA, np.empty((0, 2)), np.empty(0), round_outline()).shape == (0, 2)


# -- the same in every frame -------------------------------------------------------------------------------------

LENSES = [LENS, np.array([-0.3, 0.1, 0.001, -0.001, -0.01]), np.array([0.0, 0.0, 0.001, 0.002, 0.0])]


def places(seed: int, count: int = 300) -> Float:
    return np.random.default_rng(seed).uniform([100.0, 100.0], [540.0, 380.0], (count, 2))


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("area", [300.0, 3000.0])
def test_the_expansion_is_the_polygon(lens: Float, area: float) -> None:
    """Up to the next order of the blob's size, and half a cell of the grid."""
    camera = CameraModel(MATRIX, lens, np.eye(4), 640, 480, 0.0)
    uv, areas = places(1), np.full(300, area)
    exact = centre_of_blob(camera, uv, areas, round_outline())
    found = LensShift((camera, camera)).centres(np.stack([uv, uv]), np.stack([areas, areas]))
    shift = np.linalg.norm(exact - uv, axis=1)
    for one in found:
        off = np.linalg.norm(one - exact, axis=1)
        assert np.median(off) < 0.03 * shift.max()
        assert off.max() < 0.15 * shift.max()  # lenses whose shift turns round within the image vary fast


def test_the_shift_of_a_weak_lens_by_hand() -> None:
    # Near the axis it is 12 f k1 (x, y) A / (4 pi f^2): 3 / pi * 0.1 * (80, 40) px * 5000 / 500^2
    camera = CameraModel(
        np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]),
        np.array([0.1, 0.0, 0.0, 0.0, 0.0]),
        np.eye(4),
        640,
        480,
        0.0,
    )
    uv = np.array([[[400.0, 280.0]]])
    shift = uv - LensShift((camera,)).centres(uv, np.array([[5000.0]]))
    assert shift[0, 0] == pytest.approx([0.1528, 0.0764], rel=0.02)


def test_each_camera_has_its_own_lens_and_size() -> None:
    plain = CameraModel(MATRIX, np.zeros(5), np.eye(4), 1280, 960, 0.0)
    assert not LensShift((plain, plain)).any
    both = LensShift((CAMERA, plain))
    assert both.any
    uv = np.stack([places(2, 5), places(3, 5)])
    found = both.centres(uv, np.full((2, 5), 5000.0))
    np.testing.assert_array_equal(found[1], uv[1])
    np.testing.assert_array_equal(found[0], LensShift((CAMERA,)).centres(uv[:1], np.full((1, 5), 5000.0))[0])
    assert (np.linalg.norm(found[0] - uv[0], axis=1) > 0.01).any()


def test_blobs_not_seen_of_unknown_size_or_at_the_edge_do_no_harm() -> None:
    uv = np.array([[[480.0, 120.0], [np.nan, np.nan], [480.0, 120.0], [-5.0, 500.0], [639.5, 479.5]]])
    area = np.array([[np.nan, 500.0, 5000.0, 500.0, 500.0]])
    found = LensShift((CAMERA,)).centres(uv, area)
    assert found[0, 0].tolist() == [480.0, 120.0]
    assert np.isnan(found[0, 1]).all()
    assert 0.02 < np.linalg.norm(found[0, 2] - uv[0, 2]) < 1.0
    assert np.isfinite(found[0, 3:]).all()


def test_where_a_lens_folds_back_nothing_is_shifted() -> None:
    folded = np.array([-0.9, 0.0, 0.0, 0.0, 0.0])  # grows to r = 0.61 only: 0.41 of a focal length, 204 px
    shift = LensShift((CameraModel(MATRIX, folded, np.eye(4), 640, 480, 0.0),))
    uv = np.array([[[319.5 + 150.0, 239.5], [630.0, 470.0]]])
    found = shift.centres(uv, np.full((1, 2), 400.0))
    assert 0.05 < np.linalg.norm(found[0, 0] - uv[0, 0]) < 5.0
    np.testing.assert_array_equal(found[0, 1], uv[0, 1])
