"""Measure the noise of moving signals by second differences of samples.

With x the samples, steps of equal length, noise of standard deviation s that is new in every sample makes second
differences of variance 6 s^2; of steps dt, k dt it is 2 (1 + k + k^2) s^2 where the first is scaled by k. Of noise that
keeps a share p from sample to sample they show only 1 - 4/3 p + p^2 / 3.
"""

import numpy as np

from common.arrays import Float

_MEMORY_S = 0.4  # a few swings of a trembling hand
# A solved pose is a prior of the next, so its noise stays in part: of seven tenths, a quarter shows.
_SHOWN = 0.25


class NoiseEstimator:
    """Push machine. Holds the last sample and step, and the variance of each signal."""

    def __init__(self) -> None:
        """Nothing is known yet: the noise counts as none."""
        self._sample: Float | None = None
        self._step: Float | None = None
        self._t_ns, self._dt_s = 0, 0.0
        self._variance = np.zeros(1)

    def push(self, t_ns: int, values: Float, largest: Float) -> Float:
        """Variances (n,) of the noise of one sample, as those before it show.

        Args:
            t_ns: Time of the sample [ns], after that of the last.
            values: (n,) the signals.
            largest: (n,) largest variances that their noise may have, for what is more is acceleration; NaN: not
                known.
        """
        known = np.fmin(self._variance, largest) / _SHOWN
        if self._sample is not None:
            dt_s, step = 1e-9 * (t_ns - self._t_ns), values - self._sample
            if self._step is not None:
                ratio = dt_s / self._dt_s
                off = step - ratio * self._step
                shown = off * off / (2.0 * (1.0 + ratio + ratio * ratio))
                self._variance = self._variance + dt_s / (_MEMORY_S + dt_s) * (shown - self._variance)
            self._step, self._dt_s = step, dt_s
        self._sample, self._t_ns = values, t_ns
        return known
