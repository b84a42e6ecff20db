"""Viewer and picture share these colours, states and wrist geometry.

Colours of a hand, the same in the viewer and in the picture.

Okabe & Ito, 2008: safe for colour-blind eyes.

How well an object's position is known, in one word.

The viewer and the picture of a run colour the object by it.

Drawable lines of a wrist device's laser light.

Rays of its fan, and arcs across them.

Pose of a wrist device in the frame of a marker rig.

The device is on the forearm, which the solved palm and the wrist's flexion place.

    R_rig_forearm = R_rig_palm R_forearm_palm^T,  T_rig_camera = [R_rig_forearm, wrist] T_camera_palm^-1

with `T_camera_palm` of a straight wrist (`common.hand.wrist`). A bend that is not measured counts as none.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from common.arrays import Float
from common.calibration import RigCalibration
from common.geometry.transforms import invert, quaternion_to_matrix
from common.hand.model import WRIST, HandModel
from common.hand.wrist import forearm_palm
from common.messages import ObjectPose, Source
from master.outputs.poses import Poses
from master.rig.wrist import WristSetup

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

    Evenly spaced over the fan.

    Where the rig does not specify where its middle goes, that is the camera's view, as far as it lies in the plane.
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
    """Return the line strips (n, 3) [m] of a laser fan: rays, and arcs across.

    From `laser_m` (3,) along `rays` (K, 3).
    """
    outline = [np.stack([laser_m, laser_m + _REACH_M[-1] * ray]) for ray in rays]
    return outline + [laser_m + reach * rays for reach in _REACH_M]


_ELBOW = np.array(
    [0.0, 0.0, -1.0]
)  # along the forearm, in its own axes: the fingers of a straight hand go along z


@dataclass(frozen=True, slots=True, eq=False)
class DevicePlace:
    """Forearm poses at T times.

    NaN where the pose is not valid.

    Attributes:
        wrist_m: (T, 3) the wrist [m], rig frame.
        R_rig_palm: (T, 3, 3).
        R_rig_forearm: (T, 3, 3).
        wrist_angles_rad, sigma_rad: (T, 2) flexion and deviation of the wrist, as in the poses; NaN: not measured.
    """

    wrist_m: Float
    R_rig_palm: Float
    R_rig_forearm: Float
    wrist_angles_rad: Float
    sigma_rad: Float

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
        """Return the poses (T, 4, 4) of the device's camera, camera -> rig.

        From T_camera_palm (4, 4) of the device's file.
        """
        T_palm_camera = invert(T_camera_palm)
        out = np.tile(np.eye(4), (len(self.wrist_m), 1, 1))
        out[:, :3, :3] = self.R_rig_forearm @ T_palm_camera[:3, :3]
        out[:, :3, 3] = self.R_rig_forearm @ T_palm_camera[:3, 3] + self.wrist_m
        return out

    def arm_m(self, length_m: float) -> Float:
        """Lines (T, 2, 3) [m] from the wrist towards the elbow."""
        return np.stack([self.wrist_m, self.wrist_m + length_m * (self.R_rig_forearm @ _ELBOW)], axis=1)

    def uncertainty_m(self, length_m: float) -> Float:
        """Return 2 sigma rings (T, K, 3) [m] about the ends of `arm_m`.

        Where these ends are at 2 sigma of the wrist's flexion; NaN: not known.
        """
        corners = 24
        angle = np.linspace(0.0, 2.0 * np.pi, corners)
        around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        sigmas = 2.0
        wrist_angles = self.wrist_angles_rad[:, None] + sigmas * self.sigma_rad[:, None] * around
        forearm = self.R_rig_palm[:, None] @ np.swapaxes(forearm_palm(wrist_angles), 2, 3)
        return self.wrist_m[:, None] + length_m * (forearm @ _ELBOW)
