"""What sights are worth of angles and bend, and how the angles change with the bend of the wrist they are told for.

What is seen stays, and its model moves: with G how it moves with the angles, B with the bend, R how sure it is and H
what else is believed of the angles, the least of  (y - f)' R^-1 (y - f) + a' H a  goes by

    da / db = -(G' R^-1 G + H)^-1 G' R^-1 B

What the sights tell without habits, of angles and bend together, is  (G B)' R^-1 (G B).

**Near what is expected.** A laser point alone leaves a curve of poses, and habit picks one of them. Who knows better
wants G at the pose of that curve that is nearest to what he expects: a few steps of Gauss and Newton from there to
where the light falls as it did (`near`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

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
_STEPS, _LEAST_M, _ARRIVED_M = 3, 2e-3, 1e-3
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


def near(
    crossings: Callable[[Float], Crossings],
    found: FingerAngles,
    expected_rad: Float,
    low_high: tuple[Float, Float],
) -> FingerAngles:
    """The angles with those that laser points alone tell moved along to where they are expected.

    Args:
        crossings: What is seen of angles (5, 4).
        found: The angles by habit.
        expected_rad: (5, 4); NaN: nothing is expected.
        low_high: Limits (5, 4) of the angles.
    """
    moving = found.told & (found.level == Level.FK) & np.isfinite(expected_rad[:, 0])
    if not moving.any():
        return found
    a = np.where(moving[:, None], expected_rad, np.nan_to_num(found.angles_rad))
    seen = crossings(np.nan_to_num(found.angles_rad)).seen[:, :2]
    for _ in range(_STEPS):
        at = crossings(a)
        G = at.by_angles[:, :2]
        step = np.swapaxes(G, 1, 2) @ np.linalg.solve(
            G @ np.swapaxes(G, 1, 2) + _LEAST_M**2 * np.eye(2), (seen - at.seen[:, :2])[..., None]
        )
        a = np.where(moving[:, None], np.clip(a + step[..., 0], *low_high), a)
    at = crossings(a)
    arrived = moving & at.met & (np.abs(at.seen[:, :2] - seen).max(axis=1) < _ARRIVED_M)
    return replace(found, angles_rad=np.where(arrived[:, None], a, found.angles_rad))


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
