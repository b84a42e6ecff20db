"""Measure sub-pixel centroids from the share of marker colour in each pixel.

At the rim a pixel holds marker and surroundings in proportion to the covered area, and light adds linearly, so in
linear light the share of marker colour is measurable. In a small full-resolution window of each marker:

1. The colour table gives the mask. How full of it the 7 x 7 neighbourhood of a pixel is separates core (surely marker)
   from rim (unsure) and ring (surely not marker).
2. A linear discriminant w = (S_ring + q m m' + N)^-1 (m - m_ring), m the core's mean, is the colour direction along
   which the surroundings vary least: skin and table both become 0. q m m' allows for marker pixels lighter and darker
   than their mean (after Fisher 1936).
3. The coordinate along w, 0 at the ring's mean and 1 at the core's, is share times shading. The shading is a plane
   fitted to pixels whose four neighbours are in the mask; their quotient is the share.
4. Deep inside the share is 1, whatever a highlight does there; beyond the rim it is 0. Centroid, area and extent are
   the moments of the shares.

All windows lie in one stack, so that a step costs one call. The order of sums in products of matrices differs between
processors: light and places are small whole numbers, whose sums are exact in any order; the rest is added up in
double precision.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, cast

import cv2
import numpy as np

from common.arrays import Bool, Float, Float32, Image
from common.geometry.srgb import to_linear
from slave.markers.classify import SCALE, Blob, ColourTable

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


# Byte -> linear light 0..`WHITE`, whole numbers (IEC 61966-2-1).
LIGHT: Float32 = np.round(WHITE * to_linear(np.arange(256) / 255.0)).astype(np.float32)


class Grid(NamedTuple):
    """The pixels of a window from its middle, in whole pixels."""

    sums: Float  # (P, 6) 1, x, y, xx, xy, yy, double precision
    x: Float32  # (P,) single precision, as y
    y: Float32
    middle: tuple[int, int]  # x, y of the middle in the window [px]


@lru_cache(maxsize=32)
def grid_of(height: int, width: int) -> Grid:
    """The grid of windows (height, width) [px]."""
    y, x = np.mgrid[0:height, 0:width].reshape(2, -1)
    middle = width // 2, height // 2
    x, y = x - middle[0], y - middle[1]
    sums = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1).astype(np.float64)
    return Grid(sums, x.astype(np.float32), y.astype(np.float32), middle)


def light_of(tall: Image) -> Float32:
    """Linear light 0..`WHITE` of an image (H, W, 4), by channel: (3, H, W)."""
    light = np.empty((3, *tall.shape[:2]), np.float32)
    for channel, plane in enumerate(cv2.split(tall)[:3]):
        cv2.LUT(plane, LIGHT, cast(Image, light[channel]))
    return light


def shares(
    light: Float32, ring: Bool, weights: Float32, place: Float, grid: Grid
) -> tuple[Float32, Float, Float]:
    """Return shares (M, P), contrasts (M,), and mean colours of the core (M, 3).

    Shares are the coordinate along the discriminant over shading, unclipped. `light`: (3, M, P) of `light_of`;
    `ring`: (M, P) the surroundings; `weights`: (2, M, P) 0 or 1: the core, and where the shading is followed;
    `place`: (2, M, 6) sums of both over the grid.
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


PAD = 4  # px around the box of a blob: 3 of rim, the rest ring
SIDE = (7, 7)  # px, of the neighbourhood whose fullness separates core from rim
CORE = 33  # of its 49 pixels: two pixels inside a straight edge it holds 35, one pixel inside 28
DEEP = 42  # three pixels inside
HOLE = 26  # not in the mask yet inside it: outside a straight edge the neighbourhood holds at most 21
MIN_PIXELS = 4
WITHIN = np.uint32(1 << 24)  # a packed pixel with any fourth channel is at least this
SQUARE = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
FIRST, SECOND = np.array([0, 0, 1]), np.array([0, 1, 1])  # x x, x y, y y


class Measured(NamedTuple):
    """One marker, measured by its colour."""

    u: float  # centroid of the visible marker colour, u, v [px], distorted image
    v: float
    area: float  # visible [px^2]
    contrast: float  # level of the core in standard deviations of what the filter leaves of the ring
    colour: list[float]  # mean of the core in linear light 0..1: blue, green, red
    cut: bool  # the mask touches the border of the image
    thin: bool  # hardly a pixel of the mask is surrounded by mask: a sliver, or a colour fringe
    foreign: float  # share of the mask's neighbour pixels with another marker's colour; 0 unless thin
    xx: float  # second central moments of the shares, xx, xy, yy [px^2]
    xy: float
    yy: float
    window: Float32  # (H, W) shares 0..1 of the pixels around
    left: int  # left, top: first pixel of the window [px]
    top: int


def measure(
    image: Image, table: ColourTable, bits: Sequence[int], blobs: Sequence[Blob], alone: Sequence[bool]
) -> list[Measured | None]:
    """Measure the markers at `blobs`; None: fewer than `MIN_PIXELS` in the window.

    `bits`: bit in the table of each blob's marker. `alone`: whether the colour has no other blob; else only pixels
    inside the blob's box are the marker's.
    """
    if not blobs:
        return []
    sides = [max(b.right - b.left, b.bottom - b.top) + 2 * PAD for b in blobs]
    unequal = 3.0  # largest to smallest window of one stack: beyond it, padding costs more than another stack
    limit = unequal * min(sides)
    if max(sides) <= limit:
        return _measure_stack(image, table, bits, blobs, alone)
    # Those of like size together, then the larger ones in the same way.
    found: list[Measured | None] = [None] * len(blobs)
    for group in [[i for i, s in enumerate(sides) if (s <= limit) is small] for small in (True, False)]:
        results = measure(
            image, table, [bits[i] for i in group], [blobs[i] for i in group], [alone[i] for i in group]
        )
        for i, result in zip(group, results, strict=True):
            found[i] = result
    return found


def _measure_stack(
    image: Image,
    table: ColourTable,
    bits: Sequence[int],
    blobs: Sequence[Blob],
    alone: Sequence[bool],
    gap: int = 0,
) -> list[Measured | None]:
    """Measure blobs in windows of one size, `gap` px apart where borders are met."""
    count = len(blobs)
    height = max([b.bottom - b.top for b in blobs]) + 2 * PAD + gap
    width = -(-(max([b.right - b.left for b in blobs]) + 2 * PAD + gap) // EVERY) * EVERY
    flat = count, height * width
    tall = _cut_tiles(image, blobs, height, width)
    packed = tall.view(np.uint32).reshape(flat)
    codes = table.packed_codes(packed)
    own = (codes & np.array(bits, codes.dtype)[:, None]) != 0
    if not gap and count > 1 and _meets_border(own.reshape(count, height, width)):
        return _measure_stack(image, table, bits, blobs, alone, SIDE[0] // 2)
    if not all(alone):
        _only_the_blob(own.reshape(count, height, width), blobs, alone)
    mask = own.reshape(tall.shape[:2])
    full = cast(
        Image, cv2.boxFilter(mask.view(np.uint8), -1, SIDE, normalize=False, borderType=cv2.BORDER_CONSTANT)
    ).reshape(flat)
    outside = ~own
    within = packed >= WITHIN
    core = full >= CORE
    core &= own
    inner = _eroded(own.reshape(-1), width).reshape(flat)
    solid = full >= HOLE
    solid &= outside
    solid &= within
    solid |= full >= DEEP
    near = full != 0
    near &= within
    others = (codes & (table.skin - 1)) != 0
    others &= outside
    ring = ~(near | others)
    ring &= within
    if np.count_nonzero(others) > 2 * count:
        thick = cv2.morphologyEx(others.view(np.uint8).reshape(mask.shape), cv2.MORPH_OPEN, SQUARE)
        near &= cast(Image, thick).reshape(flat) == 0  # a colour fringe is thinner
    grid = grid_of(height, width)
    weights = np.empty((2, *flat), np.float32)
    weights[0], weights[1] = core, inner
    place = weights.astype(np.float64) @ grid.sums
    thin = place[1, :, 0] < MIN_PIXELS
    for i in np.flatnonzero(place[0, :, 0] < MIN_PIXELS):  # too small for a core: the inner pixels, or all
        weights[:, i] = own[i] if thin[i] else inner[i]
        place[:, i] = weights[1, i] @ grid.sums
    share, contrast, mean = shares(light_of(tall).reshape(3, *flat), ring, weights, place, grid)
    np.maximum(share, 0.0, out=share)
    np.minimum(share, 1.0, out=share)
    share *= near.astype(np.float32)
    np.maximum(share, solid.astype(np.float32), out=share)
    moments = share.astype(np.float64) @ grid.sums
    area = moments[:, 0].copy()
    moments /= np.maximum(area, 1.0)[:, None]
    centre = moments[:, 1:3]
    spread = moments[:, 3:] - centre[:, FIRST] * centre[:, SECOND]
    centre += grid.middle
    windows = share.reshape(count, height, width)
    found: list[Measured | None] = []
    rows = zip(*(x.tolist() for x in (centre, area, contrast, thin, mean / WHITE, spread)), strict=True)
    for i, (b, row) in enumerate(zip(blobs, rows, strict=True)):
        (u, v), area, contrast, sliver, bgr, (xx, xy, yy) = row
        foreign = 0.0
        if sliver:
            if np.count_nonzero(own[i]) < MIN_PIXELS or area < 1.0:
                found.append(None)
                continue
            tile = own[i].reshape(height, width).view(np.uint8)
            rim = cv2.dilate(tile, SQUARE).reshape(-1) > tile.reshape(-1)
            foreign = np.count_nonzero(rim & others[i]) / max(np.count_nonzero(rim), 1)
        cut = _is_cut(own[i].reshape(height, width), b, image.shape)
        left, top = b.left - PAD, b.top - PAD
        u, v = left + u, top + v
        found.append(
            Measured(u, v, area, contrast, bgr, cut, sliver, foreign, xx, xy, yy, windows[i], left, top)
        )
    return found


def _cut_tiles(image: Image, blobs: Sequence[Blob], height: int, width: int) -> Image:
    """Cut the blobs' windows, one below the other: (M * height, width, 4) BGRA."""
    tall = np.zeros((len(blobs) * height, width, 4), np.uint8)
    base = 0
    for b in blobs:
        left, top = b.left - PAD, b.top - PAD
        x, y = max(left, 0), max(top, 0)
        part = image[y : b.bottom + PAD, x : b.right + PAD]
        row, column = base + y - top, x - left
        where = tall[row : row + part.shape[0], column : column + part.shape[1]]
        cv2.cvtColor(part, cv2.COLOR_BGR2BGRA, where)
        base += height
    return tall


def _only_the_blob(own: Bool, blobs: Sequence[Blob], alone: Sequence[bool]) -> None:
    """Clear what is not the blob's in tiles (M, H, W) with other blobs of the colour."""
    for tile, b, lonely in zip(own, blobs, alone, strict=True):
        if lonely:
            continue
        count, labels = cast(
            tuple[int, Image], cv2.connectedComponents(tile.view(np.uint8), connectivity=8, ltype=cv2.CV_16U)
        )
        # The blob's points of the grid lie inside its box by the width of the grid.
        rows = slice(PAD + SCALE - 1, max(PAD + b.bottom - b.top - SCALE + 1, PAD + SCALE))
        columns = slice(PAD + SCALE - 1, max(PAD + b.right - b.left - SCALE + 1, PAD + SCALE))
        mine = np.zeros(count, np.bool_)
        mine[labels[rows, columns]] = True
        tile &= mine[labels]


def _meets_border(own: Bool) -> bool:
    """Return whether a neighbourhood in a tile (M, H, W) would reach over its border."""
    reach = SIDE[0] // 2
    return bool(own[:, :reach].any() or own[:, -reach:].any() or own[:, :, 0].any() or own[:, :, -1].any())


def _eroded(own: Bool, width: int) -> Bool:
    """Return the mask pixels whose four neighbours are in the mask, flattened."""
    inner = own.copy()
    inner[1:] &= own[:-1]  # over the ends of the rows as well: nothing is in the mask there
    inner[:-1] &= own[1:]
    inner[width:] &= own[:-width]
    inner[:-width] &= own[width:]
    return inner


def _is_cut(own: Bool, b: Blob, size: tuple[int, ...]) -> bool:
    if b.left > 0 and b.top > 0 and b.right < size[1] and b.bottom < size[0]:
        return False
    x, y, width, height = cv2.boundingRect(own.view(np.uint8))
    left, top = b.left - PAD + x, b.top - PAD + y
    return width > 0 and (left <= 0 or top <= 0 or left + width >= size[1] or top + height >= size[0])
