"""Draw hands, points and panels into pictures.

Viewer and picture share colours (Okabe & Ito, 2008: safe for colour-blind eyes), object states, and the
geometry of a wrist device. The device is on the forearm, which the solved palm and the wrist's flexion place
in the rig frame:

    R_rig_forearm = R_rig_palm R_forearm_palm^T,  T_rig_camera = [R_rig_forearm, wrist] T_camera_palm^-1

with `T_camera_palm` of a straight wrist (`common.hand.wrist`); a bend that is not measured counts as none. A
hand is drawn as spheres swept along bones and palm into a depth buffer, orthographic, in OpenCV's axes.
"""

from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from common.arrays import Float
from common.calibration import RigCalibration
from common.geometry.transforms import invert, quaternion_to_matrix
from common.hand.model import FINGER_JOINTS, FINGERS, WRIST, HandModel
from common.hand.wrist import forearm_palm
from common.messages import ObjectPose, Source
from master.outputs.poses import Poses, PosesTruth, distance_m, mean_known
from master.rig.setup import WristSetup

Rgb = tuple[int, int, int]

SOURCE_RGB: dict[Source, Rgb] = {
    Source.NONE: (130, 130, 130),
    Source.MEASURED: (0, 158, 115),
    Source.SOLVED: (86, 180, 233),
    Source.HELD: (230, 159, 0),
    Source.WRIST: (204, 121, 167),
}
SOURCE_MEANING: dict[Source, str] = {
    Source.NONE: "no pose",
    Source.MEASURED: "measured by a marker",
    Source.SOLVED: "solved from markers",
    Source.HELD: "held (lost from sight)",
    Source.WRIST: "from the wrist device",
}
TRUTH_RGB: Rgb = (170, 170, 178)
LIMIT_RGB: Rgb = (213, 60, 40)
RAY_RGB: Rgb = (240, 228, 66)
TOUCH_RGB: dict[bool, Rgb] = {False: (240, 228, 66), True: (213, 60, 40)}  # whether a finger touches
GESTURE_RGB: dict[str, Rgb] = {
    "pose": (235, 235, 240),
    "pinch": (204, 121, 167),
    "dial": (240, 228, 66),
    "tap": (230, 159, 0),
    "point": (86, 180, 233),
}
_SERIES: tuple[Rgb, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (204, 121, 167),
    (213, 94, 0),
)


def series_rgb(index: int) -> Rgb:
    """Colour of finger or marker number `index`; after six they repeat."""
    return _SERIES[index % len(_SERIES)]


def pack(colours: list[Rgb], alpha: int = 255) -> npt.NDArray[np.uint32]:
    """Colours as Rerun stores them, 0xRRGGBBAA."""
    rgb = np.array(colours, np.uint32).reshape(-1, 3)
    return ((rgb[:, 0] << 24) | (rgb[:, 1] << 16) | (rgb[:, 2] << 8) | alpha).astype(np.uint32)


def dim(colours: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
    """Half as bright: each byte is halved, the alpha stays whole."""
    return (((colours >> 1) & 0x7F7F7F00) | 0xFF).astype(np.uint32)


class ObjectAppearance(Enum):
    """One state of an object, and what it means."""

    WHOLE = "tracked"
    HIDDEN = "tracked, a part is hidden"
    HELD = "held (lost from sight)"
    GONE = "nobody knows where"

    @staticmethod
    def of(pose: ObjectPose) -> "ObjectAppearance":
        """That of a pose."""
        if not np.isfinite(pose.position_m).all():
            return ObjectAppearance.GONE
        if not pose.tracked:
            return ObjectAppearance.HELD
        return ObjectAppearance.HIDDEN if pose.occluded else ObjectAppearance.WHOLE


OBJECT_RGB: dict[ObjectAppearance, Rgb] = {
    ObjectAppearance.WHOLE: (0, 158, 115),
    ObjectAppearance.HIDDEN: (86, 180, 233),
    ObjectAppearance.HELD: (230, 159, 0),
    ObjectAppearance.GONE: (130, 130, 130),
}


LASER_RGB: Rgb = (235, 64, 52)
_FAN_RAD = np.radians(105.0)  # of the laser line of Digits, where the rig does not specify it
_REACH_M = (0.06, 0.12, 0.18)  # arcs; the fingers of a large hand end within the last


def fan_rays(rig: RigCalibration, setup: WristSetup) -> Float:
    """Return unit directions (K, 3) of the laser fan in the camera frame.

    Where the rig does not specify its middle, that is the camera's view projected onto the laser plane.
    """
    laser = rig.laser
    ahead = np.array([0.0, 0.0, 1.0] if laser is None or laser.forward is None else laser.forward)
    ahead = ahead - (ahead @ setup.normal) * setup.normal
    ahead /= np.linalg.norm(ahead)
    across = np.cross(setup.normal, ahead)
    half = (_FAN_RAD if laser is None or laser.fan_rad is None else laser.fan_rad) / 2.0
    rays = 22  # about every 5 degrees
    angles = np.linspace(-half, half, rays)[:, None]
    return np.cos(angles) * ahead + np.sin(angles) * across


def fan(laser_m: Float, rays: Float) -> list[Float]:
    """Return the line strips (n, 3) [m] of a laser fan: rays, and arcs across."""
    outline = [np.stack([laser_m, laser_m + _REACH_M[-1] * ray]) for ray in rays]
    return outline + [laser_m + reach * rays for reach in _REACH_M]


# along the forearm, in its own axes: the fingers of a straight hand go along z
_ELBOW = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class DevicePlace:
    """Forearm poses at T times, rig frame; NaN where the pose is not valid."""

    wrist_m: Float  # (T, 3) the wrist [m]
    R_rig_palm: Float  # (T, 3, 3)
    R_rig_forearm: Float  # (T, 3, 3)
    wrist_angles_rad: Float  # (T, 2) flexion and deviation of the wrist, as in the poses; NaN: not measured
    sigma_rad: Float  # (T, 2) of these angles

    @classmethod
    def of(cls, poses: Poses, hand: HandModel) -> "DevicePlace":
        """Of poses in the rig frame."""
        known = poses.valid[:, WRIST] & np.isfinite(poses.orientation_wxyz[:, WRIST]).all(axis=1)
        R = np.full((len(poses), 3, 3), np.nan)
        R[known] = quaternion_to_matrix(poses.orientation_wxyz[known, WRIST]) @ hand.rest_rotation[WRIST].T
        wrist_m = np.where(known[:, None], poses.position_m[:, WRIST], np.nan)
        wrist_angles = np.nan_to_num(poses.wrist_angles_rad)
        forearm = R @ np.swapaxes(forearm_palm(wrist_angles), 1, 2)
        return cls(wrist_m, R, forearm, poses.wrist_angles_rad, poses.wrist_angles_sigma_rad)

    def cameras(self, T_camera_palm: Float) -> Float:
        """Return the poses (T, 4, 4) of the device's camera, camera -> rig."""
        T_palm_camera = invert(T_camera_palm)
        out = np.tile(np.eye(4), (len(self.wrist_m), 1, 1))
        out[:, :3, :3] = self.R_rig_forearm @ T_palm_camera[:3, :3]
        out[:, :3, 3] = self.R_rig_forearm @ T_palm_camera[:3, 3] + self.wrist_m
        return out

    def arm_m(self, length_m: float) -> Float:
        """Lines (T, 2, 3) [m] from the wrist towards the elbow."""
        return np.stack([self.wrist_m, self.wrist_m + length_m * (self.R_rig_forearm @ _ELBOW)], axis=1)

    def uncertainty_m(self, length_m: float) -> Float:
        """Rings (T, K, 3) [m]: ends of `arm_m` at 2 sigma of the bend; NaN: not known."""
        corners = 24
        angle = np.linspace(0.0, 2.0 * np.pi, corners)
        around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        sigmas = 2.0
        wrist_angles = self.wrist_angles_rad[:, None] + sigmas * self.sigma_rad[:, None] * around
        forearm = self.R_rig_palm[:, None] @ np.swapaxes(forearm_palm(wrist_angles), 2, 3)
        return self.wrist_m[:, None] + length_m * (forearm @ _ELBOW)


Pixels = npt.NDArray[np.float32]

_LIGHT = np.array([-0.45, -0.6, -0.66], np.float32)
_WEBS = ((1, 2), (2, 3), (3, 4))  # neighbouring fingers whose metacarpals the palm spans


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Where the eye stands."""

    rotation: Float  # rig frame -> view frame (3, 3)
    centre_m: Float  # point of the rig frame (3,) [m] that is drawn at the centre of the image
    scale_px_m: float  # pixels per metre
    width_px: int
    height_px: int

    def project(self, points_m: Float) -> Float:
        """Project points (..., 3) [m] of the rig frame to u, v, depth (..., 3) [px]."""
        view = (points_m - self.centre_m) @ self.rotation.T * self.scale_px_m
        return view + np.array([self.width_px / 2, self.height_px / 2, 0.0])


def render_hand(view: View, position_m: Float, radius_m: Float) -> tuple[Pixels, Pixels]:
    """Draw one hand: brightness (H, W) in 0..1, and coverage (H, W), 0 or 1.

    Args:
        position_m: Joints (26, 3) [m], rig frame. A bone with a NaN end is not drawn.
        radius_m: (26,) [m].
    """
    depth = np.full((view.height_px, view.width_px), np.inf, np.float32)
    normal = np.zeros((view.height_px, view.width_px, 3), np.float32)
    for sphere in _spheres(position_m, radius_m):
        _draw_sphere(depth, normal, view.project(sphere[:3]), float(sphere[3]) * view.scale_px_m)
    covered = np.isfinite(depth)
    lambert = np.clip(normal @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    facing = np.clip(-normal[..., 2], 0.0, 1.0)
    brightness = 0.30 + 0.58 * lambert + 0.16 * facing**2
    return np.where(covered, brightness, 0.0).astype(np.float32), covered.astype(np.float32)


def _spheres(position_m: Float, radius_m: Float) -> Float:
    """Centres and radii (N, 4) [m] that fill the hand."""
    joints = np.column_stack([position_m, radius_m])
    wrist_share = 0.75  # a wrist is flat: half its width would make a ball of it
    joints[WRIST, 3] *= wrist_share
    segments = [(joints[a], joints[b]) for chain in FINGER_JOINTS for a, b in pairwise(chain)]
    web_steps = 28
    for left, right in _WEBS:
        a, b = joints[list(FINGER_JOINTS[left][:2])], joints[list(FINGER_JOINTS[right][:2])]
        segments += [tuple((1 - t) * a + t * b) for t in np.linspace(0.0, 1.0, web_steps)[1:-1]]
    # The ball of the thumb spans from the lower part of the thumb's metacarpal to that of the index finger's.
    thumb, index = joints[list(FINGER_JOINTS[0][:2])], joints[list(FINGER_JOINTS[1][:2])]
    thumb, root = (np.stack([bone[0], 0.45 * bone[0] + 0.55 * bone[1]]) for bone in (thumb, index))
    segments += [tuple((1 - t) * thumb + t * root) for t in np.linspace(0.0, 1.0, web_steps)[1:-1]]
    segments += [(joints[WRIST], joints[chain[0]]) for chain in FINGER_JOINTS]
    swept = [_sweep(a, b) for a, b in segments if np.isfinite(a + b).all()]
    return np.concatenate(swept) if swept else np.empty((0, 4))


def _sweep(a: Float, b: Float) -> Float:
    """Spheres (N, 4) from `a` to `b`, radius changing evenly."""
    length = float(np.linalg.norm(b[:3] - a[:3]))
    step = 0.12  # of a radius, between swept spheres: ripples stay far below a pixel
    count = 2 + int(length / (step * max(min(a[3], b[3]), 1e-3)))
    t = np.linspace(0.0, 1.0, count)[:, None]
    return (1 - t) * a + t * b


def _draw_sphere(depth: Pixels, normal: Pixels, centre: Float, radius_px: float) -> None:
    """Put one sphere into depth and normal buffers; parts outside the image are cut."""
    height, width = depth.shape
    u0, u1 = max(int(centre[0] - radius_px), 0), min(int(centre[0] + radius_px) + 2, width)
    v0, v1 = max(int(centre[1] - radius_px), 0), min(int(centre[1] + radius_px) + 2, height)
    if u0 >= u1 or v0 >= v1:
        return
    x = ((np.arange(u0, u1) - centre[0]) / radius_px).astype(np.float32)
    y = ((np.arange(v0, v1) - centre[1]) / radius_px).astype(np.float32)
    towards = 1.0 - x[None, :] ** 2 - y[:, None] ** 2
    z = np.sqrt(np.maximum(towards, 0.0))
    front = np.float32(centre[2]) - z * np.float32(radius_px)
    window = depth[v0:v1, u0:u1]
    nearer = (towards >= 0.0) & (front < window)
    window[nearer] = front[nearer]
    rows, columns = np.nonzero(nearer)
    normal[v0 + rows, u0 + columns] = np.column_stack([x[columns], y[rows], -z[nearer]])


Colour = tuple[float, float, float]

PAPER: Colour = (0.075, 0.09, 0.115)
INK: Colour = (0.90, 0.92, 0.94)
_PANEL: Colour = (0.105, 0.125, 0.155)
_BOTTOMS = (0.63, 0.345, 0.06)


def unit(rgb: Rgb) -> Colour:
    """A colour with parts in 0..1, as matplotlib takes it."""
    return (rgb[0] / 255, rgb[1] / 255, rgb[2] / 255)


def entry(colour: Colour, label: str, ls: str = "", **how: Any) -> Line2D:
    """An entry of a legend: a marker, or a line of the style `ls`."""
    return Line2D([], [], color=colour, ls=ls, label=label, **how)


def style(axes: Axes, title: str) -> None:
    """Dark panel with a title; all panels look alike."""
    axes.set_facecolor(_PANEL)
    axes.set_title(title, color=INK, size=12, loc="left", pad=6)
    axes.tick_params(colors=INK, labelsize=10, length=3)
    axes.grid(visible=True, color=INK, alpha=0.10, lw=0.8)
    axes.spines[:].set(color=INK, alpha=0.25)


def draw_panels(figure: Figure, poses: Poses, row: int, model: HandModel, truth: PosesTruth | None) -> None:
    """Draw three panels down the right side; a thin line marks the row shown."""
    left, width, height = 0.655, 0.33, 0.205
    boxes = [figure.add_axes((left, bottom, width, height)) for bottom in _BOTTOMS]
    seconds = (poses.t_ns - poses.t_ns[0]).astype(np.float64) * 1e-9
    _angles(boxes[0], poses, seconds, model)
    if truth is not None:
        _errors(boxes[1], poses, seconds, truth)
    else:
        _seen(boxes[1], poses, seconds)
    for axes in boxes[:2]:
        axes.axvline(float(seconds[row]), color=INK, lw=1.0, alpha=0.7)
        axes.set_xlim(0.0, float(seconds[-1]) if len(seconds) > 1 else 1.0)
        axes.set_xlabel("time [s]", color=INK, size=10, labelpad=1)
    if poses.latency_ns.any():
        _histogram(boxes[2], poses.latency_ns.astype(np.float64) * 1e-6, "Latency of a pose", "ms")
    else:
        step = distance_m(poses.markers_raw_m, poses.markers_m).ravel() * 1e3
        _histogram(boxes[2], step[~np.isnan(step)], "Marker: raw to filtered", "mm")


def _angles(axes: Axes, poses: Poses, seconds: Float, model: HandModel) -> None:
    style(axes, "PIP angle [deg]")
    pip = 2
    degrees = np.rad2deg(poses.angles_rad[:, :, pip])
    for finger, name in enumerate(FINGERS):
        axes.plot(seconds, degrees[:, finger], color=unit(series_rgb(finger)), lw=1.5, label=name)
    top = float(np.rad2deg(model.limits_rad[1, pip, 1]))
    axes.set_ylim(-15.0, top + 22.0)
    axes.axhline(top, color=INK, lw=0.9, ls=":", alpha=0.7)
    axes.text(0.995, top + 1.5, "limit", color=INK, size=9, ha="right", va="bottom", alpha=0.8,
              transform=axes.get_yaxis_transform())  # fmt: skip
    _legend_above(axes)


def _errors(axes: Axes, poses: Poses, seconds: Float, truth: PosesTruth) -> None:
    style(axes, "Mean error to the truth [mm]")
    errors = {name: mean_known(error) * 1e3 for name, error in truth.errors_m(poses).items()}
    for (name, error), (colour, width) in zip(errors.items(), ((1, 1.5), (0, 1.2)), strict=True):
        label = "markers, unfiltered" if name == "markers" else name
        axes.plot(seconds, error, color=unit(series_rgb(colour)), lw=width, label=label)
    known = np.concatenate(list(errors.values()))
    known = known[~np.isnan(known)]
    # One gap in tracking must not flatten the rest of the curve.
    top = float(np.percentile(known, 99)) * 1.25 if len(known) else 1.0
    axes.set_ylim(0.0, max(top, 0.5))
    _legend_above(axes)


def _seen(axes: Axes, poses: Poses, seconds: Float) -> None:
    style(axes, "What was seen")
    name, points = ("markers", poses.markers_raw_m) if poses.marker_count else ("laser points", poses.laser_m)
    seen = (~np.isnan(points).any(axis=-1)).sum(axis=1)
    for colour, label, count in ((0, name, seen), (2, "joints tracked", poses.tracked.sum(axis=1))):
        axes.plot(seconds, count, color=unit(series_rgb(colour)), lw=1.3, drawstyle="steps-mid", label=label)
    axes.set_ylim(0.0, 27.0)
    _legend_above(axes)


def _histogram(axes: Axes, values: Float, title: str, what: str) -> None:
    style(axes, title)
    axes.set_xlabel(what, color=INK, size=10, labelpad=1)
    axes.set_ylabel("poses" if what == "ms" else "count", color=INK, size=10)
    if not len(values):
        axes.text(0.5, 0.5, "nothing measured", color=INK, ha="center", va="center", transform=axes.transAxes)
        return
    middle, tail = np.percentile(values, [50, 99])
    top = max(float(tail) * 1.35, 1e-3)
    bins = int(np.clip(2 * np.sqrt(len(values)), 12, 60))
    shown = np.minimum(values, top)  # the rare rest stands in the last bar
    heights = axes.hist(shown, bins=bins, range=(0.0, top), color=unit(series_rgb(1)), alpha=0.85)[0]
    axes.set_ylim(0.0, 1.2 * float(np.max(heights)))
    axes.set_xlim(0.0, top)
    label_width = 0.22  # of a panel
    # Near the axis there is no room on the left; on the right the two would meet, so one stands lower.
    side, height = ("right", 0.97) if middle > label_width * top else ("left", 0.86)
    for value, name, ha, y in ((middle, "p50", side, height), (tail, "p99", "left", 0.97)):
        axes.axvline(float(value), color=unit(series_rgb(0)), lw=1.4)
        gap = 4 if ha == "left" else -4
        axes.annotate(f"{name} {value:.1f} {what}", (float(value), y), (gap, 0), xycoords=axes.get_xaxis_transform(),
                      textcoords="offset points", color=INK, size=10, ha=ha, va="top")  # fmt: skip


def _legend_above(axes: Axes) -> None:
    axes.legend(loc="lower right", bbox_to_anchor=(1.01, 0.98), ncols=5, frameon=False, fontsize=9.5,
                handlelength=1.2, columnspacing=1.0, borderpad=0.2, labelcolor=INK)  # fmt: skip
