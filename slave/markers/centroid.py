"""Measure the sub-pixel centroid of the visible paint of every marker, in small windows of the full-resolution image.

A threshold knows whole pixels only. At the rim a pixel holds paint and surroundings in proportion to the covered
area, and light adds linearly, so in linear light the share is measurable:

1. The colour table gives the mask; its components that belong to the marker are joined, small holes are filled
   (a highlight is white), and it falls into core (surely paint), rim (unsure) and ring (surely not paint).
2. Fisher's linear discriminant between core and ring, w = (S_core + S_ring)^-1 (m_core - m_ring), is the colour
   direction along which both vary least: skin on one side and table on the other both become 0.
3. Share of a rim pixel = its coordinate along w, 0 at the ring's mean and 1 at the level of the core nearby (paint
   is darker towards the silhouette), clipped; the core counts as 1, so neither shading nor highlights inside it
   move the centroid; the interior of other markers counts as 0.
4. Centroid and area are the moments of the shares.

All windows lie in one stack of tiles, so that a step costs one call, not one per marker. (Fisher 1936.)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias, cast

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from slave.markers.blobs import FRAGMENT_GAP, FRAGMENT_SHARE, Blob
from slave.markers.classify import ColourTable

Float32: TypeAlias = npt.NDArray[np.float32]

PAD = 8  # px around the scanned box: 2 for the decimation, 5 for rim and ring, 1 to keep tiles apart
RIM = cv2.getStructuringElement(cv2.MORPH_RECT, (7, 7))
RING = cv2.getStructuringElement(cv2.MORPH_RECT, (5, 5))
SQUARE = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
# Added to the variances: one grey level of noise, so that a flat colour stays solvable.
NOISE = 4e-6 * np.eye(3)
# The six different products of three channels, and where each stands in the symmetric 3 x 3 matrix.
PAIR_A, PAIR_B = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])
PAIR_OF = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
MIN_PIXELS = 4  # a covariance of three channels needs four
SHADING = (9, 9)  # px over which the shading of the paint is followed
FAINT = 0.02  # weight of the mean level where no core is near
UNEQUAL = 3.0  # largest to smallest window of one stack: beyond it, padding costs more than another stack


def _linear_light() -> Float32:
    """sRGB code value -> linear light 0..1 (IEC 61966-2-1)."""
    s = np.arange(256) / 255.0
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4).astype(np.float32)


LINEAR = _linear_light()


@dataclass(frozen=True, slots=True)
class Measured:
    """One marker, measured.

    Attributes:
        u, v: Centroid of the visible paint [px], distorted image.
        area: Visible area [px^2].
        contrast: Distance between core and ring in standard deviations of their spread.
        cut: The mask touches the border of the image.
        thin: Hardly a pixel of the mask is surrounded by mask: a sliver, or a colour fringe.
        foreign: Share of the mask's neighbour pixels that have another marker's colour.
    """

    u: float
    v: float
    area: float
    contrast: float
    cut: bool
    thin: bool
    foreign: float


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """Windows of equal size around M blobs: image (M, H, W, 3), corner (M, 2) = left, top; may hang over the image."""

    tiles: Image
    left: list[int]
    top: list[int]
    whole: bool


def measure(
    image: Image, table: ColourTable, bits: Sequence[int], blobs: Sequence[Blob], extents: Sequence[float]
) -> list[Measured | None]:
    """Measure the markers at `blobs`.

    Args:
        image: (H, W, 3) BGR, full resolution.
        table: Colour table of the camera.
        bits: Bit in the table of each blob's marker.
        blobs: Where the scan saw them.
        extents: Largest width or height of each whole marker [px], as far as known, else inf; fragments
            that lie farther apart are not joined.

    Returns:
        One measurement per blob; None where the window holds no blob of at least `MIN_PIXELS`.
    """
    found: list[Measured | None] = [None] * len(blobs)
    order = sorted(range(len(blobs)), key=lambda i: _side(blobs[i]))
    while order:
        limit = UNEQUAL * _side(blobs[order[0]])
        group = [i for i in order if _side(blobs[i]) <= limit]
        order = [i for i in order if _side(blobs[i]) > limit]
        members = [blobs[i] for i in group]
        results = _measure_stack(image, table, [bits[i] for i in group], members, [extents[i] for i in group])
        for i, result in zip(group, results, strict=True):
            found[i] = result
    return found


def _side(blob: Blob) -> int:
    return max(blob.right - blob.left, blob.bottom - blob.top) + 2 * PAD


def _cut_tiles(image: Image, blobs: Sequence[Blob]) -> _Stack:
    height = max(b.bottom - b.top for b in blobs) + 2 * PAD
    width = max(b.right - b.left for b in blobs) + 2 * PAD
    tiles = np.zeros((len(blobs), height, width, 3), np.uint8)
    lefts: list[int] = []
    tops: list[int] = []
    whole = True
    for tile, b in zip(tiles, blobs, strict=True):
        left, top = (b.left + b.right - width) // 2, (b.top + b.bottom - height) // 2
        x, y = max(left, 0), max(top, 0)
        part = image[y : top + height, x : left + width]
        tile[y - top : y - top + part.shape[0], x - left : x - left + part.shape[1]] = part
        whole = whole and part.shape[:2] == (height, width)
        lefts.append(left)
        tops.append(top)
    return _Stack(tiles, lefts, tops, whole)


def _measure_stack(
    image: Image, table: ColourTable, bits: Sequence[int], blobs: Sequence[Blob], extents: Sequence[float]
) -> list[Measured | None]:
    stack = _cut_tiles(image, blobs)
    count, height, width = stack.tiles.shape[:3]
    flat = stack.tiles.reshape(count * height, width, 3)
    codes = table.codes(flat).reshape(count, height, width)
    own = (codes & np.array(bits, codes.dtype)[:, None, None]) != 0
    own[:, 0] = False  # an empty row keeps the tiles' components apart
    mask = own.view(np.uint8).reshape(flat.shape[:2])
    mask, pixels = _joined(mask, stack, blobs, extents)
    others = (codes.reshape(mask.shape) != 0).view(np.uint8) & (mask ^ 1)
    filled = cast(Image, cv2.morphologyEx(mask, cv2.MORPH_CLOSE, CROSS))
    core = cast(Image, cv2.erode(filled, CROSS))
    shape = (count, height, width)
    core_pixels = np.count_nonzero(core.reshape(count, -1), axis=1)
    for i in np.flatnonzero(core_pixels < MIN_PIXELS):
        core.reshape(shape)[i] = filled.reshape(shape)[i]
    near = cast(Image, cv2.dilate(filled, SQUARE)) ^ filled
    outer = cast(Image, cv2.dilate(filled, RIM))
    ring = cast(Image, cv2.dilate(outer, RING)) ^ outer
    inside = cast(Image, cv2.morphologyEx(others, cv2.MORPH_OPEN, SQUARE))  # a colour fringe is thinner
    ring &= inside ^ 1
    outer &= inside ^ 1
    if not stack.whole:
        _blank_outside(ring.reshape(shape), stack, image.shape)
    share, contrast = _shares(flat, core.reshape(shape), ring.reshape(shape), outer)
    share = share.reshape(shape)
    rows, columns = share.sum(axis=2), share.sum(axis=1)
    area = rows.sum(axis=1, dtype=np.float64)
    whole = np.maximum(area, 1.0)  # smaller ones are dropped below
    u = columns @ np.arange(width, dtype=np.float64) / whole + stack.left
    v = rows @ np.arange(height, dtype=np.float64) / whole + stack.top
    fringed = np.count_nonzero((near & others).reshape(count, -1), axis=1)
    foreign = fringed / np.maximum(np.count_nonzero(near.reshape(count, -1), axis=1), 1)
    cut = [not stack.whole and _is_cut(filled.reshape(shape)[i], stack, i, image.shape) for i in range(count)]
    return [
        Measured(
            u=float(u[i]),
            v=float(v[i]),
            area=float(area[i]),
            contrast=float(contrast[i]),
            cut=cut[i],
            thin=bool(core_pixels[i] < MIN_PIXELS),
            foreign=float(foreign[i]),
        )
        if pixels[i] >= MIN_PIXELS and area[i] >= 1.0
        else None
        for i in range(count)
    ]


def _joined(
    mask: Image, stack: _Stack, blobs: Sequence[Blob], extents: Sequence[float]
) -> tuple[Image, list[int]]:
    """The mask with only the components that are the markers, and their pixel counts.

    Of each tile: the component that covers most of the blob's own box, and the fragments near it.
    """
    height = stack.tiles.shape[1]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    rows = cast(list[list[int]], stats.tolist())  # left, top, width, height, area
    tile_of = [row[1] // height for row in rows]
    parts: list[list[int]] = [[] for _ in blobs]
    for label in range(1, count):
        parts[tile_of[label]].append(label)
    keep = np.zeros(count, np.uint8)
    pixels = [0] * len(blobs)
    for i, labels_here in enumerate(parts):
        blob, left, top = blobs[i], stack.left[i], stack.top[i] - i * height
        mine = [k for k in labels_here if _touches(rows[k], blob, left, top)]
        if not mine:
            continue
        best = max(mine, key=lambda k: rows[k][4])
        chosen = [best]
        if len(labels_here) > 1:
            chosen = _with_fragments(best, labels_here, rows, extents[i])
        keep[chosen] = 1
        pixels[i] = sum(rows[k][4] for k in chosen)
    if keep[1:].all():
        return mask, pixels
    return keep.take(cast(Image, labels)), pixels


def _touches(row: list[int], blob: Blob, left: int, top: int) -> bool:
    x, y = row[0] + left, row[1] + top
    return x < blob.right and y < blob.bottom and x + row[2] > blob.left and y + row[3] > blob.top


def _with_fragments(best: int, labels: list[int], rows: list[list[int]], extent: float) -> list[int]:
    """`best` and the components that a highlight or something in front split from it."""
    x0, y0, w, h, area = rows[best]
    x1, y1 = x0 + w, y0 + h
    reach = FRAGMENT_GAP * area**0.5
    chosen = [best]
    for k in sorted(labels, key=lambda k: -rows[k][4]):
        x, y, w, h, part = rows[k]
        if k == best or part < max(MIN_PIXELS, FRAGMENT_SHARE * area):
            continue
        gap = max(x - x1, x0 - x - w, y - y1, y0 - y - h)
        left, top, right, bottom = min(x0, x), min(y0, y), max(x1, x + w), max(y1, y + h)
        if gap <= reach and max(right - left, bottom - top) <= extent:
            chosen.append(k)
            x0, y0, x1, y1 = left, top, right, bottom
    return chosen


def _blank_outside(ring: Image, stack: _Stack, size: tuple[int, ...]) -> None:
    for i, (left, top) in enumerate(zip(stack.left, stack.top, strict=True)):
        ring[i, : max(-top, 0)] = 0
        ring[i, max(size[0] - top, 0) :] = 0
        ring[i, :, : max(-left, 0)] = 0
        ring[i, :, max(size[1] - left, 0) :] = 0


def _is_cut(filled: Image, stack: _Stack, i: int, size: tuple[int, ...]) -> bool:
    left, top = stack.left[i], stack.top[i]
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    if rows.size == 0:
        return False
    return bool(
        rows[0] + top <= 0
        or columns[0] + left <= 0
        or rows[-1] + top >= size[0] - 1
        or columns[-1] + left >= size[1] - 1
    )


def _shares(tiles: Image, core: Image, ring: Image, rim: Image) -> tuple[Float32, Float]:
    """Share of paint of every pixel, and the contrast between core and ring.

    Args:
        tiles: (M * H, W, 3) BGR.
        core, ring: (M, H, W) 0 or 1.
        rim: (M * H, W) 0 or 1, where paint is possible.

    Returns:
        Shares (M * H, W) 0..1, and contrasts (M,).
    """
    count = len(core)
    light = cast(Float32, cv2.LUT(tiles, LINEAR))
    colours = light.reshape(count, -1, 3)
    w, zero, contrast = _discriminants(light.reshape(-1, 3), core.reshape(count, -1), ring.reshape(count, -1))
    along = (colours @ w[:, :, None])[:, :, 0]
    along -= zero[:, None]
    along = along.reshape(rim.shape)
    weight = core.reshape(rim.shape).astype(np.float32)
    level = cast(Float32, cv2.blur(along * weight, SHADING))
    level += FAINT
    level /= cast(Float32, cv2.blur(weight, SHADING)) + np.float32(FAINT)
    np.maximum(level, 0.3, out=level)
    along /= level
    np.clip(along, 0.0, 1.0, out=along)
    along *= rim
    np.maximum(along, weight, out=along)
    return along, contrast


def _discriminants(light: Float32, core: Image, ring: Image) -> tuple[Float32, Float32, Float]:
    """Of each tile the direction (M, 3), offset (M,) and contrast (M,) of the discriminant that is 0 at the
    ring's mean and 1 at the core's; all zero where core or ring is empty.

    Args:
        light: (M * P, 3) linear light of all tiles.
        core, ring: (M, P) 0 or 1.
    """
    count = len(core)
    w, zero, contrast = np.zeros((count, 3), np.float32), np.zeros(count, np.float32), np.zeros(count)
    usable = np.flatnonzero(core.any(axis=1) & ring.any(axis=1))
    if not usable.size:
        return w, zero, contrast
    if usable.size < count:
        light = np.ascontiguousarray(light.reshape(count, -1, 3)[usable]).reshape(-1, 3)
        core, ring = core[usable], ring[usable]
    mean_in, spread_in = _moments(light, core)
    mean_out, spread_out = _moments(light, ring)
    step = mean_in - mean_out
    direction = np.linalg.solve(spread_in + spread_out + NOISE, step[:, :, None])[:, :, 0]
    distance = np.maximum((direction * step).sum(axis=1), 1e-6)
    direction /= distance[:, None]
    w[usable] = direction
    zero[usable] = (direction * mean_out).sum(axis=1)
    contrast[usable] = np.sqrt(distance)
    return w, zero, contrast


def _moments(light: Float32, mask: Image) -> tuple[Float, Float]:
    """Mean (M, 3) and covariance (M, 3, 3) of the light under the mask of each tile; no mask is empty."""
    planes = np.ascontiguousarray(light.take(np.flatnonzero(mask.reshape(-1)), axis=0).T)
    number = np.count_nonzero(mask, axis=1)
    starts = np.zeros(len(mask), np.intp)
    np.cumsum(number[:-1], out=starts[1:])
    mean = np.add.reduceat(planes, starts, axis=1) / number
    planes -= np.repeat(mean.astype(np.float32), number, axis=1)
    second = np.add.reduceat(planes[PAIR_A] * planes[PAIR_B], starts, axis=1) / number
    return mean.T, second[PAIR_OF].transpose(2, 0, 1)
