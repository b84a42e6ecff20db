"""Share of marker colour in every pixel of a stack of windows.

In linear light.

1. A linear discriminant between core and ring, w = (S_ring + q m m' + N)^-1 (m - m_ring), m the mean of the core, is
   the colour direction along which the surroundings vary least: skin on one side and table on the other both become
   0. The term q m m' allows for marker pixels lighter and darker than their mean (after Fisher 1936).
2. Coordinate along w, 0 at the ring's mean and 1 at the core's, is share times shading. The shading is a plane
   fitted to the pixels whose four neighbours are all in the mask, so coordinate / shading is the share.

The sums over the pixels of all windows are products of matrices: one call for all markers. Their order differs from
processor to processor; so light and places are small whole numbers, whose sums are exact in any order, and what is
no whole number is added up in double precision.
"""

from functools import lru_cache
from typing import NamedTuple, TypeAlias, cast

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image
from common.geometry.srgb import to_linear

Float32: TypeAlias = npt.NDArray[np.float32]

WHITE = 4095  # light of a full byte
# Added to the scatter: one grey level of noise, so that a flat colour stays solvable.
NOISE = 4e-6 * WHITE**2 * np.eye(3)
SHADED = 0.002  # variance of the marker's brightness, relative, that the discriminant allows for
EVERY = (
    3  # of the ring's pixels one in so many is used: of hundreds, one in three suffices for the statistics
)
DARKEST = 0.3  # of the mean level of the core: shading is followed no further
STIFF_PX2 = 0.7  # a core that spreads less has no shading that could be distinguished from noise
TILT = np.diag([1e-6, STIFF_PX2, STIFF_PX2])  # the first: a window without a core stays solvable
# Where 1, x, y, xx, xy, yy stand in the symmetric 3 x 3 matrix of products of (1, x, y).
PRODUCT_OF = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def _linear_light() -> Float32:
    """Byte -> linear light 0..`WHITE`, whole numbers (IEC 61966-2-1)."""
    return np.round(WHITE * to_linear(np.arange(256) / 255.0)).astype(np.float32)


LIGHT = _linear_light()


class Grid(NamedTuple):
    """The pixels of a window from its middle, in whole pixels.

    Attributes:
        sums: (P, 6) 1, x, y, xx, xy, yy, double precision.
        x, y: (P,) single precision.
        middle: x, y of the middle in the window [px].
    """

    sums: Float
    x: Float32
    y: Float32
    middle: tuple[int, int]


@lru_cache(maxsize=32)
def grid_of(height: int, width: int) -> Grid:
    """The grid of windows (height, width) [px]."""
    y, x = np.mgrid[0:height, 0:width].reshape(2, -1)
    middle = width // 2, height // 2
    x, y = x - middle[0], y - middle[1]
    sums = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1).astype(np.float64)
    return Grid(sums, x.astype(np.float32), y.astype(np.float32), middle)


def light_of(tall: Image) -> Float32:
    """Linear light 0..`WHITE` of an image (H, W, 4), channel by channel: (3, H, W)."""
    light = np.empty((3, *tall.shape[:2]), np.float32)
    for channel, plane in enumerate(cv2.split(tall)[:3]):
        cv2.LUT(plane, LIGHT, cast(Image, light[channel]))
    return light


def shares(
    light: Float32, ring: Bool, weights: Float32, place: Float, grid: Grid
) -> tuple[Float32, Float, Float]:
    """Coordinate along the discriminant over shading of every pixel, unclipped.

    Args:
        light: (3, M, P) of `light_of`.
        ring: (M, P) the surroundings.
        weights: (2, M, P) 0 or 1: the core, and where the shading is followed.
        place: (2, M, 6) sums of both over the grid.
        grid: Of the windows.

    Returns:
        Shares (M, P), contrasts (M,), and mean colours of the core (M, 3).
    """
    count = len(ring)
    around = light[:, :, ::EVERY].astype(np.float64)  # columns, as windows are a multiple of it wide
    some = ring[:, ::EVERY].astype(np.float64)
    apart: Float = around * some
    number = np.maximum(some.sum(axis=1), 1.0)[:, None]
    ring_mean = apart.sum(axis=2).T / number
    scatter = apart.transpose(1, 0, 2) @ around.transpose(1, 2, 0) / number[..., None]
    scatter -= ring_mean[:, :, None] * ring_mean[:, None, :]
    tiles = light.transpose(1, 0, 2)
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
    along: Float32 = w.T.astype(np.float32)[:, :, None]
    share = light[0] * along[0]  # sum by sum, not as a product of matrices: the order of these is kept
    share += light[1] * along[1]
    share += light[2] * along[2]
    share -= zero.astype(np.float32)[:, None]
    sums = (share * weights[1]).astype(np.float64) @ grid.sums[:, :3]
    level, tilt_x, tilt_y = (inverse[1] @ sums[:, :, None])[:, :, 0].T.astype(np.float32)[:, :, None]
    shading = tilt_x * grid.x
    shading += tilt_y * grid.y
    shading += level
    np.maximum(shading, DARKEST, out=shading)
    share /= shading
    return share, np.sqrt(power), mean
