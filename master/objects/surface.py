"""An object has a surface and features, and occludes some of them.

An object is a union of boxes, closed cylinders and balls, each convex. Outside of all the distance to the
union is the least of theirs, exactly; inside of two at once it is that of the one whose surface is farther,
which is a bound.

A body of round cones is a union of balls along its bones, so its distance to a surface is the least of
"distance of the middle less radius" along the bone (`nearest_to_capsules`). For one convex part that is a
convex function of where on the bone, which a search on a grid and a second on the cell around its best
narrows to a 256th of the bone.

`Features`: a camera is *expected* to see a feature that lies in its image, is turned to it, is large enough
and is not behind the object itself. Some are at the edge of that, and a slave may find them or not: that
these are missing is no evidence.

`Parts`: coordinates come first in `own` (K, D, N), so that sums over them are sums of rows: a hand asks for
hundreds of points at once, and most of what that costs is the number of calls.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration.object_profile import (
    BoxShape,
    CylinderShape,
    ObjectProfile,
    Shape,
    SphereShape,
    tag_corners,
)
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.tag_family import GRIDS
from common.geometry.tapered_capsules import Capsules
from common.geometry.transforms import cross, invert, transform

_GRAZES_M = 1e-3  # a sight that goes no deeper is not hidden: a tag lies on the surface itself
_TINY = 1e-12


def _feet_of_box(half: Float, points: Float) -> Float:
    """Return nearest points (N, D) on boxes of these halves of their sides (N, D)."""
    foot = np.minimum(np.maximum(points, -half), half)
    inside = np.flatnonzero((foot == points).all(axis=1))
    if len(inside):
        own, most = points[inside], half[inside]
        rows: Int = np.arange(len(inside))
        face: Int = np.argmin(most - np.abs(own), axis=1)
        foot[inside, face] = np.where(own[rows, face] < 0.0, -most[rows, face], most[rows, face])
    return foot


def _through_slabs(half: Float, start: Float, way: Float) -> tuple[Float, Float]:
    """Intersect rays, as `Parts._through`, with slabs between planes at +- `half`."""
    by = np.where(np.abs(way) > _TINY, way, _TINY)
    one, other = (-half - start)[:, :, None] / by, (half - start)[:, :, None] / by
    return np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)


def _through_round(radius: Float, start: Float, way: Float) -> tuple[Float, Float]:
    """As of `Parts._through`, within circles or balls (K,) about the origin."""
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


_STEPS = 17
_GRID: Float = np.linspace(0.0, 1.0, _STEPS)


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """Where a surface is nearest to something."""

    distance_m: Float  # (N,) negative inside; inf: there is no surface
    point_m: Float  # (N, 3) on the surface, object frame
    along: Float  # (N,) where on the bone the nearest ball is, 0..1


class Parts(ABC):
    """K parts of one kind, each where it is on the object; they hold no state."""

    def __init__(self, shapes: Sequence[Shape]) -> None:
        T = [np.eye(4) if s.T_object_part is None else np.array(s.T_object_part, np.float64) for s in shapes]
        T_part_object = np.array([invert(one) for one in T])
        self._R, self._t = T_part_object[:, :3, :3], T_part_object[:, :3, 3]

    def distances(self, points: Float) -> Float:
        """Return distances (K, N) [m], negative inside, of points (N, 3), object frame."""
        return self._distances(self._R @ points.T + self._t[:, :, None])

    def feet(self, part: Int, points: Float) -> Float:
        """Return nearest surface points (N, 3) of parts (N,) to points, object frame."""
        R, t = self._R[part], self._t[part]
        foot = self._feet(part, (R @ points[..., None])[..., 0] + t)
        return ((foot - t)[:, None] @ R)[:, 0]

    def hides(self, eye: Float, points: Float) -> Bool:
        """(N,) whether a part is between an eye (3,) and points (N, 3), object frame."""
        enters, leaves = self._through(self._R @ eye + self._t, self._R @ (points - eye).T)
        hidden: Bool = np.maximum(enters, 0.0) < np.minimum(leaves, 1.0)
        return np.asarray(hidden.any(axis=0), np.bool_)

    @abstractmethod
    def _distances(self, own: Float) -> Float:
        """Distances (K, N) of points (K, 3, N), each part's frame."""

    @abstractmethod
    def _feet(self, part: Int, own: Float) -> Float:
        """Nearest surface points (N, 3) of parts (N,) to points (N, 3), part frames."""

    @abstractmethod
    def _through(self, start: Float, way: Float) -> tuple[Float, Float]:
        """From where to where rays are inside a part, a little below its skin.

        Ways (K, 3, N) from starts (K, 3). Both (K, N) are shares of the way; where the second is not above
        the first, the sight passes by.
        """


class Boxes(Parts):
    """Boxes, by the halves of their sides (K, 3)."""

    def __init__(self, shapes: Sequence[BoxShape]) -> None:
        super().__init__(shapes)
        self._half = 0.5 * np.array([shape.size_m for shape in shapes])

    def _distances(self, own: Float) -> Float:
        deep = np.abs(own) - self._half[:, :, None]
        off = np.maximum(deep, 0.0)
        return np.sqrt((off * off).sum(axis=1)) + np.minimum(deep.max(axis=1), 0.0)

    def _feet(self, part: Int, own: Float) -> Float:
        return _feet_of_box(self._half[part], own)

    def _through(self, start: Float, way: Float) -> tuple[Float, Float]:
        return _through_slabs(self._half - _GRAZES_M, start, way)


class Cylinders(Parts):
    """Closed cylinders along z, by radius and half their length."""

    def __init__(self, shapes: Sequence[CylinderShape]) -> None:
        super().__init__(shapes)
        self._size = np.array([[shape.radius_m, 0.5 * shape.length_m] for shape in shapes])

    def _distances(self, own: Float) -> Float:
        """In the plane of axis and point a cylinder is a box."""
        x, y, z = own.swapaxes(0, 1)
        out = np.sqrt(x * x + y * y) - self._size[:, :1]
        up = np.abs(z) - self._size[:, 1:]
        side, end = np.maximum(out, 0.0), np.maximum(up, 0.0)
        return np.sqrt(side * side + end * end) + np.minimum(np.maximum(out, up), 0.0)

    def _feet(self, part: Int, own: Float) -> Float:
        out = np.sqrt(np.vecdot(own[:, :2], own[:, :2]))
        foot = _feet_of_box(self._size[part], np.stack([out, own[:, 2]], axis=1))
        return np.concatenate([foot[:, :1] * _unit(own[:, :2], out), foot[:, 1:]], axis=1)

    def _through(self, start: Float, way: Float) -> tuple[Float, Float]:
        side = _through_round(self._size[:, 0] - _GRAZES_M, start[:, :2], way[:, :2])
        ends = _through_slabs(self._size[:, 1:] - _GRAZES_M, start[:, 2:], way[:, 2:])
        return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])


class Balls(Parts):
    """Balls, by their radii (K,)."""

    def __init__(self, shapes: Sequence[SphereShape]) -> None:
        super().__init__(shapes)
        self._radius = np.array([shape.radius_m for shape in shapes])

    def _distances(self, own: Float) -> Float:
        return np.sqrt((own * own).sum(axis=1)) - self._radius[:, None]

    def _feet(self, part: Int, own: Float) -> Float:
        return self._radius[part, None] * _unit(own, np.sqrt(np.vecdot(own, own)))

    def _through(self, start: Float, way: Float) -> tuple[Float, Float]:
        return _through_round(self._radius - _GRAZES_M, start, way)


class Surface:
    """The surface of one object, object frame. Holds no state between calls."""

    def __init__(self, parts: Sequence[Shape]) -> None:
        """Take the parts of its shape; none: it has no surface."""
        bars = [part for part in parts if isinstance(part, CylinderShape)]
        boxes = [part for part in parts if isinstance(part, BoxShape)]
        balls = [part for part in parts if isinstance(part, SphereShape)]
        self._kinds: list[Parts] = [
            *([Cylinders(bars)] if bars else []),
            *([Boxes(boxes)] if boxes else []),
            *([Balls(balls)] if balls else []),
        ]

    def __bool__(self) -> bool:
        return bool(self._kinds)

    def nearest(self, points: Float) -> tuple[Float, Float]:
        """Return distances (N,) [m], negative inside, and nearest surface points (N, 3)."""
        best, at = np.full(len(points), np.inf), np.full((len(points), 3), np.nan)
        for kind in self._kinds:
            each = kind.distances(points)
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
            best = np.minimum(best, kind.distances(points).min(axis=0))
        return best

    def nearest_to_capsules(self, capsules: Capsules) -> Nearest:
        """Where the surface is nearest to each of N round cones, object frame."""
        rows: Int = np.arange(len(capsules.start_m))
        along, scale_up = capsules.stop_m - capsules.start_m, capsules.stop_radius_m - capsules.start_radius_m

        def least(share: Float) -> tuple[Int, Float]:
            """Return the ball at (N, S) of each bone nearest to the surface, its gap (N,)."""
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
        """Return a mask (...) of points (..., 3) hidden from an eye (3,), object frame."""
        flat = points.reshape(-1, 3)
        hidden = np.zeros(len(flat), np.bool_)
        if len(flat):
            for kind in self._kinds:
                hidden |= kind.hides(eye, flat)
        return hidden.reshape(points.shape[:-1])


# Of a tag that is found nearly always, by what the finder of the slaves finds of rendered ones: how it is turned to the
# camera, and how short its shortest edge may be by cells.
_TAG_COSINE, _CELL_PX = 0.65, 3.4
_DISC: Float = np.array(
    [[0.0, 0.0]]
    + [[r * np.cos(a), r * np.sin(a)] for r in (0.45, 0.85) for a in np.arange(6) * np.pi / 3 + r]
)

_BULGE: Float = np.sqrt(1.0 - (_DISC * _DISC).sum(axis=1))[:, None]  # of a ball's near half over its disc


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """The points of an object."""

    names: tuple[str, ...]  # (F,) of beads, then of tags
    points: Float  # (P, 3) [m], object frame: one of each bead, four corners of each tag
    feature: Int  # (P,) to which feature each belongs
    radius_m: Float  # (P,) of beads; 0: a corner
    rows: Int  # (B,) which rows of `MarkerDetections` are the beads
    tag_ids: tuple[int, ...]  # (N,)
    normals: Float  # (F, 3) outward of tags; 0: a bead
    cells: int  # along an edge of a tag, its black border included; 0: there are none
    surface: Surface  # what hides features of the object itself

    @classmethod
    def of(cls, profile: ObjectProfile, markers: tuple[str, ...]) -> "Features":
        """The features of a profile in a rig with these markers.

        Raises:
            CalibrationError: The rig has no marker of the name of a bead.
        """
        for name in profile.markers:
            if name not in markers:
                raise CalibrationError(
                    f"object {profile.name!r}: markers: {name!r} is not one of the rig's markers, {', '.join(markers)}"
                )
        beads = list(profile.markers.values())
        tags = () if profile.tags is None else profile.tags.tags
        points = [np.array([bead.position_m]) for bead in beads]
        points += [transform(np.array(tag.T_object_tag), tag_corners(tag.edge_m)) for tag in tags]
        sizes = [1] * len(beads) + [4] * len(tags)
        return cls(
            names=(*profile.markers, *(f"tag{tag.id}" for tag in tags)),
            points=np.concatenate(points) if points else np.empty((0, 3)),
            feature=np.repeat(np.arange(len(sizes)), sizes),
            radius_m=np.array([bead.radius_m for bead in beads] + [0.0] * 4 * len(tags)),
            rows=np.array([markers.index(name) for name in profile.markers], np.int64),
            tag_ids=tuple(tag.id for tag in tags),
            normals=np.array(
                [[0.0] * 3] * len(beads) + [[row[2] for row in tag.T_object_tag[:3]] for tag in tags]
            ).reshape(-1, 3),
            cells=0 if profile.tags is None else GRIDS[profile.tags.family].cells + 2,
            surface=Surface(profile.shape),
        )

    @property
    def count(self) -> int:
        """How many features there are."""
        return len(self.names)

    @property
    def _first(self) -> Int:
        """(F,) the first point of each feature."""
        return np.concatenate([np.arange(self.beads), np.arange(self.beads, len(self.points), 4)])

    @property
    def beads(self) -> int:
        """How many of them are beads: the first."""
        return len(self.rows)

    def corners_of(self, tag: int) -> Int:
        """Rows (4,) of `points` of the tag in that place of `tag_ids`."""
        return self.beads + 4 * tag + np.arange(4)

    def corners_m(self, feature: int) -> Float:
        """Corners (4, 3) [m], object frame, of a feature that is a tag."""
        return self.points[self.corners_of(feature - self.beads)]

    def expected(self, T_rig_object: Float, camera: CameraModel, ease: float = 1.0) -> Bool:
        """Return (F,) which features a camera sees of the object at a pose (4, 4).

        Nothing is in front of the object. `ease`: by what all that is asked of a feature is multiplied; below
        1 those are returned that may be seen.
        """
        eye = (camera.centre - T_rig_object[:3, 3]) @ T_rig_object[:3, :3]
        uv = camera.project(transform(T_rig_object, self.points))
        margin_px = 6.0  # from the image's border
        last = np.array([camera.width_px, camera.height_px]) - 1.0 - ease * margin_px
        inside = ((uv >= ease * margin_px) & (uv <= last)).all(axis=1)
        shows = np.concatenate(
            [self._beads_show(eye, float(camera.matrix[0, 0]), ease), self._tags_show(eye, uv, ease)]
        )
        if len(self.points):
            shows &= np.logical_and.reduceat(inside, self._first)
        return shows

    def _tags_show(self, eye: Float, uv: Float, ease: float) -> Bool:
        """Return (N,) which tags face an eye (3,), object frame, large in image (P, 2)."""
        count = len(self.tag_ids)
        if not count:
            return np.zeros(0, np.bool_)
        corners, seen = self.points[self.beads :].reshape(count, 4, 3), uv[self.beads :].reshape(count, 4, 2)
        normal = self.normals[self.beads :]
        line_of_sight = eye - corners.mean(axis=1)
        facing_camera = np.vecdot(normal, line_of_sight) >= ease * _TAG_COSINE * np.linalg.norm(
            line_of_sight, axis=1
        )
        edges = np.linalg.norm(seen - np.roll(seen, 1, axis=1), axis=2).min(axis=1)
        # A little off the paper, which lies on the surface.
        lifted = (
            np.concatenate([corners, corners.mean(axis=1, keepdims=True)], axis=1) + 1e-4 * normal[:, None]
        )
        return (
            facing_camera
            & (edges >= ease * _CELL_PX * self.cells)
            & ~self.surface.hides(eye, lifted).any(axis=1)
        )

    def _beads_show(self, eye: Float, focal_px: float, ease: float) -> Bool:
        """Return (B,) which beads are large for an eye (3,), and not behind the object."""
        if not self.beads:
            return np.zeros(0, np.bool_)
        points, radius = self.points[: self.beads], self.radius_m[: self.beads]
        line_of_sight = eye - points
        distance = np.linalg.norm(line_of_sight, axis=1)
        ahead = line_of_sight / distance[:, None]
        across = cross(ahead, np.eye(3)[np.argmin(np.abs(ahead), axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        # The near half of the ball, so that the rod that it is on is not before it.
        off = _DISC[:, :1] * across[:, None] + _DISC[:, 1:] * cross(ahead, across)[:, None]
        off += _BULGE * ahead[:, None]
        hidden = self.surface.hides(eye, points[:, None] + radius[:, None, None] * off)
        bead_px = 2.5  # radius of a bead that is found nearly always
        bead_seen = 0.75  # share of a bead that must not be behind the object
        return (radius * focal_px >= ease * bead_px * distance) & ((~hidden).mean(axis=1) >= ease * bead_seen)
