"""Raw samples of an IMU -> its orientation: rates summed up, their tilt led back to gravity, their bias learnt at rest.

The filter is imufusion's (Madgwick 2014, PhD thesis, ch. 7), without magnetometer. Its world is ENU-like: z is up, and
nothing else is known of it: the heading is what it was when the filter began, and drifts from then on.
"""

from collections import Counter
from math import isfinite

import imufusion
import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.messages import ImuSample

_G_M_S2 = 9.80665
_GAIN = 0.2  # of the tilt's error [1/s]
_SETTLED_S = 1.0
_BRIDGED_S = 0.1  # a longer silence may hide a turn that the rates at its ends do not tell
_NONE = np.full(4, np.nan)


class OrientationFilter:
    """Push machine. Holds the filter's orientation, the gyroscope's bias, and the time of the last sample.

    Attributes:
        counts: Samples of which no orientation came, by reason.
    """

    def __init__(self, rate_hz: float) -> None:
        """Expect samples at about this rate; the steps themselves are taken from their stamps."""
        self.counts: Counter[str] = Counter()
        self._rate_hz = rate_hz
        self._begin()

    @property
    def at_rest(self) -> bool:
        """Whether the sensor has lain still until now."""
        return False

    @property
    def bias_rad_s(self) -> Float:
        """What the gyroscope says at rest (3,) [rad/s], sensor axes."""
        return np.radians(self._bias.get_offset())

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of what the heading has drifted since the filter began."""
        return np.radians(0.05) * self._age_s

    def push(self, sample: ImuSample) -> ImuSample:
        """The same sample with `orientation_wxyz`, sensor axes -> a world whose z axis is up; NaN: not known yet."""
        if not isfinite(sample.gyro_rad_s.sum() + sample.accel_m_s2.sum()):
            self.counts["fusion.missing"] += 1
            return replace(sample, orientation_wxyz=_NONE)
        period_s = 1.0 / self._rate_hz if self._last_ns is None else 1e-9 * (sample.t_ns - self._last_ns)
        if not 0.0 < period_s < _BRIDGED_S:
            self.counts["fusion.gap" if period_s > 0.0 else "fusion.late"] += 1
            self._begin()
            period_s = 1.0 / self._rate_hz
        self._last_ns = sample.t_ns
        self._age_s += period_s
        rate = self._bias.update(np.degrees(sample.gyro_rad_s))
        self._ahrs.set_sample_period(period_s)
        self._ahrs.update_no_magnetometer(rate, sample.accel_m_s2 / _G_M_S2)
        known = self._age_s >= _SETTLED_S
        return replace(sample, orientation_wxyz=self._ahrs.get_quaternion() if known else _NONE)

    def _begin(self) -> None:
        self._ahrs = imufusion.Ahrs().set_settings(
            imufusion.AhrsSettings(sample_rate=self._rate_hz, convention=imufusion.CONVENTION_ENU, gain=_GAIN)
        )
        self._bias = imufusion.Bias().set_settings(imufusion.BiasSettings(sample_rate=self._rate_hz))
        self._last_ns: int | None = None
        self._age_s = 0.0
