"""Rasterisation of polygons: smooth-edged capsules and exact pixel coverage.

Pixel (0, 0) is the centre of the top-left pixel, in OpenCV's drawing as everywhere here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from math import ceil, hypot

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image

Int32 = npt.NDArray[np.int32]
Float32 = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex128]

FIXED_BITS = 4
SUPER = 6
HALF_SUBPIXEL_PX = 0.5 / SUPER  # OpenCV's fill reaches half a pixel beyond the true edge
MAX_STEPS = 6
# Middles of 1 ... MAX_STEPS equal parts of an exposure of length 1, from its middle.
_MOMENTS = tuple((np.arange(n) + 0.5) / n - 0.5 for n in range(1, MAX_STEPS + 1))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Convex outline (N, 2) [px] in one image, with its velocity (2,) [px/s]."""

    corners: Float
    velocity: Float


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """A marker's outline and what hides it.

    Attributes:
        nearer: Everything that lies before it.
        cut: What it hides of itself (the finger before its cap); not part of its own outline.
    """

    outline: Shape
    nearer: Sequence[Shape] = ()
    cut: Shape | None = None

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """The outline, the cut if there is one, and what lies before them."""
        return (self.outline, *(() if self.cut is None else (self.cut,)), *self.nearer)


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
    """Outlines (..., 2 n, 2) [px] of disc pairs joined by their outer tangents.

    Complex numbers are points of the plane: e^(i angle) turns by an angle, its powers walk along an arc.
    """
    start, stop = _complex(a), _complex(b)
    between = stop - start
    distance = np.abs(between)
    swallowed = distance <= np.abs(radius_a - radius_b)
    if swallowed.any():  # the larger disc is the whole outline
        b_wins = radius_b > radius_a
        start, stop = np.where(swallowed & b_wins, stop, start), np.where(swallowed & ~b_wins, start, stop)
        larger = np.maximum(radius_a, radius_b)
        radius_a, radius_b = np.where(swallowed, larger, radius_a), np.where(swallowed, larger, radius_b)
    heading = np.where(distance > 0.0, between, 1.0) / np.where(distance > 0.0, distance, 1.0)
    cosine = (radius_a - radius_b) / np.maximum(distance, 1e-9)
    tangent = np.arccos(cosine)
    sine = np.sqrt(1.0 - cosine * cosine)
    arc_points = 8
    arcs = np.empty((*distance.shape, 2, arc_points), dtype=np.complex128)
    arcs[..., 0, 0] = radius_a * heading * (cosine + 1j * sine)
    arcs[..., 1, 0] = radius_b * heading * (cosine - 1j * sine)
    step = np.array([np.pi - tangent, tangent]) * (2.0j / (arc_points - 1))
    arcs[..., 1:] = np.moveaxis(np.exp(step), 0, -1)[..., None]
    arcs = arcs.cumprod(axis=-1)
    arcs[..., 0, :] += start[..., None]
    arcs[..., 1, :] += stop[..., None]
    return arcs.view(np.float64).reshape(*distance.shape, 2 * arc_points, 2)


def discs(centre: Float, radius: Float, circle: Float) -> Float:
    """Outlines (..., n, 2) [px] of discs (...) about (..., 2), by a `circle` (n, 2)."""
    points = _complex(centre)[..., None] + radius[..., None] * _complex(circle)
    return points.view(np.float64).reshape(*points.shape, 2)


def hull(points: Float) -> Float:
    """Convex hull (N, 2) [px] of points."""
    return np.asarray(cv2.convexHull(points.astype(np.float32)), dtype=np.float64).reshape(-1, 2)


def fixed(points: Float) -> Int32:
    """Corners as OpenCV's fixed-point numbers."""
    return np.rint(points * (1 << FIXED_BITS)).astype(np.int32)


def fill(image: Image, corners: Int32, colour: tuple[int, int, int]) -> None:
    """Fill a convex outline, smooth edges."""
    cv2.fillConvexPoly(image, corners, colour, lineType=cv2.LINE_AA, shift=FIXED_BITS)


def cover(markers: Sequence[Marker], exposure_s: float, size: tuple[int, int]) -> list[Coverage]:
    """Pixel coverage of each marker, drawn sixfold finer at moments of the exposure.

    `size` is width and height of the image [px]; what falls outside is not visible.
    """
    return [_covered(marker, exposure_s, size) for marker in markers]


def _covered(marker: Marker, exposure_s: float, size: tuple[int, int]) -> Coverage:
    shapes, outline = marker.shapes, marker.outline
    counts = [len(shape.corners) for shape in shapes]
    starts = [0, *accumulate(counts)]
    owner = np.repeat(np.arange(len(shapes)), counts)
    corners = np.concatenate([shape.corners for shape in shapes])
    # Towards their shape's centre by what the fill adds.
    spread = corners - (np.add.reduceat(corners, starts[:-1]) / np.array(counts)[:, None])[owner]
    inset = HALF_SUBPIXEL_PX / np.maximum(np.hypot(spread[:, 0], spread[:, 1])[:, None], 1e-6)
    inside = corners - spread * np.minimum(inset, 1.0)
    offsets_s = moments(outline, exposure_s)
    room_px = 2.0  # around what a marker covers
    reach = offsets_s[-1] * np.abs(outline.velocity) + room_px
    x0, y0 = np.floor(outline.corners.min(axis=0) - reach).astype(int).tolist()
    x1, y1 = (np.ceil(outline.corners.max(axis=0) + reach).astype(int) + 1).tolist()
    scale = SUPER << FIXED_BITS
    speed = np.array([shape.velocity for shape in shapes])[owner] * scale
    moved = (inside + (0.5 - 0.5 / SUPER)) * scale + offsets_s[:, None, None] * speed
    moved -= (x0 * scale, y0 * scale)
    level = 255 // len(moved)
    total = np.zeros(((y1 - y0) * SUPER, (x1 - x0) * SUPER), dtype=np.uint8)
    own, own_parts = 0, 1 if marker.cut is None else 2
    for moment in np.rint(moved).astype(np.int32):
        mask = np.zeros_like(total)
        for k, (a, b) in enumerate(pairwise(starts)):
            cv2.fillConvexPoly(mask, moment[a:b], 0 if k else level, lineType=cv2.LINE_8, shift=FIXED_BITS)
            if k == own_parts - 1:
                own += cv2.countNonZero(mask)
        cv2.add(total, mask, dst=total)
    (width, height), seen = size, np.zeros_like(total)
    rows, columns = (
        slice(max(-first, 0) * SUPER, max(min(last, side) - first, 0) * SUPER)
        for first, last, side in ((y0, y1, height), (x0, x1, width))
    )
    seen[rows, columns] = total[rows, columns]  # not what is outside of the image
    fine = cv2.resize(seen, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    alpha = fine * np.float32(1.0 / (level * len(moved)))
    return Coverage(x0, y0, alpha, cv2.sumElems(seen)[0] / level / own if own else 0.0)


def moments(shape: Shape, exposure_s: float) -> Float:
    """Moments (n,) [s] from mid-exposure to draw at: about one per pixel of motion."""
    way = hypot(*shape.velocity.tolist()) * exposure_s
    blur_step_px = 1.2
    n = min(max(ceil(way / blur_step_px), 1), MAX_STEPS)
    return _MOMENTS[n - 1] * exposure_s


def centroid(coverage: Coverage) -> Float:
    """Centroid (2,) [px] of what is visible; NaN where nothing is."""
    total = float(coverage.alpha.sum())
    if total <= 0.0:
        return np.full(2, np.nan)
    columns, rows = coverage.alpha.sum(axis=0), coverage.alpha.sum(axis=1)
    u = float(columns @ np.arange(len(columns))) / total + coverage.x
    v = float(rows @ np.arange(len(rows))) / total + coverage.y
    return np.array([u, v])


def _complex(points: Float) -> Complex:
    """Points (..., 2) of the plane as complex numbers (...)."""
    return np.ascontiguousarray(points).view(np.complex128)[..., 0]


def overlaps(low_a: Float, high_a: Float, low_b: Float, high_b: Float) -> Bool:
    """Whether boxes (..., 2) share a point."""
    return np.asarray(((low_a <= high_b) & (low_b <= high_a)).all(axis=-1))
