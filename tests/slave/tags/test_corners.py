"""Sides of a square whose light is known in closed form: a blurred square, turned, is found to hundredths."""

from math import erf

import numpy as np
import pytest

from common.arrays import Float, Image
from common.geometry.srgb import to_srgb
from slave.tags.corners import normal_law, refine


def square(corners: Float, width: float, size: int = 120) -> Image:
    """A dark square on paper, each side blurred by a normal law (exact but for the last pixel at a corner)."""
    y, x = np.indices((size, size)).astype(np.float64)
    inside = np.ones((size, size))
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - begin) / np.linalg.norm(end - begin)
        z = ((y - begin[1]) * along[0] - (x - begin[0]) * along[1]) / width
        inside *= [[0.5 * (1.0 + erf(v / np.sqrt(2.0))) for v in row] for row in z.tolist()]
    return np.round(255.0 * to_srgb(0.75 - 0.7 * inside)).astype(np.uint8)


@pytest.mark.parametrize("degrees", [0.0, 7.0, 45.0])
@pytest.mark.parametrize("side", [24.0, 70.0])
def test_a_turned_square_is_found_from_a_pixel_away(degrees: float, side: float) -> None:
    angle = np.radians(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    true = 0.5 * side * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ rotation.T + 60.3
    begun = true + np.random.default_rng(1).uniform(-0.8, 0.8, (4, 2))
    found = refine(square(true, 0.7), begun[None], 7, None)
    assert np.abs(found.uv[0] - true).max() < 0.03
    assert 0.0 < found.sigma_px[0] < 0.04
    read = np.sqrt(0.7**2 + 1.0 / 6.0)  # reading between pixels blurs by a hat, whose variance is a sixth
    assert abs(found.width_px[0] - read) < 0.03


def test_noise_is_reported_as_it_is() -> None:
    true = np.array([[40.2, 41.1], [79.4, 44.0], [77.0, 80.3], [38.0, 78.9]])
    clear, rng = square(true, 0.8).astype(np.float64), np.random.default_rng(2)
    ratio = []
    for _ in range(40):
        noisy = np.clip(np.round(clear + rng.normal(0.0, 8.0, clear.shape)), 0, 255).astype(np.uint8)
        found = refine(noisy, true[None], 7, None)
        ratio.append(np.square((found.uv[0] - true) / found.sigma_px[0]).mean())
    assert 0.4 < np.mean(ratio) < 2.5


def test_what_is_no_square_is_not_sure_of_anything() -> None:
    begun = np.array([[[40.0, 40.0], [80.0, 40.0], [80.0, 80.0], [40.0, 80.0]]])
    flat = np.full((120, 120), 90, np.uint8)
    assert np.isnan(refine(flat, begun, 7, None).sigma_px).all()
    bright = 255 - square(begun[0], 0.7)  # white on black
    assert np.isnan(refine(bright, begun, 7, None).sigma_px).all()
    assert np.isnan(refine(flat, begun - 500.0, 7, None).sigma_px).all()
    assert refine(flat, np.zeros((0, 4, 2)), 7, None).uv.shape == (0, 4, 2)


def test_the_normal_law_is_close() -> None:
    z = np.linspace(-4.0, 4.0, 81)
    exact = np.array([0.5 * (1.0 + erf(v / np.sqrt(2.0))) for v in z])
    np.testing.assert_allclose(normal_law(z), exact, atol=3e-4)
