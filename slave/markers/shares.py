"""Find the share of paint in every pixel of a stack of windows, in linear light.

1. A linear discriminant between core and ring, w = (S_ring + q m m' + N)^-1 (m - m_ring), m the mean of the core, is
   the colour direction along which the surroundings vary least: skin on one side and table on the other both become
   0. The term q m m' allows for paint that is lighter and darker than its mean (after Fisher 1936).
2. Coordinate along w, 0 at the ring's mean and 1 at the core's, is share times shading. The shading is a plane
   fitted to the pixels whose four neighbours are all in the mask, so coordinate / shading is the share.

The sums over the pixels of all windows are products of matrices: one call for all markers.
"""

from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image

Float32: TypeAlias = npt.NDArray[np.float32]

# Added to the scatter: one grey level of noise, so that a flat colour stays solvable.
WHITE = 255.0**2  # light of a full byte
NOISE = 4e-6 * WHITE**2 * np.eye(3)
SHADED = 0.002  # variance of the paint's brightness, relative, that the discriminant allows for
EVERY = 3  # of the ring's pixels one in so many is looked at: hundreds of them tell what one number in three tells
DARKEST = 0.3  # of the mean level of the core: shading is followed no further
STIFF = 0.002  # of a half tile, squared: a smaller core has no shading that could be told from noise
TILT = np.diag([1e-3 * STIFF, STIFF, STIFF])
# Where 1, x, y, xx, xy, yy stand in the symmetric 3 x 3 matrix of products of (1, x, y).
PRODUCT_OF = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@lru_cache(maxsize=64)
def grid_of(height: int, width: int) -> Float32:
    """1, x, y, xx, xy, yy of the pixels of a tile, (height * width, 6); x and y in half widths from its middle."""
    y, x = np.mgrid[0:height, 0:width].reshape(2, -1)
    x, y = (2.0 * x + 1.0) / width - 1.0, (2.0 * y + 1.0 - height) / width
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1).astype(np.float32)


def light_of(tall: Image) -> Float32:
    """Light 0..`WHITE` of an image (H, W, 4), channel by channel: (3, H, W).

    The square of the byte: within 0.03 of the sRGB curve, at a third of a look-up's cost; measured on rendered
    caps, centroids are as good.
    """
    light = np.empty((3, *tall.shape[:2]), np.float32)
    blue, green, red, _ = cv2.split(tall)
    light[0], light[1], light[2] = blue, green, red
    light *= light
    return light


def shares(
    light: Float32, ring: Bool, weights: Float32, place: Float32, grid: Float32
) -> tuple[Float32, Float, Float]:
    """Coordinate along the discriminant over shading of every pixel, unclipped.

    Args:
        light: (3, M, P) of `light_of`.
        ring: (M, P) the surroundings.
        weights: (2, M, P) 0 or 1: the core, and where the shading is followed.
        place: (2, M, 6) sums of both over the grid.
        grid: (P, 6) of `grid_of`.

    Returns:
        Shares (M, P), contrasts (M,), and mean colours of the core (M, 3).
    """
    count = len(ring)
    tiles = light.transpose(1, 0, 2)
    around = light[:, :, ::EVERY]
    some = ring[:, ::EVERY].astype(np.float32)
    apart = around * some
    number = np.maximum(some.sum(axis=1), 1.0)[:, None]
    ring_mean = apart.sum(axis=2).T / number
    scatter = apart.transpose(1, 0, 2) @ around.transpose(1, 2, 0) / number[..., None]
    scatter -= ring_mean[:, :, None] * ring_mean[:, None, :]
    mean = (tiles @ weights[0, :, :, None])[:, :, 0] / np.maximum(place[0, :, :1], 1.0)
    scatter += SHADED * mean[:, :, None] * mean[:, None, :]
    matrices = np.empty((2, count, 3, 3))
    matrices[0] = scatter + NOISE
    matrices[1] = place[1][:, PRODUCT_OF]
    matrices[1] += np.maximum(place[1, :, :1, None], 1.0) * TILT
    inverse = np.linalg.inv(matrices)
    step = mean - ring_mean
    w = (inverse[0] @ step[:, :, None])[:, :, 0]
    power = np.maximum((step * w).sum(axis=1), 1e-9)
    w /= power[:, None]
    zero = (w * ring_mean).sum(axis=1)
    share = (w.astype(np.float32)[:, None] @ tiles)[:, 0]
    share -= zero.astype(np.float32)[:, None]
    tilt = (inverse[1] @ ((share * weights[1]) @ grid[:, :3])[:, :, None])[:, :, 0]
    level = tilt.astype(np.float32) @ grid[:, :3].T
    np.maximum(level, DARKEST, out=level)
    share /= level
    return share, np.sqrt(power), mean
