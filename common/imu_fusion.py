"""Raw samples of an IMU -> its orientation: rates summed up, their tilt led back to gravity, their bias learnt at rest.

The filter is imufusion's (Madgwick 2014, PhD thesis, ch. 7), without magnetometer. Its world has z up, and nothing else
is known of it: the heading is what it was when the filter began, and drifts from then on; `heading_sigma_rad` says how
far.

Each step is summed up first, exactly for a constant rate, then gravity corrects it. Three things are not the library's
own:

- **Gain.** That of every step is a Kalman filter's (`Doubt`), not one for all sensors: high at first and while the bias
  is unknown, low once the sensor has lain still.
- **Gravity** is the mean of the specific force in the world's axes, not the sensor's: there an arm's own accelerations
  cancel, since it gains no speed for long (Laidig, Seel 2023). Its memory is that of the gain, critically damped. The
  library's rejection of accelerations stays off: it judges single samples, and to leave out those of one side of a
  mean that is zero moves the mean.
- **Bias** is taken where `Stillness` sees rest, also above the library's 3 deg/s, at once where it is quite unknown; in
  motion gravity tells that of the axes that are level. The latter is noisy: it is kept apart and level, so that it
  never turns the heading. Slow even turns look like rest: they move a bias that rest has told by little. Where rest
  contradicts it for long, one of the two was a turn: the bias is learnt anew, and the heading is as unsure as that.

Magnetometers are not used: steel in a desk turns them by more than a gyroscope drifts in minutes.
"""

from collections import Counter
from math import hypot, nan, radians, sqrt, tan

import imufusion
import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.imu_doubt import Doubt
from common.imu_stillness import Stillness
from common.messages import ImuSample

_G_M_S2 = 9.80665
_SETTLED_RAD = radians(4.0)  # reached two thirds of a second after the first sample
_BRIDGED_S, _BRIDGED_SAMPLES = 0.1, 3.0  # a longer silence may hide a turn that no rate tells
_CLOCK_S = 1.0  # a sample so much older than the last is not late: a clock was set back
_RATE_RAD_S, _FORCE_M_S2 = 100.0, 2000.0  # beyond any range there is (4000 deg/s, 200 g)
_FALLING_M_S2 = 1.0  # shorter forces have no direction
_BIAS_RAD_S = radians(7.5)  # three sigma of what `Doubt` begins with
_SURPRISE_RAD_S = radians(0.1)  # three of it beyond what is believed: rather a slow turn
_CONTRARY_S = 6.0  # of such rest: an even turn hardly lasts so long, rather the bias was learnt in one
_DAMPED = 4.0  # gain times the memory of gravity's mean is a quarter: critical damping
_NONE, _ZERO, _UP = np.full(4, np.nan), np.zeros(3), np.array([0.0, 0.0, _G_M_S2])


class OrientationFilter:
    """Push machine. Holds the orientation, gravity's mean, the bias, their doubts, and the last sample's rate and time.

    Attributes:
        counts: Samples that gave no orientation or little: `fusion.missing` (no rate, or one that cannot be),
            `fusion.no_gravity` (rate without force), `fusion.late`, `fusion.gap` (after a silence).
    """

    def __init__(self, rate_hz: float) -> None:
        """Expect samples at about this rate; the steps themselves are taken from their stamps."""
        self.counts: Counter[str] = Counter()
        self._bridged_s = max(_BRIDGED_S, _BRIDGED_SAMPLES / rate_hz)
        self._ahrs: imufusion.Ahrs | None = None
        self._doubt, self._stillness = Doubt(), Stillness()
        self._bias, self._lean, self._gravity = _ZERO, _ZERO, _UP
        self._last_ns, self._rate = 0, _ZERO
        self._agreed_s = self._contrary_s = 0.0  # since rest agreed with the bias; for how long it has not

    @property
    def at_rest(self) -> bool:
        """Whether the sensor has lain still until now."""
        return self._stillness.still

    @property
    def bias_rad_s(self) -> Float:
        """What the gyroscope says at rest (3,) [rad/s], sensor axes."""
        return self._bias + self._lean

    @property
    def tilt_sigma_rad(self) -> float:
        """Standard deviation of the tilt against the vertical, per axis."""
        return self._doubt.tilt_rad

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of what the heading has drifted since the first sample; at most 1.8, which is anywhere."""
        return self._doubt.heading_rad

    def push(self, sample: ImuSample) -> ImuSample:
        """The same sample with `orientation_wxyz`, sensor axes -> a world whose z axis is up, and `heading_sigma_rad`.

        Both are NaN where they are not known.
        """
        found = self._pushed(sample)
        drifted = nan if found is _NONE else self._doubt.heading_rad
        return replace(sample, orientation_wxyz=found, heading_sigma_rad=drifted)

    def _pushed(self, sample: ImuSample) -> Float:
        """Take a sample; the orientation (4,) at its instant."""
        rate, force = sample.gyro_rad_s, sample.accel_m_s2
        if not np.abs(rate).max() < _RATE_RAD_S:
            self.counts["fusion.missing"] += 1
            return _NONE
        falls = not _FALLING_M_S2 < np.abs(force).max() < _FORCE_M_S2
        if falls:
            self.counts["fusion.no_gravity"] += 1
        if self._ahrs is None:
            if not falls:
                self._ahrs = _upright(force)
                self._last_ns, self._rate = sample.t_ns, rate
            return _NONE
        step_s = 1e-9 * (sample.t_ns - self._last_ns)
        if -_CLOCK_S < step_s <= 0.0:
            self.counts["fusion.late"] += 1
            return _NONE
        if 0.0 < step_s <= self._bridged_s:
            self._turn(self._ahrs, step_s, 0.5 * (self._rate + rate) - self.bias_rad_s)
            if not falls:
                self._level(self._ahrs, step_s, force)
                self._rest(step_s, rate, force)
        else:
            self.counts["fusion.gap"] += 1
            self._doubt.silent(abs(step_s))
            self._stillness.moved()
        self._last_ns, self._rate = sample.t_ns, rate
        known = self._doubt.tilt_rad < _SETTLED_RAD
        return _quaternion(self._ahrs) if known else _NONE

    def _turn(self, ahrs: imufusion.Ahrs, step_s: float, rate: Float) -> None:
        """Sum up one step at a rate (3,) [rad/s]; the library's is of first order, the tangent makes it exact."""
        size = sqrt(rate @ rate)
        half = 0.5 * size * step_s
        self._doubt.turned(step_s, size, float(rate @ ahrs.get_gravity()))
        ahrs.set_sample_period(step_s)
        ahrs.update_no_magnetometer(np.degrees(rate * (tan(half) / half if half > 0.0 else 1.0)), _ZERO)

    def _level(self, ahrs: imufusion.Ahrs, step_s: float, force: Float) -> None:
        """Lead the tilt towards gravity, by the specific force (3,) [m/s^2] of this moment."""
        tilt, bias = self._doubt.gravity(step_s)
        world_sensor = imufusion.quaternion_to_matrix(ahrs.get_quaternion()).astype(np.float64)
        self._gravity = self._gravity + min(_DAMPED * tilt, 1.0) * (world_sensor @ force - self._gravity)
        ahrs.set_settings(_settings(gain=tilt / step_s, step_s=step_s))
        ahrs.update_no_magnetometer(_ZERO, world_sensor.T @ self._gravity / _G_M_S2)
        x, y, z = (self._gravity / sqrt(self._gravity @ self._gravity)).tolist()
        off = world_sensor.T @ np.array([y, -x, 0.0]) / (1.0 if z > 0.0 else hypot(x, y) or 1.0)
        level = self._lean - bias * off
        self._lean = np.clip(level - (level @ world_sensor[2]) * world_sensor[2], -_BIAS_RAD_S, _BIAS_RAD_S)

    def _rest(self, step_s: float, rate: Float, force: Float) -> None:
        """Learn the bias where the sensor lies still."""
        self._stillness.push(step_s, rate, force)
        self._agreed_s += step_s
        if not self._stillness.still:
            self._contrary_s = 0.0
            return
        off, most = rate - self._bias, 3.0 * hypot(self._doubt.bias_rad_s, _SURPRISE_RAD_S)
        if np.abs(off).max() <= most:
            self._agreed_s = self._contrary_s = 0.0
        else:
            self._contrary_s += step_s
        if self._contrary_s > _CONTRARY_S:
            self._doubt.contradicted(sqrt(off @ off) * (self._agreed_s + _CONTRARY_S))
            self._contrary_s = 0.0
        share = self._doubt.rest(step_s)
        self._bias = self._bias + share * np.clip(off, -most, most)
        self._lean = (1.0 - share) * self._lean


def _settings(gain: float, step_s: float) -> imufusion.AhrsSettings:
    return imufusion.AhrsSettings(
        sample_rate=1.0 / step_s, convention=imufusion.CONVENTION_ENU, gain=gain, acceleration_rejection=0.0
    )


def _upright(force: Float) -> imufusion.Ahrs:
    """A filter that begins where this specific force (3,) is up, by the shortest turn."""
    x, y, z = (force / sqrt(force @ force)).tolist()
    q = np.array([1.0 + z, y, -x, 0.0]) if z > -1.0 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    ahrs = imufusion.Ahrs()
    ahrs.set_settings(_settings(1.0, 0.01))
    ahrs.skip_startup()
    ahrs.set_quaternion(q / sqrt(q @ q))
    return ahrs


def _quaternion(ahrs: imufusion.Ahrs) -> Float:
    q = ahrs.get_quaternion().astype(np.float64)
    return q / np.linalg.norm(q)
