"""Layers log objects, contact and gestures to one Rerun recording.

world/gestures/HAND/pose             the name of the pose beside the palm
world/gestures/HAND/pinch            thumb to finger, brighter as it closes, with the distance of their skins
world/gestures/HAND/dial             circle about the dial's axis; /turned: arc of the angle, with its degrees
world/gestures/HAND/ray              where a finger points
world/gestures/HAND/tap              the key that was tapped, for half a second
states/HAND/KIND; events/HAND        the same over time; every begin, end and tap as a line of text
world/objects/OBJECT                 its place; nothing below it while nobody knows where it is
world/objects/OBJECT/shape/...       boxes, cylinders, balls of its file, coloured by `ObjectAppearance`
world/objects/OBJECT/beads, /tags    what it is seen by
world/contact/HAND/OBJECT/points     where it is nearest to each finger: red touched, yellow within 3 cm
world/contact/HAND/OBJECT/gaps       from the fingertip to there, with the distance of the skin
plots/contact_mm/OBJECT/FINGER       distance of the skin, negative inside
states/HAND/OBJECT                   held, touched
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
import rerun as rr

from common.arrays import Float
from common.calibration.object_profile import BoxShape, CylinderShape, ObjectProfile, Shape
from common.geometry.tag_family import tag_image
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import FINGERS
from common.messages import Contact, Gesture, ObjectPose
from master.outputs.drawing import GESTURE_RGB, OBJECT_RGB, TOUCH_RGB, ObjectAppearance, Rgb, pack, series_rgb
from master.outputs.rerun_blueprint import EVENTS, WORLD, Columns, States, seen

_LINE_M = 0.0012
_ARC_STEP_RAD = np.deg2rad(4.0)
_LABEL_M = np.array([0.0, -0.02, 0.0])  # of a name: above what it names


class GesturesLayer:
    """Logger of gestures to a recording that belongs to the caller."""

    def __init__(self, recording: rr.RecordingStream, states: States) -> None:
        self._rec, self._states = recording, states
        self._tapped: dict[str, int] = {}

    def log(self, gestures: Sequence[Gesture], joints_m: Mapping[tuple[str, int], Float]) -> None:
        """Log gestures of any hands, in the order of time.

        `joints_m`: hand and `t_ns` -> (6, 3) the five tips and the palm [m], rig frame, where they are known.
        """
        for one in gestures:
            root = rr.new_entity_path([WORLD, "gestures", one.hand])
            at = joints_m.get((one.hand, one.t_ns), np.full((6, 3), np.nan))
            self._states.at(one.t_ns)
            tap_ns = 500_000_000
            if one.t_ns - self._tapped.get(one.hand, one.t_ns) > tap_ns:
                del self._tapped[one.hand]
                self._rec.log(f"{root}/tap", rr.Clear(recursive=True))
            if one.kind == "tap":
                self._tapped[one.hand] = one.t_ns
                self._name(f"{root}/tap", f"key {one.name}", at[0], GESTURE_RGB["tap"])
                self._states.log(f"{one.hand}/tap", one.began_t_ns, one.name)
                self._states.log(f"{one.hand}/tap", one.t_ns, None)
            else:
                self._held(root, one, at)
            if one.phase != "update":
                self._states.at(one.t_ns)
                self._rec.log(
                    rr.new_entity_path([EVENTS, one.hand]),
                    rr.TextLog(f"{one.phase} {one.kind}: {label_of(one)}", level="INFO"),
                )

    def _held(self, root: str, one: Gesture, at: Float) -> None:
        path, colour = f"{root}/{'ray' if one.kind == 'point' else one.kind}", GESTURE_RGB[one.kind]
        if one.phase == "end":
            self._states.log(f"{one.hand}/{one.kind}", one.t_ns, None)
            self._states.at(one.t_ns)
            self._rec.log(path, rr.Clear(recursive=True))
            return
        if one.phase == "begin":
            self._states.log(f"{one.hand}/{one.kind}", one.t_ns, one.name)
            self._states.at(one.t_ns)
        if one.kind == "pose":
            self._name(path, one.name, at[5] + _LABEL_M, colour)
        elif one.kind == "pinch":
            self._pinch(path, one, at, colour)
        elif one.kind == "dial" and np.isfinite(one.direction).all() and np.isfinite(one.origin_m).all():
            self._dial(path, one, colour)
        elif one.kind == "point" and np.isfinite(one.direction).all() and np.isfinite(one.origin_m).all():
            ray_m = 0.35
            arrow = rr.Arrows3D(
                origins=[one.origin_m], vectors=[ray_m * one.direction], radii=_LINE_M, colors=[colour]
            )
            self._rec.log(path, arrow)

    def _name(self, path: str, name: str, at: Float, colour: Rgb) -> None:
        if np.isfinite(at).all():
            self._rec.log(
                path, rr.Points3D([at], radii=1e-4, colors=[colour], labels=[name], show_labels=True)
            )

    def _pinch(self, path: str, one: Gesture, at: Float, colour: Rgb) -> None:
        ends = at[[0, FINGERS.index(one.name)]] if one.name in FINGERS else at[:0]
        strip = ends if len(ends) == 2 and np.isfinite(ends).all() else np.tile(one.origin_m, (2, 1))
        if not np.isfinite(strip).all():
            return
        closed = 0.35 + 0.65 * (one.strength if isfinite(one.strength) else 0.0)
        bright = [round(part * closed) for part in colour]
        line = rr.LineStrips3D(
            [strip], radii=2 * _LINE_M, colors=[bright], labels=[label_of(one)], show_labels=True
        )
        self._rec.log(path, line)

    def _dial(self, path: str, one: Gesture, colour: Rgb) -> None:
        dial_m = 0.045
        circle = dial_m * arc(one.direction, 2.0 * np.pi) + one.origin_m
        thin = rr.LineStrips3D([circle], radii=0.4 * _LINE_M, colors=[colour])
        self._rec.log(path, thin)
        if not isfinite(one.angle_rad):
            return
        rotated = dial_m * arc(one.direction, one.angle_rad) + one.origin_m
        strip = np.concatenate([one.origin_m[None], rotated, one.origin_m[None]])
        thick = rr.LineStrips3D(
            [strip], radii=2.0 * _LINE_M, colors=[colour], labels=[label_of(one)], show_labels=True
        )
        self._rec.log(f"{path}/turned", thick)


def arc(axis: Float, angle_rad: float) -> Float:
    """Return points (N, 3) of a unit circle about an axis, from its top (-y) on."""
    first = np.array([0.0, -1.0, 0.0]) - axis * -axis[1]
    if np.linalg.norm(first) < 1e-3:
        first = np.array([1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    angles = np.linspace(0.0, angle_rad, 2 + int(abs(angle_rad) / _ARC_STEP_RAD))[:, None]
    return np.cos(angles) * first + np.sin(angles) * np.cross(axis, first)


def label_of(one: Gesture) -> str:
    """A gesture in words."""
    if one.kind == "pinch":
        return f"{one.name} {one.distance_m * 1e3:.0f} mm" if isfinite(one.distance_m) else one.name
    if one.kind == "dial":
        return f"dial {np.rad2deg(one.angle_rad):+.0f}°" if isfinite(one.angle_rad) else "dial"
    what = {"tap": f"key {one.name}", "point": "pointing"}.get(one.kind, one.name)
    return what if one.kind == "tap" else f"{what} {one.confidence:.2f}"


_UNKNOWN = np.full((5, 3), np.nan)


@dataclass(slots=True)
class _Shown:
    """How an object is shown now."""

    profile: ObjectProfile | None
    look: ObjectAppearance | None = None


class ObjectsLayer:
    """Logger of objects and contact to a recording that belongs to the caller."""

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
            root = rr.new_entity_path([WORLD, "objects", name])
            shown = self._shown.setdefault(name, _Shown(None))
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

        `tips_m`: hand and `t_ns` -> the five fingertips, and what else there is (N, 3) [m], where they are
        known.
        """
        for hand, name in dict.fromkeys((one.hand, one.object) for one in contacts):
            own = [one for one in contacts if (one.hand, one.object) == (hand, name)]
            t = np.array([one.t_ns for one in own], np.int64)
            root = rr.new_entity_path([WORLD, "contact", hand, name])
            distance = np.array([one.distance_m for one in own])
            point = np.array([one.point_m for one in own])
            touching = np.array([one.touching for one in own])
            near_m = 0.03  # of a finger that is shown beside an object
            near = seen(point) & (distance < near_m)
            colours = pack([TOUCH_RGB[False], TOUCH_RGB[True]])[touching.astype(np.int64)]
            spot_m, touch_m = 0.002, 0.0045
            radii = np.where(touching, touch_m, spot_m)[near]
            self._rows.points(f"{root}/points", t, point, near, colours, radii)
            tips = np.array([tips_m.get((hand, one.t_ns), _UNKNOWN)[:5] for one in own])
            lines, near = np.stack([tips, point], axis=2), near & seen(tips)
            labels = [f"{value:.0f} mm" for value in (distance[near] * 1e3).tolist()]
            gaps = list(lines[near])
            self._rows.strips(f"{root}/gaps", t, gaps, near.sum(axis=1), colours[near], 0.0006, labels)
            for i, finger in enumerate(FINGERS):
                self._rows.scalars(_plot(name, finger), t, distance[:, i] * 1e3)
            for one in own:
                state = "held" if one.held else "touched" if one.touching.any() else None
                self._states.log(f"{hand}/{name}", one.t_ns, state)

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
