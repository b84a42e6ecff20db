"""objects/<name>.json: a rigid object, tracked by markers, tags, or a tracker."""

from typing import Annotated, Literal, TypeAlias

import numpy as np
from msgspec import Meta

from common.arrays import Float
from common.calibration.files import Matrix4, Part, Provenance, StampOffset, Vector3
from common.errors import CalibrationError
from common.messages import MAX_MARKERS, MAX_TAGS, Name

TagFamily = Literal[
    "apriltag_16h5", "apriltag_25h9", "apriltag_36h11", "aruco_4x4_50", "aruco_5x5_100", "aruco_6x6_250"
]
PartLength = Annotated[float, Meta(ge=1e-4, le=100.0)]  # [m] of a bead, a tag, a part of a surface
TagId = Annotated[int, Meta(ge=0, le=65535)]


class Bead(Part, frozen=True):
    """A painted ball of the object: its middle, object frame, and its radius."""

    position_m: Vector3
    radius_m: PartLength = 0.008


class Tag(Part, frozen=True):
    """Fiducial tag of an object: number, edge of its black square, frame.

    Tag frame: origin in its middle, x to the right and y up as it is printed, z out of the paper.
    """

    id: TagId
    edge_m: PartLength
    T_object_tag: Matrix4


class Tags(Part, frozen=True):
    """The tags of an object, all of one family."""

    family: TagFamily
    tags: Annotated[tuple[Tag, ...], Meta(min_length=1, max_length=MAX_TAGS)]


class BoxShape(Part, frozen=True, tag="box", tag_field="kind"):
    """A box about the origin of its own frame, sides along its axes."""

    size_m: tuple[PartLength, PartLength, PartLength]
    T_object_part: Matrix4 | None = None


class CylinderShape(Part, frozen=True, tag="cylinder", tag_field="kind"):
    """A closed cylinder about the origin of its own frame, along its z."""

    radius_m: PartLength
    length_m: PartLength
    T_object_part: Matrix4 | None = None


class SphereShape(Part, frozen=True, tag="sphere", tag_field="kind"):
    """A ball about the origin of its own frame."""

    radius_m: PartLength
    T_object_part: Matrix4 | None = None


Shape: TypeAlias = BoxShape | CylinderShape | SphereShape


class ObjectProfile(Part, frozen=True):
    """objects/<name>.json: visible features and surface in the object's own frame.

    `markers`: three or more, not in one line; the rig lists their names in `free_markers`, the camera files have their
    colours. `tracker`: name of a device that tracks itself and sits on the object at `T_object_tracker`, which
    `phalanx calibrate tracker` measures, with `stamp_offset_us`: how much later its poses hold than their stamps
    state. `shape`: parts of its surface, which distances and contact are measured to.
    """

    version: Literal[1]
    name: Name
    markers: Annotated[dict[Name, Bead], Meta(max_length=MAX_MARKERS)] = {}
    tags: Tags | None = None
    tracker: Name | None = None
    T_object_tracker: Matrix4 | None = None
    stamp_offset_us: StampOffset = 0.0
    shape: Annotated[tuple[Shape, ...], Meta(max_length=16)] = ()
    provenance: dict[str, Provenance] = {}


def check_object(profile: ObjectProfile, where: str) -> None:
    """Refuse what the types alone cannot.

    Raises:
        CalibrationError: Nothing of it can be tracked, its markers lie in one line, a tag stands twice, or a matrix is
            no rotation and shift. The text has `where` and the key.
    """
    if not profile.markers and profile.tags is None and profile.tracker is None:
        raise CalibrationError(f"{where}: it needs markers, tags or a tracker to be seen by")
    if profile.markers:
        points = np.array([bead.position_m for bead in profile.markers.values()])
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if len(points) > 2 else (0, 0)
        if len(points) < 3 or spread[1] < 5e-3:
            raise CalibrationError(
                f"{where}: markers: its orientation needs three or more that are not collinear"
            )
    tags = () if profile.tags is None else profile.tags.tags
    numbers = [tag.id for tag in tags]
    if len(set(numbers)) != len(numbers):
        raise CalibrationError(f"{where}: tags: an id stands twice")
    for tag in tags:
        check_pose(np.array(tag.T_object_tag), f"{where}: tags: {tag.id}: T_object_tag")
    for place, part in enumerate(profile.shape):
        if part.T_object_part is not None:
            check_pose(np.array(part.T_object_part), f"{where}: shape[{place}]: T_object_part")
    if profile.T_object_tracker is not None:
        check_pose(np.array(profile.T_object_tracker), f"{where}: T_object_tracker")


def check_pose(pose: Float, where: str) -> None:
    """Refuse a matrix (4, 4) that is no rotation and shift (CalibrationError)."""
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise CalibrationError(f"{where}: upper left 3x3 is not a rotation")
    if not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        raise CalibrationError(f"{where}: last row must be 0 0 0 1")


def tag_corners(edge_m: float) -> Float:
    """Corners (4, 3) [m] of a tag, its frame, clockwise as printed from the top left."""
    half = 0.5 * edge_m
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
