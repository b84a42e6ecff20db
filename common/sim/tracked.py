"""Tracked objects of a scene have poses, ground truth and a surface.

The first object of a rig is what the motion moves: the one that travels (`scenes.ObjectTravel`), or the thing that
the hand takes, in whose place it then is. Any other, and all of them in a scene that moves none, stand still beside
the hand. The surface is rods, blocks, balls, beads and tags; all places are key points of one array, as those of the
hand (`surface`), so that a camera brings each to the moment at which its own row is exposed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.calibration import RigCalibration
from common.calibration.object_profile import (
    BoxShape,
    CylinderShape,
    ObjectProfile,
    Shape,
    TagFamily,
    tag_corners,
)
from common.errors import CalibrationError
from common.geometry.tag_family import GRIDS
from common.geometry.transforms import axis_rotation, invert, rigid, transform
from common.sim.motion import HandState

RESTING_M = np.array([0.19, 0.13, 0.12])  # of an object that nothing moves, against the middle of the view
TILT_RAD = np.radians(20.0)
# its y to the cameras, its z to the left
_FACING = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def facing(tilt_rad: float) -> Float:
    """Rotation (3, 3), object -> rig: y to the cameras, z left, up by a tilt [rad]."""
    return np.asarray(axis_rotation(2, tilt_rad) @ _FACING)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedObjects:
    """The objects of a rig in one scene.

    Attributes:
        profiles: In the order of the rig.
        beads: Marker (place in the rig) -> object (place in `profiles`) and middle (3,) [m] of the bead in its frame.
    """

    profiles: tuple[ObjectProfile, ...]
    beads: Mapping[int, tuple[int, Float]]

    @classmethod
    def of(cls, rig: RigCalibration, files: Mapping[str, ObjectProfile]) -> "TrackedObjects":
        """Those that a rig names.

        Raises:
            CalibrationError: One has no file, or a bead that is not among the rig's free markers.
        """
        profiles: list[ObjectProfile] = []
        beads: dict[int, tuple[int, Float]] = {}
        for k, name in enumerate(rig.objects):
            if name not in files:
                raise CalibrationError(f"rig {rig.name!r}: objects: no object file for {name!r}")
            profiles.append(files[name])
            for marker, bead in files[name].markers.items():
                if marker not in rig.free_markers:
                    raise CalibrationError(
                        f"object {name!r}: markers.{marker}: rig {rig.name!r} has no such marker under 'free_markers'"
                    )
                beads[rig.markers.index(marker)] = k, np.array(bead.position_m, dtype=np.float64)
        return cls(tuple(profiles), beads)

    def poses(self, state: HandState, centre_m: Float) -> tuple[Float, ...]:
        """`T_rig_object` (4, 4) [m] of each object; scene centre (3,) [m], rig frame."""
        moved = state.objects or tuple(thing.T_rig_object for thing in state.things)
        return tuple(
            moved[k] if k < len(moved) else resting_pose(k, centre_m) for k in range(len(self.profiles))
        )

    def features(self, which: int) -> tuple[str, ...]:
        """What can be found of one object: its beads by name, then its tags by number."""
        profile = self.profiles[which]
        tags = () if profile.tags is None else profile.tags.tags
        return (*profile.markers, *(f"tag {tag.id}" for tag in tags))


def resting_pose(which: int, centre_m: Float) -> Float:
    """Pose (4, 4) [m], rig frame, of an object by number where nothing moves it."""
    side = np.array([-1.0 if which % 2 == 0 else 1.0, 1.0 if which % 4 < 2 else -1.0, 1.0])
    return rigid(facing(TILT_RAD), centre_m + side * RESTING_M)


PAPER_CELLS = 1.0  # of white about the black square of a tag


@dataclass(frozen=True, slots=True)
class Rod:
    """A closed dark cylinder: key points of the middles of its ends, radius [m]."""

    ends: slice
    radius_m: float


@dataclass(frozen=True, slots=True)
class Block:
    """A dark box: its eight key points, in the order of `BLOCK_CORNERS`."""

    corners: slice


@dataclass(frozen=True, slots=True)
class Ball:
    """Ball: key point of its centre (slice of one), radius [m], of a bead its marker."""

    middle: slice
    radius_m: float
    marker: int | None = None


@dataclass(frozen=True, slots=True)
class Sheet:
    """Printed tag: key points of paper, then black square, as `tag_corners` goes.

    Attributes:
        on: Place of the block that it is stuck on among the parts; None: on nothing that could be before it.
    """

    corners: slice
    family: TagFamily
    number: int
    on: int | None


Part = Rod | Block | Ball
BLOCK_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
# Faces as corners in ring order, seen from outside counter-clockwise.
BLOCK_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


@dataclass(frozen=True, slots=True, eq=False)
class ObjectSurface:
    """Which points the tracked objects of a scene have, and how they move.

    Attributes:
        parts: Dark parts of all objects.
        beads: Painted balls; sheets: tags.
        beads_of, sheets_of: Object -> its beads and its tags, in the order of its file.
        local: (K, 3) key points [m], each in the frame of its object; owner: (K,) whose they are.
    """

    parts: tuple[Part, ...]
    beads: tuple[Ball, ...]
    sheets: tuple[Sheet, ...]
    beads_of: tuple[slice, ...]
    sheets_of: tuple[slice, ...]
    local: Float
    owner: Int

    @classmethod
    def of(cls, tracked: TrackedObjects, markers: Sequence[str]) -> "ObjectSurface":
        """Lay out the key points of all objects; `markers` are those of the rig."""
        points: list[Float] = [np.zeros((0, 3))]
        owner: list[int] = []
        parts: list[Part] = []
        beads: list[Ball] = []
        sheets: list[Sheet] = []
        beads_of: list[slice] = []
        sheets_of: list[slice] = []
        for which, profile in enumerate(tracked.profiles):

            def add(more: Float, which: int = which) -> slice:
                points.append(more)
                owner.extend([which] * len(more))
                return slice(len(owner) - len(more), len(owner))

            first, bead, sheet = len(parts), len(beads), len(sheets)
            parts += [_part(shape, add) for shape in profile.shape]
            for name, ball in profile.markers.items():
                beads.append(Ball(add(np.array([ball.position_m])), ball.radius_m, markers.index(name)))
            sheets += _sheets(profile, first, add)
            beads_of.append(slice(bead, len(beads)))
            sheets_of.append(slice(sheet, len(sheets)))
        local, owners = np.concatenate(points), np.array(owner, dtype=np.intp)
        return cls(
            tuple(parts), tuple(beads), tuple(sheets), tuple(beads_of), tuple(sheets_of), local, owners
        )

    def key_points(self, poses: Float) -> Float:
        """Key points (..., K, 3) [m], rig frame, of poses (..., O, 4, 4) of the objects."""
        own = poses[..., self.owner, :, :]
        return np.einsum("...kij,kj->...ki", own[..., :3, :3], self.local) + own[..., :3, 3]


def _part(shape: Shape, add: Callable[[Float], slice]) -> Part:
    pose = np.eye(4) if shape.T_object_part is None else np.array(shape.T_object_part, dtype=np.float64)
    if isinstance(shape, BoxShape):
        return Block(add(transform(pose, BLOCK_CORNERS * np.array(shape.size_m))))
    if isinstance(shape, CylinderShape):
        ends = 0.5 * shape.length_m * np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
        return Rod(add(transform(pose, ends)), shape.radius_m)
    return Ball(add(pose[None, :3, 3]), shape.radius_m)


def _sheets(profile: ObjectProfile, first: int, add: Callable[[Float], slice]) -> list[Sheet]:
    """The tags of an object whose first part is number `first`."""
    if profile.tags is None:
        return []
    family = profile.tags.family
    margin = 1.0 + 2.0 * PAPER_CELLS / (GRIDS[family].cells + 2)
    sheets: list[Sheet] = []
    for tag in profile.tags.tags:
        pose = np.array(tag.T_object_tag, dtype=np.float64)
        paper, square = (transform(pose, tag_corners(tag.edge_m * size)) for size in (margin, 1.0))
        on = _block_under(profile.shape, pose[:3, 3])
        place = add(np.vstack([paper, square]))
        sheets.append(Sheet(place, family, tag.id, None if on is None else first + on))
    return sheets


def _block_under(shapes: Sequence[Shape], point: Float) -> int | None:
    """Place among the shapes of the box on whose surface a point (3,) lies."""
    for k, shape in enumerate(shapes):
        if isinstance(shape, BoxShape):
            pose = shape.T_object_part
            own = point if pose is None else transform(invert(np.array(pose)), point)
            beyond = np.abs(own) - 0.5 * np.array(shape.size_m)
            on_m = 0.003  # a tag as near as this to a block's surface is stuck on it
            if abs(float(beyond.max())) < on_m:
                return k
    return None
