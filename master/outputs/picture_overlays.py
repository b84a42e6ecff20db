"""Overlays draw wrist device, objects and gestures in the picture of a run.

Beside marker cameras a wrist device stands in their rig where palm and bend place it (`DevicePlace`), and the
forearm is drawn; alone, what its camera sees is drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from common.arrays import Float, Image, Int
from common.calibration.object_profile import BoxShape, CylinderShape, ObjectProfile, Shape, tag_corners
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import quaternion_to_matrix, rigid, transform
from common.hand.model import FINGER_JOINTS, FINGERS
from common.messages import FINGER_COUNT, Gesture, Source
from master.outputs.drawing import (
    GESTURE_RGB,
    INK,
    LASER_RGB,
    OBJECT_RGB,
    PAPER,
    SOURCE_RGB,
    TRUTH_RGB,
    DevicePlace,
    ObjectAppearance,
    View,
    entry,
    fan,
    fan_rays,
    series_rgb,
    style,
    unit,
)
from master.outputs.poses import Poses, PosesTruth
from master.outputs.result_files import Contacts, ObjectPoses, nearest_rows
from master.rig.setup import RigSetup, WristSetup

_BOX = (0.012, 0.03, 0.225, 0.30)  # left, bottom, width, height of the figure: an image of 4 to 3
_FOREARM_M = 0.055  # of it


@dataclass(frozen=True, slots=True, eq=False)
class WristPicture:
    """How to draw one wrist device."""

    rig: str  # name of its rig
    in_rig: bool  # poses are in the frame of a rig of markers, not of its camera
    setup: WristSetup
    camera: CameraModel
    rays: Float  # (K, 3) directions of the laser's light
    # what the camera saw by laser and LEDs at the row that is shown, (H, W) grey, or None
    frame: Image | None = None

    @classmethod
    def of(cls, setup: RigSetup, frame: Image | None = None) -> "WristPicture | None":
        """Of a wrist device, alone or beside marker cameras; None: there is none."""
        if setup.wrist is None or setup.wrist_rig is None:
            return None
        rays = fan_rays(setup.wrist_rig, setup.wrist)
        return cls(setup.wrist_rig.name, setup.has_markers, setup.wrist, setup.wrist.optics, rays, frame)

    def _place(self, poses: Poses, row: int) -> DevicePlace:
        return DevicePlace.of(poses.rows(row, row + 1), self.setup.model)

    def pose(self, poses: Poses, row: int) -> Float:
        """Return the camera's pose (4, 4) in the frame of the poses; NaN: not known."""
        return self._place(poses, row).cameras(self.setup.T_camera_palm)[0] if self.in_rig else np.eye(4)

    def reach_m(self, poses: Poses, row: int) -> Float:
        """Return points (N, 3) [m] that must be in the picture: camera, or forearm end."""
        return self._place(poses, row).arm_m(_FOREARM_M)[0] if self.in_rig else np.zeros((1, 3))

    def draw_laser(self, axes: Axes, view: View, poses: Poses, row: int) -> list[Line2D]:
        """Draw laser fan, points, and in a rig the forearm; return the legend entries."""
        T = self.pose(poses, row)
        for line in fan(self.setup.laser_m, self.rays):
            pixels = view.project(transform(T, line))
            axes.plot(pixels[:, 0], pixels[:, 1], color=unit(LASER_RGB), lw=0.8, alpha=0.4, zorder=4)
        points = view.project(transform(T, poses.laser_m[row]))
        for finger in range(FINGER_COUNT):
            colour = unit(series_rgb(finger))
            axes.plot(points[finger, 0], points[finger, 1], "D", mfc=colour, mec=PAPER, ms=9, zorder=8)
        forearm = [self._draw_forearm(axes, view, poses, row)] if self.in_rig else []
        return [
            *forearm,
            entry(unit(LASER_RGB), "laser", "-", lw=1.5),
            entry(unit(series_rgb(0)), "laser on a finger", marker="D", mec=PAPER, ms=9),
        ]

    def _draw_forearm(self, axes: Axes, view: View, poses: Poses, row: int) -> Line2D:
        """Draw the forearm and its end at 2 sigma; return the legend entry."""
        place, dashes = self._place(poses, row), (0, (4, 1.5))
        colour = unit(SOURCE_RGB[Source.WRIST])
        arm, ring = view.project(place.arm_m(_FOREARM_M)[0]), view.project(place.uncertainty_m(_FOREARM_M)[0])
        axes.plot(arm[:, 0], arm[:, 1], color=colour, lw=3.0, ls=dashes, zorder=4)
        axes.plot(ring[:, 0], ring[:, 1], color=colour, lw=1.0, zorder=4)
        flexion, deviation = np.degrees(place.wrist_angles_rad[0])
        bend = f"wrist bent {flexion:+.0f}°, {deviation:+.0f}°"
        bend = bend if np.isfinite(flexion) else "bend of the wrist not known"
        return Line2D([], [], color=colour, lw=3.0, ls=dashes, label=f"forearm, {bend}")

    def draw_camera(self, figure: Figure, poses: Poses, row: int, truth: PosesTruth | None) -> None:
        """Draw the camera's frame, hand and laser points as it should see them."""
        axes = figure.add_axes(_BOX)
        style(axes, "Camera, with the hand as solved")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(visible=False)
        axes.set_xlim(-0.5, self.camera.width_px - 0.5)
        axes.set_ylim(self.camera.height_px - 0.5, -0.5)
        if self.frame is not None:
            top = max(float(np.percentile(self.frame, 99.5)), 1.0)
            # level of the brightest skin as shown: such frames are dark
            bright = np.clip(self.frame * (200.0 / 255.0 / top), 0.0, 1.0)
            axes.imshow(bright, cmap="gray", vmin=0.0, vmax=1.0, interpolation="bilinear")
        at = np.where(poses.valid[row][:, None], poses.position_m[row], np.nan)
        seen = self.camera.project(at)
        for finger, joints in enumerate(FINGER_JOINTS):
            for a, b in pairwise(joints):
                axes.plot(seen[[a, b], 0], seen[[a, b], 1], color=unit(series_rgb(finger)), lw=1.8)
            axes.annotate(FINGERS[finger], seen[joints[-1]], (0, 5), textcoords="offset points",
                          color=unit(series_rgb(finger)), size=8, ha="center", annotation_clip=True)  # fmt: skip
        if truth is not None:
            true = self.camera.project(truth.joints_m[row])
            for joints in FINGER_JOINTS:
                x, y = true[list(joints)].T
                axes.plot(x, y, color=unit(TRUTH_RGB), lw=0.9, ls="--")
        points = self.camera.project(poses.laser_m[row])
        axes.plot(points[:, 0], points[:, 1], "D", mfc=unit(LASER_RGB), mec=PAPER, ms=6, ls="", zorder=8)


STRIP_BOX = (0.285, 0.055, 0.315, 0.135)  # left, bottom, width, height of the figure
_NEAR_NS = 60_000_000  # an object is shown where it was this close to the time shown
_LANES = {"pose": "pose", "pinch": "pinch", "dial": "dial", "tap": "keys", "point": "point"}
_ROUND = np.linspace(0.0, 2.0 * np.pi, 33)


@dataclass(frozen=True, slots=True, eq=False)
class ResultPicture:
    """What is drawn beside the hand: objects, contacts and gestures in time order."""

    profiles: Sequence[ObjectProfile] = ()
    objects: Sequence[ObjectPoses] = ()
    contacts: Sequence[Contacts] = ()
    gestures: Sequence[Gesture] = ()

    def interest(self, t_ns: Int) -> Float:
        """Rate how much the times (T,) show of the objects: 2 held, 1 known, 0 nothing."""
        known = np.zeros(len(t_ns))
        for poses in self.objects:
            if len(poses):
                rows = nearest_rows(poses.t_ns, t_ns)
                near = np.abs(poses.t_ns[rows] - t_ns) < _NEAR_NS
                known = np.maximum(known, near & poses.tracked[rows])
        for near in self.contacts:
            known += np.isin(t_ns, near.t_ns[near.held])
        return known

    def points_m(self, t_ns: int) -> Float:
        """Return the outline (N, 3) [m] of the objects at a time."""
        found = [
            transform(T, np.concatenate([_outline(part) for part in profile.shape]))
            for profile, T, _ in self._placed(t_ns)
            if profile.shape
        ]
        return np.concatenate(found) if found else np.empty((0, 3))

    def draw(self, axes: Axes, view: View, t_ns: int) -> list[Line2D]:
        """Draw the objects at a time; return the legend entries."""
        entries: list[Line2D] = []
        for profile, T, look in self._placed(t_ns):
            colour = unit(OBJECT_RGB[look])
            for part in profile.shape:
                pixels = view.project(transform(T, _outline(part)))[:, :2]
                hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
                axes.fill(hull[:, 0], hull[:, 1], fc=(*colour, 0.30), ec=(*colour, 0.95), lw=1.6, zorder=4.5)
            for tag in () if profile.tags is None else profile.tags.tags:
                pose = T @ np.array(tag.T_object_tag)
                if (view.rotation @ pose[:3, 2])[2] < -0.1:  # it looks at the eye
                    corners = view.project(transform(pose, tag_corners(tag.edge_m)))
                    axes.fill(corners[:, 0], corners[:, 1], fc=PAPER, ec=INK, lw=1.0, zorder=4.6)
            for bead in profile.markers.values():
                at = view.project(transform(T, np.array([bead.position_m])))[0]
                size = 2.0 * bead.radius_m * view.scale_px_m * 0.72  # points of 100 dots an inch
                axes.plot(at[0], at[1], "o", ms=size, mfc=(*colour, 0.6), mec=INK, mew=1.2, zorder=4.7)
            entries.append(entry(colour, f"{profile.name}, {look.value}", marker="s", ms=11))
        for near in self.contacts:
            rows = np.flatnonzero(near.t_ns == t_ns)
            if len(rows) and near.touching[rows[0]].any():
                at = view.project(near.point_m[rows[0]][near.touching[rows[0]]])
                red = (0.95, 0.25, 0.2)
                axes.plot(at[:, 0], at[:, 1], "x", color=red, ms=10, mew=3.0, zorder=9)
                entries.append(entry(red, "touched", marker="x", ms=9, mew=3))
        return entries

    def draw_strip(self, figure: Figure, t_ns: Int, row: int) -> None:
        """Draw the gestures over the run, a lane for each kind that occurred."""
        axes = figure.add_axes(STRIP_BOX)
        style(axes, "Gestures of the hand")
        first, span = int(t_ns[0]), max(float(t_ns[-1] - t_ns[0]) * 1e-9, 1e-3)
        lanes = [kind for kind in _LANES if any(one.kind == kind for one in self.gestures)]
        for lane, kind in enumerate(reversed(lanes)):
            for name, start_ns, stop_ns in spans(self.gestures, kind, int(t_ns[-1])):
                start, length = (start_ns - first) * 1e-9, (stop_ns - start_ns) * 1e-9
                edged_share = 0.01  # of it: what is shorter would be all edge
                colour, edged = unit(GESTURE_RGB[kind]), length > edged_share * span
                tap_s = 0.15
                axes.broken_barh(
                    [(start, max(length, tap_s))],
                    (lane - 0.38, 0.76),
                    fc=colour,
                    ec=PAPER if edged else colour,
                    lw=0.8,
                )
                letter_share = 0.0135  # of the strip's length that a letter takes
                letters = len(name) if kind == "tap" else int(length / (letter_share * span))
                lanes_of_two_lines = 3  # at most, else names have one line
                words = _words(name if len(lanes) > lanes_of_two_lines else name.replace("_", "\n"), letters)
                key = kind == "tap"
                thin = key and tap_s < letter_share * span
                axes.text(
                    start
                    + (tap_s if thin else 0.5 * tap_s if key else 0.0)
                    + (0.0 if key and not thin else 0.004 * span),
                    lane,
                    words,
                    size=8,
                    color=INK if thin else PAPER,
                    va="center",
                    ha="center" if key and not thin else "left",
                    clip_on=True,
                )
        axes.set_yticks(range(len(lanes)), [_LANES[kind] for kind in reversed(lanes)])
        axes.set_ylim(-0.6, len(lanes) - 0.4)
        axes.set_xlim(0.0, span)
        axes.axvline((int(t_ns[row]) - first) * 1e-9, color=INK, lw=1.0, alpha=0.7)

    def _placed(self, t_ns: int) -> list[tuple[ObjectProfile, Float, ObjectAppearance]]:
        """File, pose (4, 4) and appearance of each object that is known at a time."""
        profiles = {one.name: one for one in self.profiles}
        found: list[tuple[ObjectProfile, Float, ObjectAppearance]] = []
        for poses in self.objects:
            if not len(poses):
                continue
            row = int(nearest_rows(poses.t_ns, np.array([t_ns]))[0])
            (pose,) = poses.rows(row, row + 1).messages()
            look = ObjectAppearance.of(pose)
            if abs(pose.t_ns - t_ns) <= _NEAR_NS and look is not ObjectAppearance.GONE:
                T = rigid(quaternion_to_matrix(pose.orientation_wxyz), pose.position_m)
                found.append((profiles[poses.object], T, look))
        return found


def spans(gestures: Sequence[Gesture], kind: str, end_ns: int) -> list[tuple[str, int, int]]:
    """Name (of a tap: key), begin and end [ns] of every gesture of a kind, by begin."""
    found: dict[tuple[str, int], int] = {}
    ended: set[tuple[str, int]] = set()
    for one in gestures:
        if one.kind == kind:
            found[one.name, one.began_t_ns] = one.t_ns
            if one.phase == "end":
                ended.add((one.name, one.began_t_ns))
    return [
        (name, began, last if (name, began) in ended else end_ns)
        for (name, began), last in sorted(found.items(), key=lambda item: item[0][1])
    ]


def _words(name: str, letters: int) -> str:
    """Cut each line of a name to some letters; empty where that means nothing."""
    lines = name.split("\n")
    letters_least = 3  # of a name that is cut off
    if letters < min(max(map(len, lines)), letters_least):
        return ""
    return "\n".join(line[:letters] for line in lines)


def _outline(part: Shape) -> Float:
    """Points (N, 3) [m] whose hull is the part, in the object's frame."""
    if isinstance(part, BoxShape):
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        points = 0.5 * signs * np.array(part.size_m)
    elif isinstance(part, CylinderShape):
        ring = part.radius_m * np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=1)
        ends = [np.column_stack([ring, np.full(len(ring), z * part.length_m)]) for z in (-0.5, 0.5)]
        points = np.concatenate(ends)
    else:
        circle = part.radius_m * np.stack([np.cos(_ROUND), np.sin(_ROUND), 0.0 * _ROUND], axis=1)
        points = np.concatenate([np.roll(circle, shift, axis=1) for shift in range(3)])
    return points if part.T_object_part is None else transform(np.array(part.T_object_part), points)
