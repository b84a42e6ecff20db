"""What sights are worth of angles and bend, and how the angles change with the bend of the wrist they are told for.

What is seen stays, and its model moves: with G how it moves with the angles, B with the bend, R how sure it is and H
what else is believed of the angles, the least of  (y - f)' R^-1 (y - f) + a' H a  goes by

    da / db = -(G' R^-1 G + H)^-1 G' R^-1 B

What the sights tell without habits, of angles and bend together, is  (G B)' R^-1 (G B).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.hand_limits import FLEXION
from common.messages import Level
from master.wrist.belief import FingerAngles
from master.wrist.finger_poses import SEEN
from master.wrist.forward import DIP, PIP, NaturalCurve
from master.wrist.levels import Sighting
from master.wrist.ridge import Crossings
from master.wrist.sight import SightNoise

_ANYWHERE_RAD = np.radians(35.0)  # joints of hands at work, about their mean
_STIFF_RAD = np.radians(1.0)  # of joints whose angles are told along the natural curve alone
_COUPLED_RAD = np.radians(5.0)  # of the last joint about its coupling, where a tip was seen


@dataclass(frozen=True, slots=True, eq=False)
class SightWorth:
    """Information [1/rad^2] of what is seen of fingers; zeros: nothing is.

    Attributes:
        angles: (5, 4, 4) of the angles, their bend given.
        with_bend: (5, 4, 2) that of angles and bend together.
        bend: (5, 2, 2) of the bend, the angles given.
    """

    angles: Float
    with_bend: Float
    bend: Float


class BendSlope:
    """Of one device and hand. What it holds was prepared by the constructor."""

    def __init__(self, noise: SightNoise, curve: NaturalCurve) -> None:
        """Join the parts.

        Args:
            noise: Of what is seen.
            curve: How joints bend together.
        """
        self._noise = noise
        rows = np.zeros((2, 5, 4))
        for row, joint in zip(rows, (FLEXION, DIP), strict=True):
            row[:, joint], row[:, PIP] = 1.0, -curve.slope[:, joint]
        mcp, dip = rows[..., :, None] * rows[..., None, :]
        anywhere = np.eye(4) / _ANYWHERE_RAD**2
        self._by_curve: Float = anywhere + (mcp + dip) / _STIFF_RAD**2
        self._loose: Float = anywhere + dip / _COUPLED_RAD**2

    def __call__(self, at: Crossings, found: FingerAngles, sight: Sighting) -> tuple[Float, SightWorth]:
        """Derivatives (5, 4, 2) of the angles that were found, and what the sights are worth.

        Args:
            at: What is seen at these angles.
            found: The angles. Where nothing is known the derivatives are 0.
            sight: What was seen.
        """
        both: Bool = found.level == Level.IK
        told = np.isfinite(found.angles_rad[:, 0]) & np.isfinite(sight.laser_m[:, 0])
        whole = np.ones(5)
        weight = np.zeros((5, SEEN, SEEN))
        laser = self._noise.laser_m2(sight.laser_cov_m2, sight.distance_m, whole, whole)
        laser[found.past, 1, 1] = 1.0  # along, such a point says nothing
        weight[told, :2, :2] = np.linalg.inv(laser[told])
        both &= told
        tip = self._noise.tip(sight.tip_sigma_px, sight.distance_m)
        weight[both, 2:, 2:] = np.linalg.inv(tip[both])
        pull = np.swapaxes(at.by_angles, 1, 2) @ weight
        turned = np.swapaxes(at.by_bend, 1, 2)
        worth = SightWorth(pull @ at.by_angles, pull @ at.by_bend, turned @ weight @ at.by_bend)
        H = worth.angles + np.where(both[:, None, None], self._loose, self._by_curve)
        return -np.asarray(np.linalg.solve(H, worth.with_bend), np.float64), worth
