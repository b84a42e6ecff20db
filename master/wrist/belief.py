"""From how far fingers are closed to their angles, and how sure each is.

The laser gives two numbers of a finger and its pose has four. The other two come from habit: joints that bend together
(`master.wrist.forward`). How far hands stray from that is in `master.estimator.settings`: a natural MCP by 14 degrees,
a DIP by 15, each joint of the thumb by 20. What the laser says of a bent finger is the slope of its proximal bone,
hence the MCP; a PIP is that divided by 0.54 and its doubt is large, which the covariance says:

    information = G' R^-1 G + H      G (2, 4): how the point moves with each angle, R: how sure the point is, H: habits

R is that of `master.wrist.sight`. Near the end of the branch it is the finger's own last phalanx that hides the line,
within some degrees: the shorter the line, the nearer to that end is the finger.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Code, Float
from common.hand_limits import ABDUCTION, FLEXION
from common.messages import Level
from master.estimator.settings import DEFAULT, Settings
from master.wrist.forward import DIP, PIP, ForwardTable
from master.wrist.invert import Closed
from master.wrist.setup import WristSetup
from master.wrist.sight import HARDLY, SightNoise

_ANYWHERE_RAD = np.radians(35.0)  # closings of hands at work, about their mean
_ABDUCTION_RAD = np.radians(20.0)
_FOLD_RAD = np.radians(20.0)  # so near to the end of the branch it is the last phalanx that hides a line


@dataclass(frozen=True, slots=True, eq=False)
class FingerAngles:
    """The angles of five fingers at one instant. NaN: not seen.

    Attributes:
        angles_rad: (5, 4) within the limits.
        cov_rad2: (5, 4, 4).
        told: (5,) what was seen tells how the finger is bent.
        past: (5,) it tells only that it is closed at least to the end of the branch; the angles are the middle of what
            is left.
        off: (5,) it fits no natural finger: most of its line is hidden, or it lies aside of all abductions.
        level: (5,) `Level` codes.
        ambiguous: (5,) another pose explains as much.
    """

    angles_rad: Float
    cov_rad2: Float
    told: Bool
    past: Bool
    off: Bool
    level: Code
    ambiguous: Bool


class AngleBelief:
    """What laser points say of angles, for one device and hand. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup, table: ForwardTable, settings: Settings = DEFAULT) -> None:
        self._model, self._curve = setup.model, table.curve
        self._sight = SightNoise(setup)
        self._most = np.minimum(table.curve.range_rad[:, 1], setup.model.limits_rad[:, PIP, 1])
        self._aside = table.abduction_rad[:, [0, -1]].T
        self._habits, s = np.zeros((5, 4, 4)), settings
        for f in range(5):
            mcp, dip = (s.thumb_rad, s.thumb_rad) if f == 0 else (s.natural_flexion_rad, s.loose_dip_rad)
            rows = np.zeros((3, 4))
            rows[0, [FLEXION, PIP]] = np.array([1.0, -table.curve.slope[f, FLEXION]]) / mcp
            rows[1, [DIP, PIP]] = np.array([1.0, -table.curve.slope[f, DIP]]) / dip
            rows[2, ABDUCTION] = 1.0 / _ABDUCTION_RAD
            self._habits[f] = rows.T @ rows

    def __call__(self, closed: Closed, cov_m2: Float, distance_m: Float, laser_px: Float) -> FingerAngles:
        """Angles of fingers.

        Args:
            closed: What the table says.
            cov_m2: (5, 2, 2) of the laser points on the plane [m^2].
            distance_m: (5,) of the points along the optical axis.
            laser_px: (5,) length of the lines that were seen; NaN: not known.
        """
        seen = np.isfinite(closed.closing_rad)
        shown = self._sight.shown(closed.length_px, laser_px)
        low, high = self._aside
        aside = (closed.abduction_rad < low) | (closed.abduction_rad > high)
        off = seen & ~closed.past & (aside | (shown < HARDLY))
        left = self._most - closed.closing_rad
        closing = closed.closing_rad + np.where(
            closed.past, 0.5 * np.maximum(left, 0.0), self._folded(closed, shown)
        )
        angles = self._model.clamp(self._curve.angles(closing, closed.abduction_rad))
        noise = self._sight.laser_m2(cov_m2, distance_m, closed.length_px, shown)
        noise[closed.past, 1, 1] = 1.0  # along, such a point says nothing
        information = (
            np.swapaxes(closed.by_angles, -1, -2) @ _inverse(noise) @ closed.by_angles + self._habits
        )
        spread = np.full(5, _ANYWHERE_RAD)
        spread[closed.past] = np.maximum(left[closed.past], 0.1) / np.sqrt(12.0)
        information[:, PIP, PIP] += 1.0 / spread**2
        cov = np.asarray(np.linalg.inv(information), np.float64)
        cov[~seen] = np.nan
        level: Code = np.where(seen, np.uint8(Level.FK), np.uint8(Level.NONE))
        told = seen & ~closed.past & ~off
        return FingerAngles(angles, cov, told, closed.past, off, level, np.zeros(5, np.bool_))

    def _folded(self, closed: Closed, shown: Float) -> Float:
        """How much farther fingers (5,) are closed than their points say: their last phalanx hides part of the line."""
        left = closed.end_rad - closed.closing_rad
        folding = left < _FOLD_RAD
        folding[0] = False  # a thumb never reaches its own tip
        return np.where(folding, self._sight.hidden(shown) * np.maximum(left, 0.0), 0.0)


def _inverse(a: Float) -> Float:
    """Inverses of symmetric matrices (5, 2, 2)."""
    out = np.empty(a.shape)
    out[:, 0, 0], out[:, 1, 1] = a[:, 1, 1], a[:, 0, 0]
    out[:, 0, 1] = out[:, 1, 0] = -a[:, 0, 1]
    return out / (a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] ** 2)[:, None, None]
