"""How the palm of a wrist device lies against the vertical: the IMU's orientation at an instant, as it is mounted.

Camera, IMU and palm are one body, since the device is strapped to the forearm. So the palm's turn in the IMU's world,
whose z axis is up, is

    R_world_palm = R_world_imu R_palm_imu^T

and the rig's frame, which moves with the camera, is not needed; `imu.q_rig_world` tells only where a simulated forearm
begins. Gravity holds the tilt. Nothing holds the heading: it is zero anywhere, and its standard deviation is how far
it may have drifted since the first sample: as the slave's filter says with each sample, or the rig's figure for that.
"""

from collections import Counter
from math import hypot, nan, pi, sqrt

import numpy as np

from common.arrays import Float
from common.calibration import ImuCalibration
from common.geometry import matrix_to_quaternion, quaternion_to_matrix
from master.estimator.settings import DEFAULT
from master.fusion.orientation import turn_of
from master.fusion.orientation_samples import OrientationSamples

_ANYWHERE_RAD = pi / sqrt(3.0)  # standard deviation of a uniform circle
NO_WORLD = np.full(4, np.nan), np.full(2, np.nan)


class PalmWorld:
    """Push machine. Holds the samples of one IMU.

    Attributes:
        samples: What it holds.
        counts: `orientation.used`, instants that had one, `orientation.absent`, those farther than 50 ms from any;
            samples left out, as of `OrientationSamples`.
    """

    def __init__(self, imu: ImuCalibration, counts: Counter[str] | None = None) -> None:
        """Follow the IMU of a rig file, counting into `counts` if given.

        Raises:
            CalibrationError: The file does not say how it is mounted.
        """
        self._imu, self._imu_palm = imu, turn_of("q_palm_imu", imu.q_palm_imu).T
        self.counts: Counter[str] = Counter() if counts is None else counts
        self.samples = OrientationSamples(self.counts, imu.heading_drift_rad_s, imu.stamp_offset_us)

    def push(self, t_ns: int, wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take one sample: quaternion (4,), IMU axes -> its world, and how far its heading has drifted if told."""
        self.samples.push(t_ns, wxyz, heading_sigma_rad)

    def at(self, t_ns: int) -> tuple[Float, Float]:
        """The palm at an instant: palm axes -> the IMU's world.

        Returns:
            Quaternion (4,), and standard deviations (2,) [rad]: tilt per axis, heading; NaN: not known.
        """
        found = self.samples.between(t_ns)
        if found is None:
            self.counts["orientation.absent"] += 1
            return NO_WORLD
        self.counts["orientation.used"] += 1
        turned = DEFAULT.palm_walk_rad_s * found.away_s
        tilt = hypot(self._imu.orientation_sigma_rad, turned)
        heading = hypot(self._imu.heading_sigma_rad or 0.0, found.drift_rad, turned)
        palm = matrix_to_quaternion(quaternion_to_matrix(found.q_wxyz) @ self._imu_palm)
        return palm, np.array([tilt, min(heading, _ANYWHERE_RAD)])
