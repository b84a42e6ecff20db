"""A Kalman filter estimates orientation and its covariance from IMU samples.

An error-state Kalman filter without magnetometer (steel in a desk turns one by more than a gyroscope drifts in
minutes). Eleven errors, after Sola 2017 ("Quaternion kinematics for the error-state Kalman filter", ch. 5) with the
global error of its ch. 7: attitude t (3,) [rad] in the world's axes, the gyroscope's bias b (3,) [rad/s] and scale s
(3,) [1] in the sensor's, level velocity v (2,) [m/s]. With R sensor -> world and w the rate,

    t' = -R (b + s w) + noise,      v' = g (t_y, -t_x).

Gravity is observed by the level velocity that forces sum to in the world's axes, where accelerations cancel (the
almost inertial frame of Laidig, Seel 2023, section 4), and which is measured as zero: an arm gains none for long. As a
state its memory is the filter's own, and holds at any rate of samples. Rest measures the bias, in motion gravity that
of the level axes and the scale of those that turn. Neither moves the heading: its gain is zero, its covariance that of
a considered parameter (Schmidt 1966), and it drifts from the beginning on (`heading_sigma_rad`).

A sample's rate is the mean over the period before it: a part's low-pass delays by about half a period, so this comes
nearer than a trapezoid. Steps are taken from the stamps, which may jitter. `Stillness` has time and single-sample
limits of VQF (Laidig, Seel 2023; `python -m bench imu` compares with it); those of short means are narrower, for noise
does not last. A slow even turn looks like rest: it barely moves a bias that was estimated at rest, and where rest
contradicts that for long, one of the two was a turn: the bias is estimated anew, and the heading is as uncertain as
that.

The figures are those of parts and arms, not of recordings:
- bias when switched on, 2.5 deg/s: +-5 deg/s of an ICM-20948 (DS-000189, table 1), taken as two sigma; LSM6DSO: +-1;
- its walk, 0.1 deg/s in 100 s, and how well rest shows it, to 0.03 deg/s within about 9 s: the defaults of VQF;
- noise, 0.015 deg/s/sqrt(Hz): the same part; LSM6DSO (DS12140, table 2) has a quarter of it;
- scale, 1 %: LSM6DSO +-1 %; other errors (across axes, not linear), 0.3 % of the rate, half a second long;
- velocity, 0.35 m/s along each axis for 0.6 s: fingertips of recorded hands have 0.5 m/s (p99) where they are gentle,
  1 to 2 where they are brisk, and come back;
- accelerometer, 5 mg after calibration; the zero of one that is not calibrated belongs to `orientation_sigma_rad`.
"""

from collections import Counter
from dataclasses import dataclass
from math import cos, hypot, nan, pi, radians, sin, sqrt

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.geometry.transforms import Wxyz, matrix_of, quaternion_product, quaternion_to_matrix
from common.messages import ImuSample

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
    """Push-driven covariance (11, 11) of the errors."""

    def __init__(self) -> None:
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
        """Propagate over a step at a rate (3,), orientation (3, 3); `felt`: with force."""
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
        """Inflate the covariance over a gap without samples; whether the tilt is lost."""
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
        """Correct with the level velocity (2,) of a step, truly zero; corrections (11,)."""
        velocity_s = 0.6
        noise = 2.0 * velocity_s * _VELOCITY_M_S**2 / step_s
        return self._measured(VELOCITY, -velocity_m_s, noise)

    def rest(self, step_s: float, off_rad_s: Float) -> Float:
        """Correct the bias with a rate (3,) beyond it at rest; all corrections (11,)."""
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
        """Measure a block, one scalar after the other; corrections (11,), no heading."""
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


_SAMPLE_RAD_S = radians(2.0)
_SHORT_RAD_S = radians(0.5)
_BIAS_RAD_S = radians(7.5)  # a faster mean is a turn: three sigma of a bias


class Stillness:
    """Push-driven stillness detector: rate and force have stayed near their means.

    Holds a short mean of both, and one since the sensor may have come to rest.
    """

    def __init__(self) -> None:
        self.moved()

    @property
    def still(self) -> bool:
        """Whether it lay still until now."""
        for_s = 1.5
        return self._since_s >= for_s

    def moved(self) -> None:
        """Begin anew: what happened is not known."""
        self._since_s = 0.0
        self._rate: _Means | None = None
        self._force: _Means | None = None

    def push(self, step_s: float, gyro_rad_s: Float, accel_m_s2: Float) -> None:
        """Take rate and specific force (3,), so long after the last ones."""
        if self._rate is None or self._force is None:
            self._rate, self._force = _Means(gyro_rad_s), _Means(accel_m_s2)
            return
        self._since_s += step_s
        sample_m_s2 = 0.5
        short_m_s2 = 0.1
        if (
            self._rate.left(self._since_s, step_s, gyro_rad_s, _SAMPLE_RAD_S, _SHORT_RAD_S)
            or self._force.left(self._since_s, step_s, accel_m_s2, sample_m_s2, short_m_s2)
            or np.abs(self._rate.long).max() > _BIAS_RAD_S
        ):
            self.moved()


class _Means:
    """A vector's (3,) mean over a short and a long time."""

    def __init__(self, value: Float) -> None:
        self.short = self.long = value

    def left(self, since_s: float, step_s: float, value: Float, sample: float, short: float) -> bool:
        """Add a value; whether it or the short mean is too far from the long mean."""
        off = value - self.long
        short_s = 0.3
        self.short = self.short + step_s / min(since_s + step_s, short_s) * (value - self.short)
        long_s = 4.0
        self.long = self.long + step_s / min(since_s + step_s, long_s) * off
        apart = self.short - self.long
        return bool(off @ off > sample**2 or apart @ apart > short**2)


_SETTLED_RAD = radians(6.0)  # reached nine tenths of a second after the first sample
_BIAS_MOST_RAD_S, _SCALE_MOST = 3.0 * BIAS_RAD_S, 0.03  # three sigma of what they begin with
_GATE_RAD_S = radians(0.1)  # three of it beyond what is estimated: rather a slow turn
_NONE, _ZERO = np.full(4, np.nan), np.zeros(3)


class OrientationFilter:
    """Push-driven orientation filter.

    Attributes:
        counts: Samples that gave no orientation or little: `fusion.missing` (no rate, or one that cannot be),
            `fusion.no_gravity` (rate without force), `fusion.late`, `fusion.gap` (after a silence).
    """

    def __init__(self, rate_hz: float) -> None:
        """Expect samples at about this rate; steps are taken from their timestamps."""
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
        """Gyroscope bias (3,) [rad/s] in sensor axes: the reading at rest."""
        return self._bias

    @property
    def tilt_sigma_rad(self) -> float:
        """Standard deviation of the tilt against the vertical, per axis."""
        return self._errors.tilt_rad

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of the heading drift since the first sample; 1.8: unknown."""
        return self._errors.heading_rad

    def push(self, sample: ImuSample) -> ImuSample:
        """Return the sample with `orientation_wxyz` and `heading_sigma_rad` filled in.

        The orientation maps sensor axes to a world whose z axis is up. Both are NaN where they are not known.
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
        """Resume after a gap; after a long one, up is where the first force (3,) points."""
        self._stillness.moved()
        self._velocity = np.zeros(2)
        if self._errors.silent(gap_s) and not falls and self._q is not None:
            self._q = _upright(self._q, force)

    def _rest(self, step_s: float, rate: Float, force: Float) -> None:
        """Estimate the bias where the sensor lies still."""
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
        self._scale = np.clip(self._scale + errors[SCALE], -_SCALE_MOST, _SCALE_MOST)
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


@dataclass(frozen=True, slots=True, eq=False)
class TiltErrors:
    """Tilt errors about both level axes (N, 2) and their sigma per axis (N,) [rad].

    The error is the turn about a level axis that takes the found vertical to the true one; headings do not count.
    """

    error_rad: Float
    sigma_rad: Float

    @classmethod
    def of(cls, found_wxyz: Float, truth_wxyz: Float, sigma_rad: Float) -> "TiltErrors":
        """Tilt errors of orientations (T, 4), sigma (T,), where all is known.

        Orientations map sensor axes to a world whose z axis is up, NaN where not known.
        """
        known = (
            np.isfinite(found_wxyz).all(axis=1) & np.isfinite(truth_wxyz).all(axis=1) & np.isfinite(sigma_rad)
        )
        found, truth = (quaternion_to_matrix(q[known]) for q in (found_wxyz, truth_wxyz))
        up: Float = (found @ truth[:, 2, :, None])[..., 0]  # the true vertical in the world that was found
        sine = np.hypot(up[:, 0], up[:, 1])
        angle = np.arctan2(sine, up[:, 2]) / np.maximum(sine, 1e-12)
        return cls(np.column_stack((-up[:, 1], up[:, 0])) * angle[:, None], sigma_rad[known])

    @property
    def rms_deg(self) -> float:
        """Root mean square of the inclination's error, both axes together."""
        return float(np.degrees(np.sqrt(np.vecdot(self.error_rad, self.error_rad).mean())))

    @property
    def stated_deg(self) -> float:
        """What that would be if the stated sigmas were exact."""
        return float(np.degrees(np.sqrt(2.0 * np.mean(np.square(self.sigma_rad)))))

    @property
    def within(self) -> float:
        """Share of samples in their 95 % regions."""
        region = 5.991  # chi square, two degrees of freedom, 95 %
        return float((np.vecdot(self.error_rad, self.error_rad) < region * np.square(self.sigma_rad)).mean())

    def where(self, rows: Bool) -> "TiltErrors":
        """Those of some samples (N,)."""
        return TiltErrors(self.error_rad[rows], self.sigma_rad[rows])
