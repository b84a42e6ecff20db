"""Orientation from raw IMU samples.

Rates are integrated, the tilt is corrected towards gravity, and the bias is estimated at rest.

The filter is an error-state Kalman filter without magnetometer (`ErrorState`). Its world has z up, and nothing else is
known of it: the heading is what it was when the filter began, and drifts from then on; `heading_sigma_rad` is how
far. Each step is summed up first, exactly for a constant rate, then gravity and rest correct it.

- **A sample's rate is the mean over the period before it.** A part's low-pass, which keeps its samples free of aliases,
  delays them by about half a period: this comes nearer than a trapezoid does. Steps are taken from the stamps,
  which may jitter; what lies between the last sample and that period is summed up at the mean of both.
- **Gravity** is observed by the level velocity that forces sum to in the world's axes: an arm gains none for long.
- **Bias** is taken where `Stillness` sees rest; in motion gravity gives that of the axes that are level, and the scale
  of those that turn. Slow even turns look like rest: they barely move a bias that was estimated at rest. Where rest
  contradicts it for long, one of the two was a turn: the bias is learnt anew, and the heading is as unsure as that.

VQF (Laidig, Seel 2023) is what this is measured against (`python -m bench imu`). It is no dependency: it has no wheel
for the Pi's processor, expects a fixed period, and estimates no covariance of the tilt.

Magnetometers are not used: steel in a desk turns them by more than a gyroscope drifts in minutes.
"""

from collections import Counter
from math import cos, nan, radians, sin, sqrt

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.geometry.transforms import Wxyz, matrix_of, quaternion_product
from common.imu.error_state import ATTITUDE, BIAS, BIAS_RAD_S, SCALE, VELOCITY, ErrorState
from common.imu.stillness import Stillness
from common.messages import ImuSample

_SETTLED_RAD = radians(6.0)  # reached nine tenths of a second after the first sample
_BIAS_MOST_RAD_S = 3.0 * BIAS_RAD_S  # three sigma of what they begin with
_GATE_RAD_S = radians(0.1)  # three of it beyond what is estimated: rather a slow turn
_NONE, _ZERO = np.full(4, np.nan), np.zeros(3)


class OrientationFilter:
    """Push-driven orientation filter.

    Holds the orientation, level velocity, bias and scale, their uncertainty, and the last sample.

    Attributes:
        counts: Samples that gave no orientation or little: `fusion.missing` (no rate, or one that cannot be),
            `fusion.no_gravity` (rate without force), `fusion.late`, `fusion.gap` (after a silence).
    """

    def __init__(self, rate_hz: float) -> None:
        """Expect samples at about this rate.

        The steps themselves are taken from their timestamps.
        """
        self.counts: Counter[str] = Counter()
        self._period_s = 1.0 / rate_hz
        bridged_s, bridged_samples = 0.1, 3.0  # a longer gap may hide a turn that no rate measures
        self._bridged_s = max(bridged_s, bridged_samples / rate_hz)
        self._q: Wxyz | None = None
        self._errors, self._stillness = ErrorState(), Stillness()
        self._bias, self._scale, self._velocity = _ZERO, _ZERO, np.zeros(2)
        self._last_ns, self._last_rate = 0, _ZERO
        self._agreed_s = self._contrary_s = 0.0  # since rest agreed with the bias; for how long it has not

    @property
    def at_rest(self) -> bool:
        """Whether the sensor has lain still until now."""
        return self._stillness.still

    @property
    def bias_rad_s(self) -> Float:
        """Return the gyroscope bias (3,) [rad/s] in sensor axes.

        It is the reading at rest.
        """
        return self._bias

    @property
    def tilt_sigma_rad(self) -> float:
        """Standard deviation of the tilt against the vertical, per axis."""
        return self._errors.tilt_rad

    @property
    def heading_sigma_rad(self) -> float:
        """Return the standard deviation of the heading drift since the first sample.

        At most 1.8, which means unknown.
        """
        return self._errors.heading_rad

    def push(self, sample: ImuSample) -> ImuSample:
        """Return the sample with `orientation_wxyz` and `heading_sigma_rad` filled in.

        The orientation maps sensor axes to a world whose z axis is up.

        Both are NaN where they are not known.
        """
        found = self._pushed(sample)
        drifted = nan if found is _NONE else self._errors.heading_rad
        return replace(sample, orientation_wxyz=found, heading_sigma_rad=drifted)

    def _pushed(self, sample: ImuSample) -> Float:
        """Process a sample and return the orientation (4,) at its time."""
        rate, force = sample.gyro_rad_s, sample.accel_m_s2
        rate_rad_s, force_m_s2 = 100.0, 2000.0  # beyond any range there is (4000 deg/s, 200 g)
        if not np.abs(rate).max() < rate_rad_s:
            self.counts["fusion.missing"] += 1
            return _NONE
        falling_m_s2 = 1.0  # shorter forces have no direction
        falls = not falling_m_s2 < np.abs(force).max() < force_m_s2
        if falls:
            self.counts["fusion.no_gravity"] += 1
        if self._q is None:
            if not falls:
                self._q = _upright((1.0, 0.0, 0.0, 0.0), force)
                self._last_ns, self._last_rate = sample.t_ns, rate
            return _NONE
        step_s = 1e-9 * (sample.t_ns - self._last_ns)
        clock_s = 1.0  # a sample so much older than the last is not late: a clock was set back
        if -clock_s < step_s <= 0.0:
            self.counts["fusion.late"] += 1
            return _NONE
        if 0.0 < step_s <= self._bridged_s:
            missing = max(1.0 - self._period_s / step_s, 0.0)
            mean = rate - 0.5 * missing * (rate - self._last_rate)
            self._q = _integrated(self._q, (1.0 - self._scale) * mean - self._bias, step_s)
            world_sensor = matrix_of(self._q)
            self._errors.propagate(step_s, world_sensor, mean, felt=not falls)
            if not falls:
                self._velocity = self._velocity + step_s * (world_sensor @ force)[:2]
                self._correct(self._errors.level(step_s, self._velocity))
                self._rest(step_s, rate, force)
        else:
            self.counts["fusion.gap"] += 1
            self._silence(abs(step_s), force, falls)
        self._last_ns, self._last_rate = sample.t_ns, rate
        return np.array(self._q) if self._errors.tilt_rad < _SETTLED_RAD else _NONE

    def _silence(self, gap_s: float, force: Float, falls: bool) -> None:
        """Resume after a gap, during which the sensor moved.

        After a long gap, up is where the first force (3,) points.
        """
        self._stillness.moved()
        self._velocity = np.zeros(2)
        if self._errors.silent(gap_s) and not falls and self._q is not None:
            self._q = _upright(self._q, force)

    def _rest(self, step_s: float, rate: Float, force: Float) -> None:
        """Learn the bias where the sensor lies still."""
        self._stillness.push(step_s, rate, force)
        self._agreed_s += step_s
        if not self._stillness.still:
            self._contrary_s = 0.0
            return
        off, most = rate - self._bias, 3.0 * sqrt(self._errors.bias_rad_s**2 + _GATE_RAD_S**2)
        if np.abs(off).max() <= most:
            self._agreed_s = self._contrary_s = 0.0
        else:
            self._contrary_s += step_s
        contrary_s = 6.0  # of such rest: an even turn hardly lasts so long, rather the bias was learnt in one
        if self._contrary_s > contrary_s:
            self._errors.contradicted(sqrt(off @ off) * (self._agreed_s + contrary_s))
            self._contrary_s = 0.0
        self._correct(self._errors.rest(step_s, np.clip(off, -most, most)))

    def _correct(self, errors: Float) -> None:
        """Take away the errors (11,) that a measurement has shown."""
        if self._q is not None:
            x, y, z = errors[ATTITUDE].tolist()
            self._q = _unit(quaternion_product(_small(x, y, z), self._q))
        self._bias = np.clip(self._bias + errors[BIAS], -_BIAS_MOST_RAD_S, _BIAS_MOST_RAD_S)
        scale_most = 0.03  # three sigma of what they begin with
        self._scale = np.clip(self._scale + errors[SCALE], -scale_most, scale_most)
        self._velocity = self._velocity + errors[VELOCITY]


def _integrated(q: Wxyz, rate: Float, step_s: float) -> Wxyz:
    """An orientation after a step at a rate (3,) [rad/s], sensor axes."""
    x, y, z = (step_s * rate).tolist()
    return quaternion_product(q, _small(x, y, z))


def _small(x: float, y: float, z: float) -> Wxyz:
    """The quaternion of a rotation vector [rad]."""
    angle = sqrt(x * x + y * y + z * z)
    share = sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    return cos(0.5 * angle), share * x, share * y, share * z


def _upright(q: Wxyz, force: Float) -> Wxyz:
    """The orientation nearest to this one in which a specific force (3,) is up."""
    x, y, z = (matrix_of(q) @ force / sqrt(force @ force)).tolist()
    quaternion = (1.0 + z, y, -x, 0.0) if z > -1.0 + 1e-9 else (0.0, 1.0, 0.0, 0.0)
    return _unit(quaternion_product(_unit(quaternion), q))


def _unit(q: Wxyz) -> Wxyz:
    w, x, y, z = q
    size = sqrt(w * w + x * x + y * y + z * z)
    return w / size, x / size, y / size, z / size
