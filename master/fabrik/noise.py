"""Measure the noise of moving signals by second differences of samples.

With x the samples, steps of equal length, noise of standard deviation s that is new in every sample makes second
differences of variance 6 s^2; of steps dt, k dt it is 2 (1 + k + k^2) s^2 where the first is scaled by k. Of noise that
keeps a share p from sample to sample they show only 1 - 4/3 p + p^2 / 3.
"""

from math import isnan

import numpy as np

from common.arrays import Float, Int
from common.kernels import kernel


class NoiseEstimator:
    """Push machine. Holds the last sample and step, and the variance of each signal."""

    def __init__(self) -> None:
        """Nothing is known yet: the noise counts as none."""
        self._count, self._dt_s = np.zeros(2, np.int64), np.zeros(1)
        self._past = np.empty((3, 0))

    def push(self, t_ns: int, values: Float, largest: Float) -> Float:
        """Variances (n,) of the noise of one sample, as those before it show.

        Args:
            t_ns: Time of the sample [ns], after that of the last.
            values: (n,) the signals.
            largest: (n,) largest variances that their noise may have, for what is more is acceleration; NaN: not
                known.
        """
        if self._count[0] == 0:
            self._past = np.zeros((3, len(values)))
        known = np.empty(len(values))
        measure(t_ns, values, largest, self._count, self._dt_s, self._past, known)
        return known


@kernel
def measure(
    t_ns: int, values: Float, largest: Float, count: Int, dt_s: Float, past: Float, known: Float
) -> None:
    """Write the variances (n,) of the noise of one sample, and take it in.

    Args:
        t_ns, values, largest: As of `NoiseEstimator.push`.
        count: (2,) how many samples came, and the time of the last [ns]; changed, as is all that follows.
        dt_s: (1,) length of the last step.
        past: (3, n) last sample and step, and variance that shows.
        known: (n,) written.
    """
    passed_s = 1e-9 * (t_ns - count[1])
    ratio = passed_s / dt_s[0] if count[0] > 1 else 0.0
    for i in range(values.shape[0]):
        step, variance = values[i] - past[0, i], past[2, i]
        smaller = largest[i] < variance or isnan(variance)
        # A solved pose is a prior of the next, so its noise stays in part: of seven tenths, a quarter shows.
        # shown
        known[i] = (largest[i] if smaller else variance) / 0.25
        if count[0] > 1:
            off = step - ratio * past[1, i]
            shown = off * off / (2.0 * (1.0 + ratio + ratio * ratio))
            memory_s = 0.4  # a few swings of a trembling hand
            past[2, i] += passed_s / (memory_s + passed_s) * (shown - variance)
        past[0, i], past[1, i] = values[i], step
    dt_s[0] = passed_s
    count[0], count[1] = count[0] + 1, t_ns
