"""Pose of a wrist device in the frame of a marker rig.

The device is on the forearm, which the solved palm and the wrist's flexion place.

    R_rig_forearm = R_rig_palm R_forearm_palm^T,  T_rig_camera = [R_rig_forearm, wrist] T_camera_palm^-1

with `T_camera_palm` of a straight wrist (`common.hand.wrist_joint`). A bend that is not measured counts as none.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry.transforms import invert, quaternion_to_matrix
from common.hand.model import WRIST, HandModel
from common.hand.wrist_joint import forearm_palm
from master.outputs.poses import Poses

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
