"""Sub-pixel centroids of the visible area of every marker.

They are measured in small windows of the full-resolution image.

A threshold knows whole pixels only. At the rim a pixel holds marker and surroundings in proportion to the covered
area, and light adds linearly, so in linear light the amount of marker colour is measurable:

1. The colour table gives the mask. How full of it the 7 x 7 neighbourhood of a pixel is separates core (surely marker)
   from rim (unsure) and ring (surely not marker).
2. In linear light the share of marker colour in every pixel is found (`shares`): along the direction that separates it
   from its surroundings, divided by the shading of the marker.
3. Deep inside the share is 1, whatever a highlight does there; beyond the rim it is 0.
4. Centroid, area and extent are the moments of the shares.

All windows lie in one stack of tiles, so that a step costs one call, not one per marker.
"""

from collections.abc import Sequence
from typing import NamedTuple, cast

import cv2
import numpy as np

from common.arrays import Bool, Image
from slave.markers.blobs import SCALE, Blob
from slave.markers.classify import ColourTable
from slave.markers.shares import EVERY, WHITE, Float32, grid_of, light_of, shares

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
    """One marker, measured.

    Attributes:
        u, v: Centroid of the visible marker colour [px], distorted image.
        area: Visible area [px^2].
        contrast: Level of the core in standard deviations of what the filter leaves of the ring.
        colour: Mean of the core in linear light 0..1: blue, green, red.
        cut: The mask touches the border of the image.
        thin: Hardly a pixel of the mask is surrounded by mask: a sliver, or a colour fringe.
        foreign: Share of the mask's neighbour pixels that have another marker's colour; 0 unless thin.
        xx, xy, yy: Second central moments of the shares [px^2].
        window: (H, W) shares 0..1 of the pixels around; left, top: its first pixel [px].
    """

    u: float
    v: float
    area: float
    contrast: float
    colour: list[float]
    cut: bool
    thin: bool
    foreign: float
    xx: float
    xy: float
    yy: float
    window: Float32
    left: int
    top: int


def measure(
    image: Image, table: ColourTable, bits: Sequence[int], blobs: Sequence[Blob], alone: Sequence[bool]
) -> list[Measured | None]:
    """Measure the markers at `blobs`.

    Args:
        image: (H, W, 3) BGR, full resolution.
        table: Colour table of the camera.
        bits: Bit in the table of each blob's marker.
        blobs: Where the scan saw them.
        alone: Whether the colour has no other blob; where it has, only pixels inside the blob's box are the marker's.

    Returns:
        One measurement per blob; None where the window holds no blob of at least `MIN_PIXELS`.
    """
    if not blobs:
        return []
    sides = [max(b.right - b.left, b.bottom - b.top) + 2 * PAD for b in blobs]
    unequal = 3.0  # largest to smallest window of one stack: beyond it, padding costs more than another stack
    if max(sides) <= unequal * min(sides):
        return _measure_stack(image, table, bits, blobs, alone)
    found: list[Measured | None] = [None] * len(blobs)
    order = sorted(range(len(blobs)), key=sides.__getitem__)
    while order:
        limit = unequal * sides[order[0]]
        group = [i for i in order if sides[i] <= limit]
        order = order[len(group) :]
        results = _measure_stack(
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
    """Measure the blobs in windows of one size.

    `gap` empty rows and columns keep the windows apart where marker pixels meet their border.
    """
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
        Image,
        cv2.boxFilter(mask.view(np.uint8), -1, SIDE, normalize=False, borderType=cv2.BORDER_CONSTANT),
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
    colour = mean / WHITE
    windows = share.reshape(count, height, width)
    found: list[Measured | None] = []
    rows = zip(
        centre.tolist(),
        area.tolist(),
        contrast.tolist(),
        thin.tolist(),
        colour.tolist(),
        spread.tolist(),
        strict=True,
    )
    for i, (b, ((u, v), area, contrast, sliver, bgr, shape)) in enumerate(zip(blobs, rows, strict=True)):
        foreign = 0.0
        if sliver:
            if np.count_nonzero(own[i]) < MIN_PIXELS or area < 1.0:
                found.append(None)
                continue
            tile = own[i].reshape(height, width).view(np.uint8)
            rim = cv2.dilate(tile, SQUARE).reshape(-1) > tile.reshape(-1)
            foreign = np.count_nonzero(rim & others[i]) / max(np.count_nonzero(rim), 1)
        cut = _hangs_over(b, image) and _is_cut(own[i].reshape(height, width), b, image.shape)
        left, top = b.left - PAD, b.top - PAD
        found.append(
            Measured(
                left + u,
                top + v,
                area,
                contrast,
                bgr,
                cut,
                sliver,
                foreign,
                shape[0],
                shape[1],
                shape[2],
                windows[i],
                left,
                top,
            )
        )
    return found


def _cut_tiles(image: Image, blobs: Sequence[Blob], height: int, width: int) -> Image:
    """Cut the windows of the blobs, one below the other.

    (M * height, width, 4) BGRA; all 0 outside a window or the image.
    """
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
    """Clear the parts of the tiles (M, H, W) that are not the blob's.

    It is done where the blob's colour has other blobs.
    """
    for tile, b, lonely in zip(own, blobs, alone, strict=True):
        if lonely:
            continue
        parts = cast(
            tuple[int, Image],
            cv2.connectedComponents(tile.view(np.uint8), connectivity=8, ltype=cv2.CV_16U),
        )
        count, labels = parts
        # The blob's points of the grid lie inside its box by the width of the grid.
        rows = slice(PAD + SCALE - 1, max(PAD + b.bottom - b.top - SCALE + 1, PAD + SCALE))
        columns = slice(PAD + SCALE - 1, max(PAD + b.right - b.left - SCALE + 1, PAD + SCALE))
        mine = np.zeros(count, np.bool_)
        mine[labels[rows, columns]] = True
        tile &= mine[labels]


def _meets_border(own: Bool) -> bool:
    """Return whether marker colour lies near the border of a tile (M, H, W).

    Near means that a neighbourhood would reach over the border.
    """
    reach = SIDE[0] // 2
    return bool(own[:, :reach].any() or own[:, -reach:].any() or own[:, :, 0].any() or own[:, :, -1].any())


def _eroded(own: Bool, width: int) -> Bool:
    """Return the mask pixels whose four neighbours are all in the mask as well.

    The windows of `width` lie one below the other, flattened.
    """
    inner = own.copy()
    inner[1:] &= own[:-1]  # over the ends of the rows as well: nothing is in the mask there
    inner[:-1] &= own[1:]
    inner[width:] &= own[:-width]
    inner[:-width] &= own[width:]
    return inner


def _hangs_over(b: Blob, image: Image) -> bool:
    return b.left <= 0 or b.top <= 0 or b.right >= image.shape[1] or b.bottom >= image.shape[0]


def _is_cut(own: Bool, b: Blob, size: tuple[int, ...]) -> bool:
    rows, columns = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
    if rows.size == 0:
        return False
    left, top = b.left - PAD, b.top - PAD
    return bool(
        rows[0] + top <= 0
        or columns[0] + left <= 0
        or rows[-1] + top >= size[0] - 1
        or columns[-1] + left >= size[1] - 1
    )
