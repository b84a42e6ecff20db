"""Stillness detection of an inertial sensor.

It is still when rate and force have stayed near their own mean for a while.

A constant cannot be separated from a bias: whoever turns evenly about the vertical, slower than a gyroscope may be
off, is taken to lie still. A person's slow motion is rarely so even. Time and the limits of single samples are those of
VQF (Laidig, Seel 2023); those of short means are narrower, for noise does not last: a tilt by half a degree,
seen by gravity, or half a degree per second more or less is a motion.
"""

from math import radians

import numpy as np

from common.arrays import Float

_SAMPLE_RAD_S = radians(2.0)
_SHORT_RAD_S = radians(0.5)
_BIAS_RAD_S = radians(7.5)  # a faster mean is a turn: three sigma of a bias (`Doubt`)


class Stillness:
    """Push-driven stillness detector.

    Holds means of rate and force: a short one, and one since the sensor may have come to rest.
    """

    def __init__(self) -> None:
        """Know of no rest."""
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
        """Add a value and return whether it departed from the long mean.

        True where the value is farther from it than `sample`, or the short mean farther than `short`.
        """
        off = value - self.long
        short_s = 0.3
        self.short = self.short + step_s / min(since_s + step_s, short_s) * (value - self.short)
        long_s = 4.0
        self.long = self.long + step_s / min(since_s + step_s, long_s) * off
        apart = self.short - self.long
        return bool(off @ off > sample**2 or apart @ apart > short**2)
