"""How unsure a summed-up orientation is, and how far gravity and rest may correct it: a Kalman filter of scalars.

Tilt error t and bias error b of one horizontal axis follow t' = b; gravity measures t, rest measures b. Both axes share
one covariance; the bias about the vertical has its own, since gravity never shows it, and what that does to the heading
is carried with it. Turning the sensor over brings one axis to where the other was: the bias that gravity has shown is
then no longer the one that tilts.

The figures are those of parts and arms, not of recordings:

- bias when switched on, 2.5 deg/s: +-5 deg/s of an ICM-20948 (DS-000189, table 1), taken as two sigma; LSM6DSO: +-1;
- its walk, 0.1 deg/s in 100 s, and how well rest shows it, to 0.03 deg/s within about 9 s: the defaults of VQF (Laidig,
  Seel 2023);
- noise, 0.015 deg/s/sqrt(Hz): the same part; LSM6DSO (DS12140, table 2) has a quarter of it;
- scale, 1 %: LSM6DSO +-1 %, ICM-20948 +-0.5 % and 2 % across its axes; an arm turns one way for half a second;
- gravity, to 3.3 deg by a second's mean: an arm's own 1 m/s^2 tilt it by 6 deg, for a third of a second each.
"""

from math import hypot, pi, radians, sqrt

_BIAS_RAD_S = radians(2.5)
_BIAS_WALK = radians(0.01)  # [rad/s per root second]
_REST = radians(0.09)  # [rad/s times root second]: with the walk, 0.03 deg/s are reached
_NOISE = radians(0.015)  # [rad per root second]
_SCALE, _ONE_WAY_S = 0.01, 0.5
_GRAVITY = radians(3.3)  # [rad times root second]
_FIRST_RAD = radians(60.0)
_UNSEEN_RAD_S = 3.0  # as fast as a forearm turns unseen
_ANYWHERE_RAD = pi / sqrt(3.0)  # standard deviation of a uniform circle


class Doubt:
    """Push machine. Holds the covariances of tilt, heading and bias."""

    def __init__(self) -> None:
        """Know nothing yet, but where up is roughly."""
        self._tilt, self._tilt_bias, self._bias = _FIRST_RAD**2, 0.0, _BIAS_RAD_S**2
        self._heading, self._heading_bias, self._upright_bias = 0.0, 0.0, _BIAS_RAD_S**2
        self._turned_rad = 0.0

    @property
    def tilt_rad(self) -> float:
        """Standard deviation of the tilt, per axis."""
        return sqrt(self._tilt)

    @property
    def bias_rad_s(self) -> float:
        """Standard deviation of the bias, per axis, as rest alone tells it."""
        return sqrt(self._upright_bias)

    @property
    def heading_rad(self) -> float:
        """Standard deviation of the heading against that of the beginning; a wrong scale counts by what it turned."""
        return min(hypot(sqrt(self._heading), _SCALE * self._turned_rad), _ANYWHERE_RAD)

    def turned(self, step_s: float, rate_rad_s: float, upright_rad_s: float) -> None:
        """A step was summed up, at this rate, of which so much about the vertical, counted signed."""
        noise = _NOISE**2 * step_s
        scale = (_SCALE * rate_rad_s) ** 2 * _ONE_WAY_S * step_s
        level_rad = step_s * sqrt(max(rate_rad_s**2 - upright_rad_s**2, 0.0))
        self._tilt += step_s * (2.0 * self._tilt_bias + step_s * self._bias) + noise + scale
        self._tilt_bias += step_s * self._bias
        self._bias += min(level_rad, 1.0) * max(self._upright_bias - self._bias, 0.0)
        self._heading += step_s * (2.0 * self._heading_bias + step_s * self._upright_bias) + noise
        self._heading_bias += step_s * self._upright_bias
        self._turned_rad += step_s * upright_rad_s
        self._warmed(step_s)

    def silent(self, gap_s: float) -> None:
        """Nothing was heard for so long: it may have turned."""
        unseen = (_UNSEEN_RAD_S * gap_s) ** 2
        self._tilt = min(self._tilt + unseen, _FIRST_RAD**2)
        self._heading = min(self._heading + unseen, _ANYWHERE_RAD**2)
        self._tilt_bias = self._heading_bias = 0.0
        self._warmed(gap_s)

    def gravity(self, step_s: float) -> tuple[float, float]:
        """Gravity was seen for a step: by what share of its angle tilt [1] and bias [1/s] are to be corrected."""
        seen = self._tilt + _GRAVITY**2 / step_s
        tilt, bias = self._tilt / seen, self._tilt_bias / seen
        self._bias -= bias * self._tilt_bias
        self._tilt_bias *= 1.0 - tilt
        self._tilt *= 1.0 - tilt
        return tilt, bias

    def rest(self, step_s: float) -> float:
        """It lay still for a step: by what share of the rate beyond the bias that is to be corrected."""
        noise = _REST**2 / step_s
        share = self._upright_bias / (self._upright_bias + noise)
        self._upright_bias *= 1.0 - share
        self._heading_bias *= 1.0 - share
        self._bias = (1.0 - share) ** 2 * self._bias + share**2 * noise
        self._tilt_bias *= 1.0 - share
        return share

    def contradicted(self, heading_rad: float) -> None:
        """Rest tells another bias than rest before; one of them was a turn, and the heading may be off by so much."""
        self._upright_bias, self._heading_bias = _BIAS_RAD_S**2, 0.0
        self._heading = min(self._heading + heading_rad**2, _ANYWHERE_RAD**2)

    def _warmed(self, step_s: float) -> None:
        walk = _BIAS_WALK**2 * step_s
        self._bias = min(self._bias + walk, _BIAS_RAD_S**2)
        self._upright_bias = min(self._upright_bias + walk, _BIAS_RAD_S**2)
