"""Surface of an object: distances of points, and occlusion.

How far points are from it, and what it hides from an eye.

An object is a union of boxes, closed cylinders and balls, each convex. Outside of all the distance to the union is the
least of theirs, exactly; inside of two at once it is that of the one whose surface is farther, which is a bound.

A body of round cones is a union of balls along its bones, so its distance to a surface is the least of "distance of the
middle less radius" along the bone (`nearest_to_capsules`). For one convex part that is a convex function of where on
the bone, which a search on a grid and a second on the cell around its best narrows to a 256th of the bone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration.object_profile import Shape
from common.geometry.tapered_capsules import Capsules
from common.geometry.transforms import invert
from master.objects.parts import Parts, by_kind

_STEPS = 17
_GRID: Float = np.linspace(0.0, 1.0, _STEPS)


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


class _PosedSurface:
    """All parts of one kind, each where it is on the object."""

    def __init__(self, shapes: Sequence[Shape], parts: Parts) -> None:
        T = [np.eye(4) if s.T_object_part is None else np.array(s.T_object_part, np.float64) for s in shapes]
        T_part_object = np.array([invert(one) for one in T])
        self._R, self._t = T_part_object[:, :3, :3], T_part_object[:, :3, 3]
        self.parts = parts

    def own(self, points: Float) -> Float:
        """Points (N, 3), object frame, in the frame of each part (K, 3, N)."""
        return self._R @ points.T + self._t[:, :, None]

    def feet(self, part: Int, points: Float) -> Float:
        """Return the nearest surface points (N, 3) to points (N, 3).

        On the surfaces of some of the parts (N,), all in the object frame.
        """
        R, t = self._R[part], self._t[part]
        foot = self.parts.feet(part, (R @ points[..., None])[..., 0] + t)
        return ((foot - t)[:, None] @ R)[:, 0]

    def hides(self, eye: Float, points: Float) -> Bool:
        """(N,) whether a part is between an eye (3,) and points (N, 3), object frame."""
        start = self._R @ eye + self._t
        enters, leaves = self.parts.through(start, self._R @ (points - eye).T)
        hidden: Bool = np.maximum(enters, 0.0) < np.minimum(leaves, 1.0)
        return np.asarray(hidden.any(axis=0), np.bool_)


class Surface:
    """The surface of one object, object frame. Holds no state between calls."""

    def __init__(self, parts: Sequence[Shape]) -> None:
        """Take the parts of its shape; none: it has no surface."""
        self._kinds = [_PosedSurface(shapes, kind) for shapes, kind in by_kind(parts)]

    def __bool__(self) -> bool:
        """Whether there is any."""
        return bool(self._kinds)

    def nearest(self, points: Float) -> tuple[Float, Float]:
        """Return the distances (N,) [m] and nearest surface points of points (N, 3).

        Points in [m]; distances are negative inside; the surface points are (N, 3).
        """
        best, at = np.full(len(points), np.inf), np.full((len(points), 3), np.nan)
        for kind in self._kinds:
            each = kind.parts.distances(kind.own(points))
            part: Int = each.argmin(axis=0)
            distance = each[part, np.arange(len(points))]
            nearer: Int = np.flatnonzero(distance < best)
            if len(nearer):
                best[nearer] = distance[nearer]
                at[nearer] = kind.feet(part[nearer], points[nearer])
        return best, at

    def distances(self, points: Float) -> Float:
        """Distances (N,) [m] alone."""
        best = np.full(len(points), np.inf)
        for kind in self._kinds:
            best = np.minimum(best, kind.parts.distances(kind.own(points)).min(axis=0))
        return best

    def nearest_to_capsules(self, capsules: Capsules) -> Nearest:
        """Where the surface is nearest to each of N round cones, object frame."""
        rows: Int = np.arange(len(capsules.start_m))
        along, scale_up = capsules.stop_m - capsules.start_m, capsules.stop_radius_m - capsules.start_radius_m

        def least(share: Float) -> tuple[Int, Float]:
            """Return which ball on each bone is nearest to the surface, and its gap (N,).

            The balls are at positions (N, S) along the bones.
            """
            middle = capsules.start_m[:, None] + share[..., None] * along[:, None]
            radius = capsules.start_radius_m[:, None] + share * scale_up[:, None]
            gap = self.distances(middle.reshape(-1, 3)).reshape(share.shape) - radius
            best: Int = gap.argmin(axis=1)
            return best, gap[rows, best]

        best, _ = least(np.broadcast_to(_GRID, (len(rows), _STEPS)))
        low, high = _GRID[np.maximum(best - 1, 0)], _GRID[np.minimum(best + 1, _STEPS - 1)]
        share = low[:, None] + (high - low)[:, None] * _GRID
        best, gap = least(share)
        associated = share[rows, best]
        return Nearest(gap, self.nearest(capsules.start_m + associated[:, None] * along)[1], associated)

    def hides(self, eye: Float, points: Float) -> Bool:
        """Return a mask (...) of the points that the object hides from an eye.

        Eye (3,) [m] and points (..., 3) [m] in the object frame; True where the object itself is between them.
        """
        flat = points.reshape(-1, 3)
        hidden = np.zeros(len(flat), np.bool_)
        if len(flat):
            for kind in self._kinds:
                hidden |= kind.hides(eye, flat)
        return hidden.reshape(points.shape[:-1])
