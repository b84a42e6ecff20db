"""What the whole-hand fit is free to choose: the angles that no coupling fixes, and the bounds of each.

A parameter vector is the palm's rotation (3, rotation vector about the wrist, rig frame) and translation (3),
then these n angles: four of the thumb; abduction, flexion, PIP (and DIP where it is not coupled) of each finger.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.hand_model import HandModel


@dataclass(frozen=True, slots=True, eq=False)
class HandParameters:
    """Free angles of one hand model.

    Attributes:
        free: (n,) their indices in the flat (20,) table of angles.
        complete: (20, n) all angles = complete @ free ones, couplings included.
        low, high: (n,) [rad] bounds that keep coupled angles inside their limits, too.
    """

    free: Int
    complete: Float
    low: Float
    high: Float

    @classmethod
    def of(cls, model: HandModel) -> "HandParameters":
        """The free angles of a hand: 20, or 16 where the DIPs are coupled."""
        coupled = model.dip_per_pip is not None
        free = np.array([a for a in range(20) if not (coupled and a >= 4 and a % 4 == 3)])
        complete = np.zeros((20, len(free)))
        complete[free, np.arange(len(free))] = 1.0
        low, high = model.limits_rad[..., 0].copy(), model.limits_rad[..., 1].copy()
        if model.dip_per_pip is not None:
            for column in np.flatnonzero((free >= 4) & (free % 4 == 2)):
                complete[free[column] + 1, column] = model.dip_per_pip
            if model.dip_per_pip > 0:
                low[1:, 2] = np.maximum(low[1:, 2], low[1:, 3] / model.dip_per_pip)
                high[1:, 2] = np.minimum(high[1:, 2], high[1:, 3] / model.dip_per_pip)
        return cls(free, complete, low.reshape(20)[free], high.reshape(20)[free])

    def angles(self, x: Float) -> Float:
        """Angles (..., 5, 4) of the free ones (..., n)."""
        return (x @ self.complete.T).reshape(*x.shape[:-1], 5, 4)

    def free_of(self, angles_rad: Float) -> Float:
        """The free ones (n,) of angles (5, 4)."""
        return angles_rad.reshape(20)[self.free]
