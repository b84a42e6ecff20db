"""What is believed of the palm as a whole: the side it shows, and where it was.

Beliefs are rows of the least-squares problem (`master.ik.hand_problem`): residuals, and their derivatives by a small
turn of the palm in rig axes and, for the last, a shift.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry import skew, unskew
from master.fusion.orientation import Orientation as Orientation
from master.fusion.orientation import turn_of_vector as turn_of_vector


@dataclass(frozen=True, slots=True, eq=False)
class Facing:
    """The back of the hand is believed to look along `direction` (3,), unit, rig frame; `weight`: one per sigma."""

    direction: Float
    weight: float

    def rows(self, R: Float) -> tuple[Float, Float]:
        """Residuals (..., 3) of rotations (..., 3, 3), and their derivatives (..., 3, 3) by a turn."""
        dorsal = self.weight * R[..., :, 1]
        return dorsal - self.weight * self.direction, skew(-dorsal)


@dataclass(frozen=True, slots=True, eq=False)
class PalmPrior:
    """The palm is believed near `T_rig_palm` (4, 4); `weight` (6,): one per sigma of turn and shift."""

    T_rig_palm: Float
    weight: Float

    def cost(self, T_rig_palm: Float) -> float:
        """That of one pose (4, 4)."""
        off = self.off(T_rig_palm)
        return 0.5 * float(off @ off)

    def off(self, T: Float) -> Float:
        """Turn (sine of the angle times the axis) and shift from the belief to poses (..., 4, 4): (..., 6), sigmas.

        Their derivatives by turn and shift are taken as the weights.
        """
        out = np.empty((*T.shape[:-2], 6))
        out[..., :3] = unskew(T[..., :3, :3] @ self.T_rig_palm[:3, :3].T)
        out[..., 3:] = T[..., :3, 3] - self.T_rig_palm[:3, 3]
        out *= self.weight
        return out
