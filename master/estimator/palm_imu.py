"""Orientation of the palm measured by an IMU on it.

The IMU is mounted and placed in the rig; the orientation has its covariance.

An IMU measures its axes in a world of its own, whose z axis is vertical:

    R_rig_palm = R_rig_world R_world_imu R_palm_imu^T

Two of the three numbers are held by gravity: the tilt against the vertical. The third, the heading about it, is only
summed up from angular rates and drifts, unless a magnetometer holds it. So the covariance is narrow across the vertical
and wide about it. A heading of which nothing is known is taken from the hand as it was solved, and left to it.
"""

from collections import Counter
from math import atan2, hypot, nan

import numpy as np

from common.arrays import Float
from common.calibration import ImuCalibration, Quaternion
from common.errors import CalibrationError
from common.geometry.transforms import (
    matrix_of,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)
from master.estimator.epoch import OrientationMeasurement
from master.estimator.imu_samples import OrientationSamples
from master.estimator.settings import DEFAULT
from master.fabrik.estimate import SolvedHand

SURE_RAD = np.radians(15.0)  # about every axis: better known than this, it determines how the palm lies
_EYE = np.eye(3)


class OrientationTrack:
    """Push machine. Holds the samples of one IMU.

    Attributes:
        counts: `orientation.used`, epochs that had one, `orientation.absent`, those that had none; samples rejected:
            `orientation.missing`, `orientation.not_unit`, `orientation.late`.
    """

    def __init__(self, imu: ImuCalibration, counts: Counter[str] | None = None) -> None:
        """Follow the IMU of a rig file, counting into `counts` if given.

        Raises:
            CalibrationError: The file does not state how it is mounted, or how its world lies to the rig.
        """
        self._imu = imu
        self._palm_imu = rotation_of("q_palm_imu", imu.q_palm_imu)
        self._rig_world = rotation_of("q_rig_world", imu.q_rig_world)
        self._up = self._rig_world[:, 2]
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._samples = OrientationSamples(self.counts, imu.heading_drift_rad_s, imu.stamp_offset_us)

    def push(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take one sample: quaternion (4,), IMU axes -> its world.

        See `OrientationSamples.push`.
        """
        self._samples.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def at(self, t_ns: int, near: SolvedHand | None) -> OrientationMeasurement | None:
        """Return the palm's orientation at a time.

        None where no sample is near enough.

        Args:
            t_ns: The epoch.
            near: The hand as it was solved, which gives the heading where the IMU has none; None: not known.
        """
        found = self._samples.between(t_ns)
        heading_rad = None if found is None else self._heading_rad(found.drift_rad)
        if found is None or (heading_rad is None and near is None):
            self.counts["orientation.absent"] += 1
            return None
        self.counts["orientation.used"] += 1
        rotation = self._rig_world @ matrix_of(found.q_wxyz) @ self._palm_imu.T
        if heading_rad is None and near is not None:
            rotation = _twist_about(self._up, near.T_rig_palm[:3, :3] @ rotation.T) @ rotation
        tilt_2 = self._imu.orientation_sigma_rad**2 + (DEFAULT.palm_process_noise_rad_s * found.away_s) ** 2
        free_rad = 10.0  # constrains nothing beside any marker
        about_2 = max((free_rad if heading_rad is None else heading_rad) ** 2, tilt_2)
        along = np.outer(self._up, self._up)
        information = _EYE / tilt_2 + (1.0 / about_2 - 1.0 / tilt_2) * along
        return OrientationMeasurement(rotation, information, sure=about_2 < SURE_RAD**2)

    def _heading_rad(self, drift_rad: float) -> float | None:
        """Standard deviation of the heading after such a drift; None: not known."""
        if self._imu.heading_sigma_rad is None:
            return None
        predicted = hypot(self._imu.heading_sigma_rad, drift_rad)
        lost_rad = 1.0  # a heading less sure than this may point anywhere (a uniform circle has 1.8)
        return predicted if predicted < lost_rad else None


def _twist_about(axis: Float, rotation: Float) -> Float:
    """Return the rotation (3, 3) about a unit axis (3,) nearest to a given one.

    For a rotation (3, 3) this is its twist.
    """
    w, *v = matrix_to_quaternion(rotation)
    return rotation_vector_to_matrix(2.0 * atan2(float(np.array(v) @ axis), float(w)) * axis)


def rotation_of(key: str, value: Quaternion | None) -> Float:
    """The rotation (3, 3) of a key of the rig file.

    Raises:
        CalibrationError: It is missing.
    """
    if value is None:
        raise CalibrationError(
            f"imu.{key}: missing; the orientation of the IMU cannot be used without: a quaternion wxyz of length 1"
        )
    return quaternion_to_matrix(np.array(value))
