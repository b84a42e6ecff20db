"""The surface of an object: how far points are from it, and what it hides from an eye.

An object is a union of boxes, closed cylinders and balls, each convex. Outside of all the distance to the union is the
least of theirs, exactly; inside of two at once it is that of the one whose surface is farther, which is a bound.

A body of round cones is a union of balls along its bones, so its distance to a surface is the least of "distance of the
middle less radius" along the bone (`nearest_to_cones`). For one convex part that is a convex function of the place on
the bone, which a search on a grid and a second on the cell around its best narrows to a 256th of the bone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry import invert, transform
from common.object_profile import BoxShape, CylinderShape, Shape
from common.round_cones import Cones

_STEPS = 17
_GRAZES_M = 1e-3  # a sight that goes no deeper is not hidden: a tag lies on the surface itself


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """Where a surface is nearest to something.

    Attributes:
        distance_m: (N,) negative inside; inf: there is no surface.
        point_m: (N, 3) on the surface, object frame.
        along: (N,) where on the bone the nearest ball is, 0..1.
    """

    distance_m: Float
    point_m: Float
    along: Float


class Surface:
    """The surface of one object, object frame. Holds no state between calls."""

    def __init__(self, parts: Sequence[Shape]) -> None:
        """Take the parts of its shape; none: it has no surface."""
        self._parts = tuple(parts)
        self._T_object_part = [
            np.eye(4) if part.T_object_part is None else np.array(part.T_object_part, dtype=np.float64)
            for part in parts
        ]
        self._T_part_object = [invert(T) for T in self._T_object_part]

    def __bool__(self) -> bool:
        """Whether there is any."""
        return bool(self._parts)

    def nearest(self, points: Float) -> tuple[Float, Float]:
        """Distances (N,) [m] of points (N, 3) [m], negative inside, and the points of the surface (N, 3) there."""
        best, at = np.full(len(points), np.inf), np.full((len(points), 3), np.nan)
        for part, T_object_part, T_part_object in zip(
            self._parts, self._T_object_part, self._T_part_object, strict=True
        ):
            own = transform(T_part_object, points)
            distance, foot = _nearest_of(part, own)
            nearer = distance < best
            best = np.where(nearer, distance, best)
            at[nearer] = transform(T_object_part, foot[nearer])
        return best, at

    def nearest_to_cones(self, cones: Cones) -> Nearest:
        """Where the surface is nearest to each of N round cones, object frame."""
        rows: Int = np.arange(len(cones.start_m))
        share = np.broadcast_to(np.linspace(0.0, 1.0, _STEPS), (len(rows), _STEPS))
        gap, _ = self._gaps(cones, share)
        best: Int = np.argmin(gap, axis=1)
        low, high = share[rows, np.maximum(best - 1, 0)], share[rows, np.minimum(best + 1, _STEPS - 1)]
        share = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _STEPS)
        gap, at = self._gaps(cones, share)
        best = np.argmin(gap, axis=1)
        return Nearest(gap[rows, best], at[rows, best], share[rows, best])

    def hides(self, eye: Float, points: Float) -> Bool:
        """(...) whether the object itself is between an eye (3,) [m] and points (..., 3) [m], object frame."""
        hidden = np.zeros(points.shape[:-1], np.bool_)
        for part, T in zip(self._parts, self._T_part_object, strict=True):
            start = transform(T, eye)
            enters, leaves = _through(part, start, transform(T, points) - start)
            hidden |= np.maximum(enters, 0.0) < np.minimum(leaves, 1.0)
        return hidden

    def _gaps(self, cones: Cones, share: Float) -> tuple[Float, Float]:
        """Distances (N, S) of the balls at places (N, S) on the bones, and the points of the surface (N, S, 3)."""
        middle = cones.start_m[:, None] + share[..., None] * (cones.stop_m - cones.start_m)[:, None]
        radius = cones.start_radius_m[:, None] + share * (cones.stop_radius_m - cones.start_radius_m)[:, None]
        distance, at = self.nearest(middle.reshape(-1, 3))
        return distance.reshape(share.shape) - radius, at.reshape(*share.shape, 3)


def _through(part: Shape, start: Float, way: Float) -> tuple[Float, Float]:
    """From where to where on their ways (..., 3) from one start (3,) sights are inside a part, a little below its skin.

    Both are shares of the way (...); where the second is not above the first, the sight passes by.
    """
    if isinstance(part, BoxShape):
        return _through_slabs(0.5 * np.array(part.size_m) - _GRAZES_M, start, way)
    if isinstance(part, CylinderShape):
        side = _through_round(part.radius_m - _GRAZES_M, start[:2], way[..., :2])
        ends = _through_slabs(np.array([0.5 * part.length_m - _GRAZES_M]), start[2:], way[..., 2:])
        return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])
    return _through_round(part.radius_m - _GRAZES_M, start, way)


def _through_slabs(half: Float, start: Float, way: Float) -> tuple[Float, Float]:
    """As `_through`, between planes at plus and minus `half` (D,) along each axis."""
    by = np.where(np.abs(way) > 1e-12, way, 1e-12)
    one, other = (-half - start) / by, (half - start) / by
    return np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)


def _through_round(radius: float, start: Float, way: Float) -> tuple[Float, Float]:
    """As `_through`, within a circle or ball about the origin."""
    a, b = np.maximum(np.vecdot(way, way), 1e-18), way @ start
    inside = b * b - a * (start @ start - radius * radius)
    root = np.sqrt(np.maximum(inside, 0.0))
    missed = inside <= 0.0
    return np.where(missed, np.inf, (-b - root) / a), np.where(missed, -np.inf, (-b + root) / a)


def _nearest_of(part: Shape, points: Float) -> tuple[Float, Float]:
    """Distances (N,) of points (N, 3) to one part about its own origin, and the nearest points of its surface."""
    if isinstance(part, BoxShape):
        return _nearest_of_box(0.5 * np.array(part.size_m), points)
    if isinstance(part, CylinderShape):
        return _nearest_of_cylinder(part.radius_m, 0.5 * part.length_m, points)
    out = np.linalg.norm(points, axis=1)
    return out - part.radius_m, part.radius_m * _unit(points, out)


def _nearest_of_box(half: Float, points: Float) -> tuple[Float, Float]:
    """As `_nearest_of`, of a box with these halves of its sides, of any number of dimensions."""
    foot = np.clip(points, -half, half)
    off = points - foot
    outside = np.sqrt(np.vecdot(off, off))
    deep = half - np.abs(points)  # below each face
    face: Int = np.argmin(deep, axis=1)
    rows: Int = np.arange(len(points))
    inside = outside == 0.0
    on_face = np.where(points[rows, face] < 0.0, -half[face], half[face])
    foot[rows[inside], face[inside]] = on_face[inside]
    return np.where(inside, -deep[rows, face], outside), foot


def _nearest_of_cylinder(radius: float, half: float, points: Float) -> tuple[Float, Float]:
    """As `_nearest_of`: in the plane of axis and point a cylinder is a box."""
    out = np.linalg.norm(points[:, :2], axis=1)
    distance, foot = _nearest_of_box(np.array([radius, half]), np.stack([out, points[:, 2]], axis=1))
    at = np.empty_like(points)
    at[:, :2] = foot[:, :1] * _unit(points[:, :2], out)
    at[:, 2] = foot[:, 1]
    return distance, at


def _unit(vectors: Float, length: Float) -> Float:
    """Vectors (N, D) by their lengths (N,); that of length 0 along the first axis."""
    unit = vectors / np.maximum(length, 1e-12)[:, None]
    unit[length <= 1e-12, 0] = 1.0
    return unit
