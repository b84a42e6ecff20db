"""Whether an inertial sensor lies still: rate and force have stayed near their own mean for a while.

What is constant cannot be told from a bias: whoever turns evenly about the vertical, slower than a gyroscope may be
off, is taken to lie still. Thresholds and time are those of VQF (Laidig, Seel 2023); the mean is that of some seconds,
so that a slow tilt leaves it, by what gravity shows of it.
"""

from math import radians

from common.arrays import Float

_RATE_RAD_S = radians(2.0)
_FORCE_M_S2 = 0.5
_FOR_S = 1.5
_BIAS_RAD_S = radians(
    5.0
)  # a faster mean is a turn: +-5 deg/s is the zero of an ICM-20948 (DS-000189, table 1)
_MEAN_S = 4.0


class Stillness:
    """Push machine. Holds the means of rate and force since the sensor may have come to rest."""

    def __init__(self) -> None:
        """Know of no rest."""
        self._since_s = 0.0
        self._mean: tuple[Float, Float] | None = None

    @property
    def still(self) -> bool:
        """Whether it lay still until now."""
        return self._since_s >= _FOR_S

    def moved(self) -> None:
        """Begin anew: what happened is not known."""
        self._since_s, self._mean = 0.0, None

    def push(self, step_s: float, gyro_rad_s: Float, accel_m_s2: Float) -> None:
        """Take rate and specific force (3,), so long after the last ones."""
        if self._mean is None:
            self._mean = gyro_rad_s, accel_m_s2
            return
        rate, force = self._mean
        rate_off, force_off = gyro_rad_s - rate, accel_m_s2 - force
        if (
            rate_off @ rate_off > _RATE_RAD_S**2
            or force_off @ force_off > _FORCE_M_S2**2
            or rate @ rate > _BIAS_RAD_S**2
        ):
            self.moved()
            return
        self._since_s += step_s
        share = step_s / min(self._since_s + step_s, _MEAN_S)
        self._mean = rate + share * rate_off, force + share * force_off
