"""Smooths signals that come in parts, such as the joints of one finger, by the noise that they themselves show.

A first-order low pass, as the 1 € filter is (`master.fabrik.one_euro`), whose gain follows motion. It differs in three things
that 26 signals of one hand need and the plain law does not give: told a cut-off at rest low enough for half a
millimetre, it lags 20 mm at 1 m/s, or trembles.

- **What noise is** is not told but measured: with x the values as they come, steps of equal length, noise of standard
  deviation s that is new in every sample makes second differences of 6 s^2. That of a solved hand partly stays, since
  the last pose is a prior of the next: of noise that keeps seven tenths from frame to frame a quarter shows. So the
  variance is taken four times. It is at most four times that of the markers: what is more is acceleration.
- **What motion is.** With v the speed, smoothed as in the 1 € filter, and x^ the filtered value, a signal moves by

      u^2 = max((v dt / s)^2 - 9 r / (2 + r), ((x - x^) / s)^2 - 9),   r = 2 pi dt 1.5 Hz

  beyond noise at three standard deviations: r / (2 + r) is what of the noise is in the smoothed speed. The first
  finds slow motions before they are off by much, the second those that begin or turn round.
- **Parts.** What moves most in a part says how much it moves: noise of a moving hand is not seen, a turn that follows
  later than the place is, and errors of place and turn that cancel have to go on together.

The gain is that of a steady Kalman filter of a walk with steps of u s (Kalman 1960), and at least
that which leaves the given jitter at rest:

    a = (sqrt(u^4 + 4 u^2) - u^2) / 2        at rest  a = 2 q / (1 + q),  q = (jitter / s)^2
"""

from math import pi

import numpy as np

from common.arrays import Float, Int

_MEMORY_S = 0.4  # of the noise: a few swings of a trembling hand
_SHOWN = 4.0
_BEYOND = 9.0
_SPEED_HZ = 1.5  # a tenth of a second, in which a hand at rest can be told from a slow one
_LEAST = 1e-12  # [m^2] below which noise is none


class PartFilter:
    """Push machine. Holds filtered values, speeds, the last sample and step, and the noise of each signal."""

    def __init__(self, parts: tuple[int, ...], jitter_m: float) -> None:
        """Set up.

        Args:
            parts: Number of signals of each part; they come in this order.
            jitter_m: Standard deviation that may be left of a signal's noise at rest [m].
        """
        self._sizes: Int = np.array(parts)
        self._starts: Int = np.cumsum(self._sizes) - self._sizes
        self._jitter_2 = jitter_m * jitter_m
        self._x: Float | None = None
        self._sample = self._step = self._speed = self._variance = np.zeros(self._sizes.sum())
        self._dt_s = 0.0

    def push(self, dt_s: float, values: Float, most: Float) -> Float:
        """Filter one sample of every signal.

        Args:
            dt_s: Time since the last, above 0; of the first it does not matter.
            values: (n,) [m].
            most: (n,) [m^2] most that the variance of their noise may be, before what stays; NaN: not known.
        """
        if self._x is None:
            self._x = self._sample = values
            return values
        change, turn = values - self._x, 2.0 * pi * _SPEED_HZ * dt_s
        self._speed = self._speed + turn / (1.0 + turn) * (change / dt_s - self._speed)
        variance = _SHOWN * np.fmin(self._variance, most) + _LEAST
        moved = self._speed * dt_s
        u2 = np.maximum(
            moved * moved - _BEYOND * turn / (2.0 + turn) * variance, change * change - _BEYOND * variance
        )
        u2 = np.maximum.reduceat(np.maximum(u2 / variance, 0.0), self._starts).repeat(self._sizes)
        q = np.minimum(self._jitter_2 / variance, 1.0)
        gain = np.maximum(2.0 * q / (1.0 + q), 0.5 * (np.sqrt(u2 * u2 + 4.0 * u2) - u2))
        self._x = self._x + gain * change
        self._learn(dt_s, values)
        return self._x

    def _learn(self, dt_s: float, values: Float) -> None:
        """Learn the noise from the last three samples, whose steps may differ in length."""
        step = values - self._sample
        if self._dt_s > 0.0:
            ratio = dt_s / self._dt_s
            off = step - ratio * self._step
            shown = off * off / (2.0 * (1.0 + ratio + ratio * ratio))
            self._variance = self._variance + dt_s / (_MEMORY_S + dt_s) * (shown - self._variance)
        self._sample, self._step, self._dt_s = values, step, dt_s
