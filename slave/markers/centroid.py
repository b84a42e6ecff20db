"""Measure the sub-pixel centroid of the visible paint of one marker, in a small window of the full-resolution image.

A threshold knows whole pixels only. At the rim a pixel holds paint and surroundings in proportion to the covered
area, and light adds linearly, so in linear light the share is measurable:

1. The colour table gives the mask; its components that belong to the marker are joined, small holes are filled
   (a highlight is white), and it falls into core (surely paint), rim (unsure) and ring (surely not paint).
2. Fisher's linear discriminant between core and ring, w = (S_core + S_ring)^-1 (m_core - m_ring), is the colour
   direction along which both vary least: skin on one side and table on the other both become 0.
3. Share of a rim pixel = its coordinate along w, 0 at the ring's mean and 1 at the core's, clipped; the core counts
   as 1, so neither shading nor highlights inside it move the centroid; other markers' pixels count as 0.
4. Centroid and area are the moments of the shares.

(Fisher 1936; the partial area effect: Trinder 1989.)
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Image
from slave.markers.blobs import Blob
from slave.markers.classify import ColourTable

PAD = 9  # px around the scanned box: 2 for the decimation, the rim, and the ring
RIM = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
RING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
SQUARE = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
NOISE = 4e-6  # added to the variances: one grey level of noise, so that a flat colour stays solvable
MIN_PIXELS = 4
SHADING = (9, 9)  # px over which the shading of the paint is followed
FAINT = 0.02  # weight of the mean level where no core is near


def _linear_light() -> np.ndarray[tuple[int], np.dtype[np.float32]]:
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
        thin: No pixel of the mask is surrounded by mask: a sliver, or a colour fringe.
        foreign: Share of the mask's neighbour pixels that belong to another marker.
    """

    u: float
    v: float
    area: float
    contrast: float
    cut: bool
    thin: bool
    foreign: float


def measure(image: Image, table: ColourTable, bit: int, blob: Blob, extent: float = np.inf) -> Measured | None:
    """Measure the marker at `blob`.

    Args:
        image: (H, W, 3) BGR, full resolution.
        table: Colour table of the camera.
        bit: Bit of the marker in the table.
        blob: Where the scan saw it.
        extent: Largest width or height of the whole marker [px], as far as known; fragments farther apart
            are not joined.

    Returns:
        The measurement, or None if the window holds no blob of at least `MIN_PIXELS`.
    """
    left, top = max(blob.left - PAD, 0), max(blob.top - PAD, 0)
    window = image[top : blob.bottom + PAD, left : blob.right + PAD]
    codes = table.codes(window)
    mask = ((codes & bit) != 0).view(np.uint8)
    mask = _joined(mask, blob, left, top, extent)
    if mask is None:
        return None
    filled = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, CROSS)
    core = cv2.erode(filled, CROSS, borderType=cv2.BORDER_REPLICATE)
    thin = cv2.countNonZero(core) < MIN_PIXELS
    if thin:
        core = filled
    outer = cv2.dilate(filled, RIM)
    ring = cv2.dilate(outer, RING) ^ outer
    others = ((codes != 0) & (filled == 0) & ((codes & bit) == 0)).view(np.uint8)
    fringed = others
    others = cv2.morphologyEx(others, cv2.MORPH_OPEN, SQUARE)  # a colour fringe is thinner than a marker
    ring &= others ^ 1
    share, contrast = _shares(window, core, ring, outer & (others ^ 1))
    m = cv2.moments(share)
    if m["m00"] < 1.0:
        return None
    neighbours = cv2.dilate(filled, CROSS) ^ filled
    near = cv2.countNonZero(neighbours)
    height, width = image.shape[:2]
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    cut = bool(
        top + rows[0] == 0 or left + columns[0] == 0 or top + rows[-1] == height - 1 or left + columns[-1] == width - 1
    )
    return Measured(
        u=left + m["m10"] / m["m00"],
        v=top + m["m01"] / m["m00"],
        area=m["m00"],
        contrast=contrast,
        cut=cut,
        thin=thin,
        foreign=cv2.countNonZero(neighbours & fringed) / near if near else 0.0,
    )


def _joined(mask: Image, blob: Blob, left: int, top: int, extent: float) -> Image | None:
    """The components of `mask` that are the marker at `blob`: the largest and the fragments near it."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    if count == 1:
        return None
    areas = stats[1:, cv2.CC_STAT_AREA]
    best = int(areas.argmax()) + 1
    if stats[best, cv2.CC_STAT_AREA] < MIN_PIXELS:
        return None
    return mask if count == 2 else (labels == best).view(np.uint8)


def _shares(
    window: Image, core: Image, ring: Image, rim: Image
) -> tuple[np.ndarray[tuple[int, int], np.dtype[np.float32]], float]:
    """Share of paint (H, W) 0..1 of every pixel, and the contrast between core and ring."""
    light = cv2.LUT(window, LINEAR)
    flat = light.reshape(-1, 3)
    inside, outside = flat[core.reshape(-1) != 0], flat[ring.reshape(-1) != 0]
    if len(outside) < 3:  # the marker fills the window: nothing to compare with
        return core.astype(np.float32), 0.0
    mean_in, mean_out = inside.mean(axis=0), outside.mean(axis=0)
    a, b = inside - mean_in, outside - mean_out
    spread = a.T @ a / len(a) + b.T @ b / len(b)
    spread.flat[::4] += NOISE
    step = (mean_in - mean_out).astype(np.float64)
    w = np.linalg.solve(spread.astype(np.float64), step)
    distance = float(w @ step)
    if distance <= 0.0:
        return core.astype(np.float32), 0.0
    along = light @ (w / distance).astype(np.float32) - np.float32(w @ mean_out / distance)
    # Paint is darker towards the silhouette: the level of full paint is that of the core nearby.
    weight = core.astype(np.float32)
    level = (cv2.blur(along * weight, SHADING) + FAINT) / (cv2.blur(weight, SHADING) + FAINT)
    share = np.clip(along / np.maximum(level, 0.3), 0.0, 1.0) * rim
    share[core != 0] = 1.0
    return share, math.sqrt(distance)
