"""Angles and the palm's pose over time are uniform cubic B-splines.

So frames need no common rate and no averaging (trajectory estimation in continuous time: Furgale, Barfoot &
Sibley, ICRA 2012).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int

_WIDTH = 4  # coefficients that one epoch depends on


@dataclass(frozen=True, slots=True, eq=False)
class Knots:
    """Uniform cubic B-splines over T epochs."""

    spacing_s: float  # between coefficients [s]
    time_s: Float  # (K,) middle of each coefficient's bump [s]
    first: Int  # (T,) first of the four coefficients of each epoch
    weight: Float  # (T, 4) theirs; they add up to one

    @classmethod
    def over(cls, t_s: Float, spacing_s: float) -> "Knots":
        """Knots that cover rising times (T,) [s]."""
        x = (t_s - t_s[0]) / spacing_s
        first = np.floor(x).astype(np.int64)
        u = x - first
        weight = np.stack(
            [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=1
        )
        count = int(first[-1]) + _WIDTH
        return cls(spacing_s, t_s[0] + spacing_s * (np.arange(count) - 1.0), first, weight / 6.0)

    def at(self, coefficients: Float) -> Float:
        """Values (T, n) of curves with coefficients (K, n)."""
        picked = coefficients[self.first[:, None] + np.arange(_WIDTH)]
        return np.einsum("tw,twn->tn", self.weight, picked)
