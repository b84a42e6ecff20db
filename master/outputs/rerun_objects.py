"""Objects in the viewer's scene.

Where each is and how well that is known, and where fingers touch it.

world/objects/OBJECT                 its place; nothing below it while nobody knows where it is
world/objects/OBJECT/shape/...       boxes, cylinders, balls of its file, coloured by `object_appearance`
world/objects/OBJECT/beads, /tags    what it is seen by
world/contact/HAND/OBJECT/points     where it is nearest to each finger: red touched, yellow within 3 cm
world/contact/HAND/OBJECT/gaps       from the fingertip to there, with the distance of the skin
plots/contact_mm/OBJECT/FINGER       distance of the skin, negative inside
states/HAND/OBJECT                   held, touched
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import rerun as rr

from common.arrays import Bool, Float, Int
from common.calibration.object_profile import BoxShape, CylinderShape, ObjectProfile, Shape
from common.geometry.tag_family import tag_image
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import FINGERS
from common.messages import Contact, ObjectPose
from master.outputs.object_appearance import OBJECT_RGB, ObjectAppearance
from master.outputs.palette import TOUCH_RGB, Rgb, pack, series_rgb
from master.outputs.rerun_blueprint import WORLD
from master.outputs.rerun_columns import Columns, seen
from master.outputs.rerun_states import States

_UNKNOWN = np.full((5, 3), np.nan)


@dataclass(slots=True)
class _Shown:
    """How an object is shown now."""

    profile: ObjectProfile | None
    look: ObjectAppearance | None = None


class ObjectsLayer:
    """Logger of objects and contact to a recording that belongs to the caller.

    Holds how each object is shown.
    """

    def __init__(
        self, recording: rr.RecordingStream, states: States, profiles: Sequence[ObjectProfile]
    ) -> None:
        """Take what is known of the objects; one that is not is shown as a point."""
        self._rec, self._rows, self._states = recording, Columns(recording), states
        self._shown = {profile.name: _Shown(profile) for profile in profiles}
        for profile in profiles:
            for i, name in enumerate(FINGERS):
                self._rows.name(_plot(profile.name, name), f"{name} - {profile.name}", series_rgb(i))

    def log_poses(self, poses: Sequence[ObjectPose]) -> None:
        """Log a batch of poses of any objects, each in the order of time."""
        for name in dict.fromkeys(pose.object for pose in poses):
            own = [pose for pose in poses if pose.object == name]
            root, shown = (
                rr.new_entity_path([WORLD, "objects", name]),
                self._shown.setdefault(name, _Shown(None)),
            )
            for pose in own:
                if (look := ObjectAppearance.of(pose)) != shown.look:
                    self._states.at(pose.t_ns)
                    self._dress(root, shown, look)
                    shown.look = look
            known = [pose for pose in own if np.isfinite(pose.position_m).all()]
            if known:
                columns = rr.Transform3D.columns(
                    translation=np.array([pose.position_m for pose in known]),
                    quaternion=np.array([np.roll(pose.orientation_wxyz, -1) for pose in known]),
                )
                self._rows.send(root, np.array([pose.t_ns for pose in known], np.int64), columns, None)

    def log_contacts(self, contacts: Sequence[Contact], tips_m: Mapping[tuple[str, int], Float]) -> None:
        """Log contact of any hands and objects, each in the order of time.

        Args:
            contacts: The messages.
            tips_m: Hand and `t_ns` -> the five fingertips, and what else there is (N, 3) [m], where they are known.
        """
        for hand, name in dict.fromkeys((one.hand, one.object) for one in contacts):
            own = [one for one in contacts if (one.hand, one.object) == (hand, name)]
            t = np.array([one.t_ns for one in own], np.int64)
            root = rr.new_entity_path([WORLD, "contact", hand, name])
            distance, point = (
                np.array([one.distance_m for one in own]),
                np.array([one.point_m for one in own]),
            )
            touching = np.array([one.touching for one in own])
            near_m = 0.03  # of a finger that is shown beside an object
            near = seen(point) & (distance < near_m)
            colours = pack([TOUCH_RGB[False], TOUCH_RGB[True]])[touching.astype(np.int64)]
            spot_m, touch_m = 0.002, 0.0045
            radii = np.where(touching, touch_m, spot_m)[near]
            self._rows.points(f"{root}/points", t, point, near, colours, radii)
            tips = np.array([tips_m.get((hand, one.t_ns), _UNKNOWN)[:5] for one in own])
            self._gaps(
                f"{root}/gaps", t, np.stack([tips, point], axis=2), near & seen(tips), distance, colours
            )
            for i, finger in enumerate(FINGERS):
                self._rows.scalars(_plot(name, finger), t, distance[:, i] * 1e3)
            for one in own:
                state = "held" if one.held else "touched" if one.touching.any() else None
                self._states.log(f"{hand}/{name}", one.t_ns, state)

    def _gaps(
        self,
        path: str,
        t_ns: Int,
        lines: Float,
        shown: Bool,
        distance_m: Float,
        colours: npt.NDArray[np.uint32],
    ) -> None:
        """Lines (T, 5, 2, 3) that are `shown` (T, 5), each with its distance beside it."""
        strips = list(lines[shown])
        labels = [f"{value:.0f} mm" for value in (distance_m[shown] * 1e3).tolist()]
        line_m = 0.0006
        columns = rr.LineStrips3D.columns(
            strips=strips, radii=np.full(len(strips), line_m), colors=colours[shown], labels=labels
        )
        self._rows.send(path, t_ns, columns, shown.sum(axis=1))

    def _dress(self, root: str, shown: _Shown, look: ObjectAppearance) -> None:
        """Show the object as it is known now, from the time that is set on."""
        if look is ObjectAppearance.GONE:
            self._rec.log(root, rr.Clear(recursive=True))
            return
        profile, colour = shown.profile, OBJECT_RGB[look]
        if profile is None:
            self._rec.log(f"{root}/shape", rr.Points3D([[0.0, 0.0, 0.0]], radii=0.01, colors=[colour]))
            return
        for kind, part in _parts(profile.shape, colour).items():
            self._rec.log(f"{root}/shape/{kind}", part)
        if shown.look not in (None, ObjectAppearance.GONE):
            return  # what it is seen by stays as it is
        if profile.markers:
            beads = list(profile.markers.values())
            self._rec.log(
                f"{root}/beads",
                rr.Points3D(
                    [bead.position_m for bead in beads],
                    radii=[bead.radius_m for bead in beads],
                    colors=[series_rgb(i) for i in range(len(beads))],
                ),
            )
        for tag in () if profile.tags is None else profile.tags.tags:
            self._rec.log(f"{root}/tags/{tag.id}", _tag_mesh(profile, tag.id))


def _plot(name: str, finger: str) -> str:
    return rr.new_entity_path(["plots", "contact_mm", name, finger])


def _parts(shapes: Sequence[Shape], colour: Rgb) -> dict[str, rr.AsComponents]:
    """Name of a kind of part -> all parts of it, object frame."""
    boxes = [one for one in shapes if isinstance(one, BoxShape)]
    cylinders = [one for one in shapes if isinstance(one, CylinderShape)]
    balls = [one for one in shapes if not isinstance(one, BoxShape | CylinderShape)]
    parts: dict[str, rr.AsComponents] = {}
    if boxes:
        at, orientation = _placed(boxes)
        sizes = [one.size_m for one in boxes]
        parts["boxes"] = rr.Boxes3D(
            sizes=sizes, centers=at, quaternions=orientation, colors=[colour], fill_mode="solid"
        )
    if cylinders:
        at, orientation = _placed(cylinders)
        parts["cylinders"] = rr.Cylinders3D(
            lengths=[one.length_m for one in cylinders],
            radii=[one.radius_m for one in cylinders],
            centers=at,
            quaternions=orientation,
            colors=[colour],
            fill_mode="solid",
        )
    if balls:
        at, orientation = _placed(balls)
        radii = [one.radius_m for one in balls]
        parts["balls"] = rr.Ellipsoids3D(
            radii=radii, centers=at, quaternions=orientation, colors=[colour], fill_mode="solid"
        )
    return parts


def _placed(shapes: Sequence[Shape]) -> tuple[Float, Float]:
    """Centres (N, 3) [m] and quaternions xyzw (N, 4) of parts in the object's frame."""
    poses = np.array([np.eye(4) if one.T_object_part is None else one.T_object_part for one in shapes])
    return poses[:, :3, 3], np.roll(matrix_to_quaternion(poses[:, :3, :3]), -1, axis=-1)


def _tag_mesh(profile: ObjectProfile, number: int) -> rr.Mesh3D:
    """A tag as it is printed, on its face."""
    assert profile.tags is not None
    tag = next(one for one in profile.tags.tags if one.id == number)
    pose = np.array(tag.T_object_tag)
    tag_cell_px = 8  # of a tag's texture, so that its edges stay sharp
    image = np.kron(tag_image(profile.tags.family, tag.id), np.ones((tag_cell_px, tag_cell_px), np.uint8))
    half = 0.5 * tag.edge_m
    lift_m = 3e-4  # a tag lies on its face, not in it
    corners = np.array(
        [[-half, half, lift_m], [half, half, lift_m], [half, -half, lift_m], [-half, -half, lift_m]]
    )
    return rr.Mesh3D(
        vertex_positions=corners @ pose[:3, :3].T + pose[:3, 3],
        triangle_indices=[[0, 2, 1], [0, 3, 2]],
        vertex_texcoords=[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]],
        albedo_texture=np.repeat(image[..., None], 3, axis=2),
    )
