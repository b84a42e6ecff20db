"""All parts of one kind of an object's surface, as arrays.

They give distances to them, nearest points on them, and intersections of rays with them.

Each part is about its own origin, along its own axes. Coordinates come first in `own` (K, D, N), so that sums over them
are sums of rows: a hand asks for hundreds of points at once, and most of what that costs is the number of calls.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from common.arrays import Float, Int
from common.calibration.object_profile import BoxShape, CylinderShape, Shape, SphereShape

_GRAZES_M = 1e-3  # a sight that goes no deeper is not hidden: a tag lies on the surface itself
_TINY = 1e-12


class Parts(Protocol):
    """K parts of one kind. Hold no state."""

    def distances(self, own: Float) -> Float:
        """(K, N) [m], negative inside, of points (K, 3, N) in the frame of each part."""
        ...

    def feet(self, part: Int, own: Float) -> Float:
        """Return nearest points (N, 3) on the surfaces of parts (N,) to points (N, 3).

        Each is in the frame of its part.
        """
        ...

    def through(self, start: Float, way: Float) -> tuple[Float, Float]:
        """Return from where to where rays are inside a part.

        The rays are ways (K, 3, N) from starts (K, 3); inside is a little below the part's skin.

        Both (K, N) are shares of the way; where the second is not above the first, the sight passes by.
        """
        ...


class Boxes:
    """Boxes, by the halves of their sides (K, 3)."""

    def __init__(self, shapes: Sequence[BoxShape]) -> None:
        self._half = 0.5 * np.array([shape.size_m for shape in shapes])

    def distances(self, own: Float) -> Float:
        """As of `Parts`."""
        deep = np.abs(own) - self._half[:, :, None]
        off = np.maximum(deep, 0.0)
        return np.sqrt((off * off).sum(axis=1)) + np.minimum(deep.max(axis=1), 0.0)

    def feet(self, part: Int, own: Float) -> Float:
        """As of `Parts`."""
        return _feet_of_box(self._half[part], own)

    def through(self, start: Float, way: Float) -> tuple[Float, Float]:
        """As of `Parts`."""
        return _through_slabs(self._half - _GRAZES_M, start, way)


class Cylinders:
    """Closed cylinders along z, by radius and half their length."""

    def __init__(self, shapes: Sequence[CylinderShape]) -> None:
        self._size = np.array([[shape.radius_m, 0.5 * shape.length_m] for shape in shapes])

    def distances(self, own: Float) -> Float:
        """As of `Parts`: in the plane of axis and point a cylinder is a box."""
        x, y, z = own.swapaxes(0, 1)
        out = np.sqrt(x * x + y * y) - self._size[:, :1]
        up = np.abs(z) - self._size[:, 1:]
        side, end = np.maximum(out, 0.0), np.maximum(up, 0.0)
        return np.sqrt(side * side + end * end) + np.minimum(np.maximum(out, up), 0.0)

    def feet(self, part: Int, own: Float) -> Float:
        """As of `Parts`."""
        out = np.sqrt(np.vecdot(own[:, :2], own[:, :2]))
        foot = _feet_of_box(self._size[part], np.stack([out, own[:, 2]], axis=1))
        return np.concatenate([foot[:, :1] * _unit(own[:, :2], out), foot[:, 1:]], axis=1)

    def through(self, start: Float, way: Float) -> tuple[Float, Float]:
        """As of `Parts`."""
        side = _through_round(self._size[:, 0] - _GRAZES_M, start[:, :2], way[:, :2])
        ends = _through_slabs(self._size[:, 1:] - _GRAZES_M, start[:, 2:], way[:, 2:])
        return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])


class Balls:
    """Balls, by their radii (K,)."""

    def __init__(self, shapes: Sequence[SphereShape]) -> None:
        self._radius = np.array([shape.radius_m for shape in shapes])

    def distances(self, own: Float) -> Float:
        """As of `Parts`."""
        return np.sqrt((own * own).sum(axis=1)) - self._radius[:, None]

    def feet(self, part: Int, own: Float) -> Float:
        """As of `Parts`."""
        return self._radius[part, None] * _unit(own, np.sqrt(np.vecdot(own, own)))

    def through(self, start: Float, way: Float) -> tuple[Float, Float]:
        """As of `Parts`."""
        return _through_round(self._radius - _GRAZES_M, start, way)


def by_kind(shapes: Sequence[Shape]) -> list[tuple[list[Shape], Parts]]:
    """The parts of each kind that there is."""
    boxes = [shape for shape in shapes if isinstance(shape, BoxShape)]
    bars = [shape for shape in shapes if isinstance(shape, CylinderShape)]
    balls = [shape for shape in shapes if isinstance(shape, SphereShape)]
    kinds: list[tuple[list[Shape], Parts]] = []
    if bars:
        kinds.append(([*bars], Cylinders(bars)))
    if boxes:
        kinds.append(([*boxes], Boxes(boxes)))
    if balls:
        kinds.append(([*balls], Balls(balls)))
    return kinds


def _feet_of_box(half: Float, points: Float) -> Float:
    """Return nearest points (N, D) on the surfaces of boxes.

    The boxes have these halves of their sides (N, D), of any dimension.
    """
    foot = np.minimum(np.maximum(points, -half), half)
    inside = np.flatnonzero((foot == points).all(axis=1))
    if len(inside):
        own, most = points[inside], half[inside]
        rows: Int = np.arange(len(inside))
        face: Int = np.argmin(most - np.abs(own), axis=1)
        foot[inside, face] = np.where(own[rows, face] < 0.0, -most[rows, face], most[rows, face])
    return foot


def _through_slabs(half: Float, start: Float, way: Float) -> tuple[Float, Float]:
    """Intersect rays with slabs, as `Parts.through`.

    The slabs are between planes at plus and minus `half` (K, D) along each axis.
    """
    by = np.where(np.abs(way) > _TINY, way, _TINY)
    one, other = (-half - start)[:, :, None] / by, (half - start)[:, :, None] / by
    return np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)


def _through_round(radius: Float, start: Float, way: Float) -> tuple[Float, Float]:
    """As of `Parts.through`, within circles or balls (K,) about the origin."""
    a, b = np.maximum((way * way).sum(axis=1), 1e-18), (way * start[:, :, None]).sum(axis=1)
    inside = b * b - a * (np.vecdot(start, start) - radius * radius)[:, None]
    root = np.sqrt(np.maximum(inside, 0.0))
    missed = inside <= 0.0
    return np.where(missed, np.inf, (-b - root) / a), np.where(missed, -np.inf, (-b + root) / a)


def _unit(vectors: Float, length: Float) -> Float:
    """Vectors (N, D) by their lengths (N,); that of length 0 along the first axis."""
    unit = vectors / np.maximum(length, _TINY)[:, None]
    unit[length <= _TINY, 0] = 1.0
    return unit
