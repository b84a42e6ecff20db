"""Polygons to pixels: capsules drawn with smooth edges, and the exact share of each pixel that a marker covers.

Pixel (0, 0) is the centre of the top-left pixel, in OpenCV's drawing as everywhere here.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image

Int32 = npt.NDArray[np.int32]
Float32 = npt.NDArray[np.float32]

FIXED_BITS = 4
SUPER = 6
HALF_SUBPIXEL_PX = 0.5 / SUPER  # OpenCV's fill reaches half a pixel beyond the true edge
ARC_POINTS = 8
BLUR_STEP_PX = 1.2
MAX_STEPS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A convex outline in one image: corners (N, 2) [px] and how fast it moves (2,) [px/s]."""

    corners: Float
    velocity: Float


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What one marker covers.

    Attributes:
        x, y: Pixel of the window's top left corner; may lie outside the image.
        alpha: (h, w) share of every pixel that shows the marker, 0..1, averaged over the exposure.
        share: Visible part of the marker's own outline, 0..1.
    """

    x: int
    y: int
    alpha: Float32
    share: float


def capsules(a: Float, radius_a: Float, b: Float, radius_b: Float) -> Float:
    """Outlines (..., 2 n, 2) [px] of discs at `a` and `b` (..., 2) joined by their outer tangents."""
    between = b - a
    distance = np.hypot(between[..., 0], between[..., 1])
    swallowed = distance <= np.abs(radius_a - radius_b)
    b_wins = (swallowed & (radius_b > radius_a))[..., None]
    a_wins = (swallowed & (radius_b <= radius_a))[..., None]
    a, b = np.where(b_wins, b, a), np.where(a_wins, a, b)
    radius_a, radius_b = (
        np.where(b_wins[..., 0], radius_b, radius_a),
        np.where(a_wins[..., 0], radius_a, radius_b),
    )
    heading = np.arctan2(between[..., 1], between[..., 0])
    ratio = np.where(swallowed, 0.0, (radius_a - radius_b) / np.maximum(distance, 1e-9))
    tangent = np.arccos(np.clip(ratio, -1.0, 1.0))
    step = np.linspace(0.0, 1.0, ARC_POINTS)
    arc_a = (heading + tangent)[..., None] + (2.0 * (np.pi - tangent))[..., None] * step
    arc_b = (heading - tangent)[..., None] + (2.0 * tangent)[..., None] * step
    side_a = a[..., None, :] + radius_a[..., None, None] * np.stack([np.cos(arc_a), np.sin(arc_a)], axis=-1)
    side_b = b[..., None, :] + radius_b[..., None, None] * np.stack([np.cos(arc_b), np.sin(arc_b)], axis=-1)
    return np.concatenate([side_a, side_b], axis=-2)


def hull(points: Float) -> Float:
    """Convex hull (N, 2) [px] of points."""
    return np.asarray(cv2.convexHull(points.astype(np.float32)), dtype=np.float64).reshape(-1, 2)


def fixed(points: Float) -> Int32:
    """Corners as OpenCV's fixed-point numbers."""
    return np.rint(points * (1 << FIXED_BITS)).astype(np.int32)


def fill(image: Image, corners: Int32, colour: tuple[int, int, int]) -> None:
    """Fill a convex outline, smooth edges."""
    cv2.fillConvexPoly(image, corners, colour, lineType=cv2.LINE_AA, shift=FIXED_BITS)


def cover(
    outline: Shape, cut: Shape | None, nearer: Sequence[Shape], offsets_s: Float, size: tuple[int, int]
) -> Coverage:
    """Measure what an outline covers, by drawing at six times the resolution at each moment of the exposure.

    Args:
        outline: The marker.
        cut: What the marker hides of itself (the finger before its cap); not part of its own outline.
        nearer: Everything that lies before it.
        offsets_s: Moments (n,) of the exposure, relative to its middle [s], at most 8.
        size: Width and height of the image [px]; what falls outside is not visible.
    """
    reach = float(np.abs(offsets_s).max()) * np.abs(outline.velocity) + 2.0
    low = np.floor(outline.corners.min(axis=0) - reach).astype(int)
    high = np.ceil(outline.corners.max(axis=0) + reach).astype(int) + 1
    origin = low - 0.5 + 0.5 / SUPER
    shape = tuple((high - low)[::-1] * SUPER)
    drawn = _inset(outline.corners)
    others = [Shape(_inset(other.corners), other.velocity) for other in nearer]
    own_cut = None if cut is None else Shape(_inset(cut.corners), cut.velocity)
    level = 255 // len(offsets_s)
    total: Image | None = None
    own = 0
    for offset in offsets_s:
        mask = np.zeros(shape, dtype=np.uint8)
        _fill_fine(mask, drawn + offset * outline.velocity - origin, level)
        if own_cut is not None:
            _fill_fine(mask, own_cut.corners + offset * own_cut.velocity - origin, 0)
        own += cv2.countNonZero(mask)
        for other in others:
            _fill_fine(mask, other.corners + offset * other.velocity - origin, 0)
        total = mask if total is None else np.asarray(cv2.add(total, mask), dtype=np.uint8)
    assert total is not None
    _blank_outside(total, low, high, size)
    seen = float(cv2.sumElems(total)[0]) / level
    fine = cv2.resize(total, tuple(high - low), interpolation=cv2.INTER_AREA)
    alpha = fine.astype(np.float32) * np.float32(1.0 / (level * len(offsets_s)))
    return Coverage(int(low[0]), int(low[1]), alpha, seen / own if own else 0.0)


def moments(shape: Shape, exposure_s: float) -> Float:
    """Moments (n,) of an exposure, from its middle [s], at which a shape is drawn: about one per pixel of way."""
    n = int(np.clip(np.ceil(np.hypot(*shape.velocity) * exposure_s / BLUR_STEP_PX), 1, MAX_STEPS))
    return ((np.arange(n) + 0.5) / n - 0.5) * exposure_s


def centroid(coverage: Coverage) -> Float:
    """Centroid (2,) [px] of what is visible; NaN where nothing is."""
    total = float(coverage.alpha.sum())
    if total <= 0.0:
        return np.full(2, np.nan)
    columns, rows = coverage.alpha.sum(axis=0), coverage.alpha.sum(axis=1)
    u = float(columns @ np.arange(len(columns))) / total + coverage.x
    v = float(rows @ np.arange(len(rows))) / total + coverage.y
    return np.array([u, v])


def _inset(corners: Float) -> Float:
    """Corners moved inwards by what the fill adds."""
    spread = corners - corners.mean(axis=0)
    reach = np.hypot(spread[:, 0], spread[:, 1])[:, None]
    return corners - spread * np.minimum(HALF_SUBPIXEL_PX / np.maximum(reach, 1e-6), 1.0)


def _fill_fine(mask: Image, points: Float, level: int) -> None:
    cv2.fillConvexPoly(mask, fixed(points * SUPER), level, lineType=cv2.LINE_8, shift=FIXED_BITS)


def _blank_outside(
    mask: Image, low: npt.NDArray[np.int_], high: npt.NDArray[np.int_], size: tuple[int, int]
) -> None:
    width, height = size
    if low[0] < 0:
        mask[:, : -low[0] * SUPER] = 0
    if low[1] < 0:
        mask[: -low[1] * SUPER] = 0
    if high[0] > width:
        mask[:, max(width - low[0], 0) * SUPER :] = 0
    if high[1] > height:
        mask[max(height - low[1], 0) * SUPER :] = 0


def overlaps(low_a: Float, high_a: Float, low_b: Float, high_b: Float) -> Bool:
    """Whether boxes (..., 2) share a point."""
    return np.asarray(((low_a <= high_b) & (low_b <= high_a)).all(axis=-1))
