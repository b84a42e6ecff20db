"""Unknowns of a mounting: a point on a manifold, steps on it, and its prior."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.hand.palmar_surface import SPREAD

UNKNOWN = 34
CAMERA_IMU, SHIFT, FOREARM_IMU, RIG_WORLD, ZERO = (slice(3 * k, 3 * k + 3) for k in range(5))
CAMERA_LATE, IMU_LATE = 15, 16
THICK, REACH, GAIN = slice(17, 21), slice(21, 25), slice(25, 34)
_ZERO_RAD_S = np.radians(2.5)  # of the zero of a gyroscope when it is switched on (`common.imu_doubt`)


@dataclass(frozen=True, slots=True, eq=False)
class Unknown:
    """Unknowns that all epochs share.

    Camera and IMU are one body, so their turn against each other is fixed by every motion; how both are turned against
    the palm of a straight wrist, by what the wrist does.

    Attributes:
        R_camera_imu: (3, 3) IMU axes -> camera axes.
        shift_m: (3,) the wrist joint in the camera's frame.
        R_forearm_imu: (3, 3) IMU axes -> forearm, which is the palm of a straight wrist.
        R_rig_world: (3, 3) the world of the IMU's track -> rig.
        gyro: (12,) errors of its gyroscope, as of `tracks.ImuTrack`.
        camera_late_s, imu_late_s: How much later frames, samples are than their stamps state.
        thick, reach_m: (4,) of the fingers, as of `lines_of_sight.LinesOfSight`.
    """

    R_camera_imu: Float
    shift_m: Float
    R_forearm_imu: Float
    R_rig_world: Float
    gyro: Float
    camera_late_s: float
    imu_late_s: float
    thick: Float
    reach_m: Float

    @property
    def T_camera_palm(self) -> Float:
        """(4, 4) with a straight wrist."""
        return rigid(self.R_camera_imu @ self.R_forearm_imu.T, self.shift_m)

    def retracted(self, step: Float) -> Self:
        """After a step (UNKNOWN,); turns in front: by axes of camera, forearm and rig."""
        return type(self)(
            rotation_vector_to_matrix(step[CAMERA_IMU]) @ self.R_camera_imu,
            self.shift_m + step[SHIFT],
            rotation_vector_to_matrix(step[FOREARM_IMU]) @ self.R_forearm_imu,
            rotation_vector_to_matrix(step[RIG_WORLD]) @ self.R_rig_world,
            self.gyro + np.concatenate([step[ZERO], step[GAIN]]),
            self.camera_late_s + float(step[CAMERA_LATE]),
            self.imu_late_s + float(step[IMU_LATE]),
            self.thick + step[THICK],
            self.reach_m + step[REACH],
        )

    def off(self, first: Self) -> Float:
        """Return the deviation (UNKNOWN,) from the prior.

        Rotations, which have no prior, are 0.
        """
        out = np.zeros(UNKNOWN)
        out[SHIFT], out[ZERO], out[GAIN] = self.shift_m - first.shift_m, self.gyro[:3], self.gyro[3:]
        out[CAMERA_LATE] = self.camera_late_s - first.camera_late_s
        out[IMU_LATE] = self.imu_late_s - first.imu_late_s
        out[THICK], out[REACH] = self.thick, self.reach_m
        return out


def prior_sigma() -> Float:
    """Return the prior standard deviations (UNKNOWN,)."""
    any_rad, any_m, any_s = 1.0, 0.03, 0.1  # standard deviations of what nothing is known of
    sigma = np.full(UNKNOWN, any_rad)
    sigma[SHIFT], sigma[ZERO], sigma[[CAMERA_LATE, IMU_LATE]] = any_m, _ZERO_RAD_S, any_s
    gain = 0.015  # of its axes, and of how they lean to each other (ICM-20948, DS-000189, table 1)
    reach_m = 2e-3
    sigma[THICK], sigma[REACH], sigma[GAIN] = SPREAD, reach_m, gain
    return sigma
