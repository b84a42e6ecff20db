"""Visible features of an object.

Its beads and the corners of its tags are one list of points; it states which of them face a camera.

A camera is *expected* to see a feature that lies in its image, is turned to it, is large enough and is not behind the
object itself. Some are at the edge of that, and a slave may find them or not: that these are missing is no evidence.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration.object_profile import ObjectProfile, tag_corners
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.tag_family import GRIDS
from common.geometry.transforms import cross, transform
from master.objects.surface import Surface

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
    """The points of an object.

    Attributes:
        names: (F,) of beads, then of tags.
        points: (P, 3) [m], object frame: one of each bead, four corners of each tag.
        feature: (P,) to which feature each belongs.
        radius_m: (P,) of beads; 0: a corner.
        rows: (B,) which rows of `MarkerDetections` are the beads.
        tag_ids: (N,) numbers of the tags.
        normals: (F, 3) outward of tags; 0: a bead.
        cells: Along an edge of a tag, its black border included; 0: there are none.
        surface: What hides features of the object itself.
    """

    names: tuple[str, ...]
    points: Float
    feature: Int
    radius_m: Float
    rows: Int
    tag_ids: tuple[int, ...]
    normals: Float
    cells: int
    surface: Surface

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

    def expected(self, T_rig_object: Float, camera: CameraModel, ease: float = 1.0) -> Bool:
        """Return (F,) which features a camera sees of the object at a pose (4, 4).

        Nothing is in front of the object.

        Args:
            T_rig_object: The pose.
            camera: The camera.
            ease: By what all that is asked of a feature is multiplied; below 1 those are returned that may be seen.
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
        """Return (N,) which tags face an eye and are large in its image.

        The eye is (3,) [m], object frame; the image is (P, 2) [px].
        """
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
        """Return (B,) which beads an eye sees.

        They are large enough for an eye (3,) [m], object frame, and not behind the object.
        """
        if not self.beads:
            return np.zeros(0, np.bool_)
        points, radius = self.points[: self.beads], self.radius_m[: self.beads]
        line_of_sight = eye - points
        away = np.linalg.norm(line_of_sight, axis=1)
        ahead = line_of_sight / away[:, None]
        across = cross(ahead, np.eye(3)[np.argmin(np.abs(ahead), axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        # The near half of the ball, so that the rod that it is on is not before it.
        off = _DISC[:, :1] * across[:, None] + _DISC[:, 1:] * cross(ahead, across)[:, None]
        off += _BULGE * ahead[:, None]
        hidden = self.surface.hides(eye, points[:, None] + radius[:, None, None] * off)
        bead_px = 2.5  # radius of a bead that is found nearly always
        bead_seen = 0.75  # share of a bead that must not be behind the object
        return (radius * focal_px >= ease * bead_px * away) & ((~hidden).mean(axis=1) >= ease * bead_seen)
