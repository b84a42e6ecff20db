"""Covariance of an error-state Kalman filter for the IMU orientation.

States how uncertain an integrated orientation is, and how it is corrected.

Eleven errors, after Sola 2017 ("Quaternion kinematics for the error-state Kalman filter", ch. 5) with the global error
of its ch. 7: attitude t (3,) [rad] in the world's axes, the gyroscope's bias b (3,) [rad/s] and scale s (3,) [1] in
the sensor's, level velocity v (2,) [m/s]. With R sensor -> world and w the rate,

    t' = -R (b + s w) + noise,      v' = g (t_y, -t_x).

Gravity is seen through the velocity: an arm gains none for long, so that the velocity which a tilted gravity sums up is
measured as zero. Velocity in the world's axes is where accelerations cancel (the almost inertial frame of Laidig, Seel
2023, section 4); here it is a state, so that the memory of the mean is the filter's own, and holds at any rate of
samples. Rest measures the bias. Neither moves the heading, of which they know nothing: its gain is zero, its covariance
that of a considered parameter (Schmidt 1966).

The figures are those of parts and arms, not of recordings:

- bias when switched on, 2.5 deg/s: +-5 deg/s of an ICM-20948 (DS-000189, table 1), taken as two sigma; LSM6DSO: +-1;
- its walk, 0.1 deg/s in 100 s, and how well rest shows it, to 0.03 deg/s within about 9 s: the defaults of VQF (Laidig,
  Seel 2023);
- noise, 0.015 deg/s/sqrt(Hz): the same part; LSM6DSO (DS12140, table 2) has a quarter of it;
- scale, 1 %: LSM6DSO +-1 %; what is wrong otherwise (across axes, not linear), 0.3 % of the rate, half a second long;
- velocity, 0.35 m/s along each axis for 0.6 s: fingertips of recorded hands have 0.5 m/s (p99) where they are gentle,
  1 to 2 where they are brisk, and come back;
- accelerometer, 5 mg after calibration; the zero of one that is not calibrated belongs to `orientation_sigma_rad`.
"""

from math import hypot, pi, radians, sqrt

import numpy as np

from common.arrays import Float

ATTITUDE, BIAS, SCALE, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 11)
BIAS_RAD_S = radians(2.5)
_SIZE, _HEADING = 11, 2
_BIAS_PROCESS_NOISE = radians(0.01)  # [rad/s per root second]
_REST = radians(0.09)  # [rad/s times root second]: with the walk, 0.03 deg/s are reached
_NOISE = radians(0.015)  # [rad per root second]
_VELOCITY_M_S = 0.35
_FIRST_RAD = radians(60.0)
_ANYWHERE_RAD = pi / sqrt(3.0)  # standard deviation of a uniform circle


class ErrorState:
    """Push machine. Holds the covariance (11, 11) of the errors."""

    def __init__(self) -> None:
        """Know nothing yet, but where up is roughly."""
        scale = 0.01
        first = [_FIRST_RAD, _FIRST_RAD, 0.0, *[BIAS_RAD_S] * 3, *[scale] * 3, *[_VELOCITY_M_S] * 2]
        self._cov = np.diag(np.square(first))
        self._variance = self._cov.reshape(-1)[:: _SIZE + 1]  # a view of its diagonal
        self._transition = np.eye(_SIZE)

    @property
    def tilt_rad(self) -> float:
        """Standard deviation of the tilt, per axis."""
        accelerometer_rad = 0.005
        return hypot(sqrt(0.5 * float(self._variance[0] + self._variance[1])), accelerometer_rad)

    @property
    def bias_rad_s(self) -> float:
        """Standard deviation of the bias, that of its worst axis."""
        return sqrt(float(self._variance[BIAS].max()))

    @property
    def heading_rad(self) -> float:
        """Standard deviation of the heading against that of the beginning."""
        return min(sqrt(float(self._variance[_HEADING])), _ANYWHERE_RAD)

    def propagate(self, step_s: float, world_sensor: Float, rate_rad_s: Float, *, felt: bool) -> None:
        """Propagate the covariance over one integration step.

        The sensor rotated at this rate (3,), in this orientation (3, 3), with a force measured or without.
        """
        g_m_s2 = 9.80665
        change, fallen = -step_s * world_sensor, step_s * g_m_s2 if felt else 0.0
        self._transition[ATTITUDE, BIAS] = change
        self._transition[ATTITUDE, SCALE] = change * rate_rad_s
        self._transition[9, 1], self._transition[10, 0] = fallen, -fallen
        np.matmul(self._transition @ self._cov, self._transition.T, out=self._cov)
        other, other_s = 0.003, 0.5
        noise = _NOISE**2 + other**2 * other_s * float(rate_rad_s @ rate_rad_s)
        self._variance[ATTITUDE] += noise * step_s
        self._warmed(step_s)

    def silent(self, gap_s: float) -> bool:
        """Inflate the covariance over a gap without samples.

        The sensor may have rotated meanwhile. Returns whether the tilt is now unknown.
        """
        unseen_rad_s = 3.0  # as fast as a forearm turns unseen
        attitude = self._variance[ATTITUDE] + (unseen_rad_s * gap_s) ** 2
        for block in (ATTITUDE, VELOCITY):
            self._cov[block] = self._cov[:, block] = 0.0
        most = np.square([_FIRST_RAD, _FIRST_RAD, _ANYWHERE_RAD])
        self._variance[ATTITUDE] = np.minimum(attitude, most)
        self._variance[VELOCITY] = _VELOCITY_M_S**2
        self._warmed(gap_s)
        return bool(attitude[0] >= most[0])

    def level(self, step_s: float, velocity_m_s: Float) -> Float:
        """Correct with a zero level velocity.

        Forces were integrated for a step to this level velocity (2,), which is zero in truth; returns all corrections
        (11,).
        """
        velocity_s = 0.6
        noise = 2.0 * velocity_s * _VELOCITY_M_S**2 / step_s
        return self._measured(VELOCITY, -velocity_m_s, noise)

    def rest(self, step_s: float, off_rad_s: Float) -> Float:
        """Correct the bias with a step at rest.

        The rate (3,) is what remains beyond the bias; returns all corrections (11,).
        """
        return self._measured(BIAS, off_rad_s, _REST**2 / step_s)

    def contradicted(self, heading_rad: float) -> None:
        """Reset the bias covariance after two rest periods gave different biases.

        One of them was a rotation, so the heading may be off by `heading_rad`.
        """
        heading = float(self._variance[_HEADING])
        self._cov[BIAS] = self._cov[:, BIAS] = 0.0
        self._variance[BIAS] = BIAS_RAD_S**2
        self._variance[_HEADING] = min(heading + heading_rad**2, _ANYWHERE_RAD**2)

    def _measured(self, block: slice, innovation: Float, noise: float) -> Float:
        """Apply a measurement of a block of errors, one scalar after the other.

        Returns corrections (11,) of all but the heading.
        """
        found = np.zeros(_SIZE)
        heading = float(self._variance[_HEADING])
        for k, value in enumerate(innovation.tolist(), block.start):
            row = self._cov[k].copy()
            gain = row / (row[k] + noise)
            found += (value - found[k]) * gain
            self._cov -= gain[:, None] * row
        self._variance[_HEADING] = heading
        found[_HEADING] = 0.0
        return found

    def _warmed(self, step_s: float) -> None:
        self._variance[BIAS] = np.minimum(
            self._variance[BIAS] + _BIAS_PROCESS_NOISE**2 * step_s, BIAS_RAD_S**2
        )
