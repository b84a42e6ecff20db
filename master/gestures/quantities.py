"""Quantities of one hand that distinguish the poses, with uncertainties.

The quantities are `common.calibration.gesture_settings.Quantity`.

A tip that is off by s turns the finger's last two bones about the PIP, so that a bend is off by s over their length;
that is the lever of all bends here. What is measured of the thumb's tip is off as the tip is, gaps as both tips are.
Places are in the palm and gaps between tips, so that only what the hand's shape leaves unsure counts: the part of a
tip's covariance that the palm's place has as well moves all of them alike, and is excluded.
"""

from dataclasses import dataclass
from math import atan2, degrees, hypot, isfinite, sqrt
from typing import get_args

import numpy as np

from common.arrays import Bool, Float
from common.calibration.gesture_settings import Quantity
from common.hand.model import CHAINS, MIDDLE_PROXIMAL, WRIST
from common.kernels import constant, inner, kernel
from master.gestures.features import HandFeatures

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
# MCP and PIP of a finger that hides, and of their sum the standard deviation.
_HIDDEN_DEG, _HIDDEN_SIGMA_DEG = (55.0, 75.0), 45.0
_COUNT = len(QUANTITIES)
_FROM, _TO = constant(WRIST), constant(MIDDLE_PROXIMAL)  # the length of the hand
_ALL = 21


@dataclass(frozen=True, slots=True, eq=False)
class Quantities:
    """All quantities of a hand at one epoch.

    They are in the order of `QUANTITIES` and in the units of their names.

    Attributes:
        value: (Q,).
        sigma: (Q,) standard deviation; inf: not known.
    """

    value: Float
    sigma: Float

    @classmethod
    def of(cls, features: HandFeatures) -> "Quantities":
        """Those of one hand."""
        value, sigma = np.empty(_COUNT), np.empty(_COUNT)
        _write(
            features.joints_m,
            features.tips_m,
            features.radius_m,
            features.shape_sigma_m,
            features.bend_rad,
            features.seen,
            features.T_rig_palm,
            features.side_sign,
            value,
            sigma,
        )
        return cls(value, sigma)


@kernel
def _write(
    joints: Float,
    tips: Float,
    radius: Float,
    tip_sigma_m: Float,
    bend: Float,
    seen: Bool,
    T: Float,
    side: float,
    value: Float,
    sigma: Float,
) -> None:
    """Write values and standard deviations (Q,); arguments as of `HandFeatures`."""
    sigma_deg = np.empty(5)
    for f in range(5):
        lever = _length(joints, CHAINS[f, 1], CHAINS[f, 2]) + _length(joints, CHAINS[f, 2], CHAINS[f, 3])
        sigma_deg[f] = degrees(tip_sigma_m[f] / lever)
    size = _length(joints, _FROM, _TO)
    # Where they begin: index ... little, each MCP, PIP, both; and so on.
    thumb_bend, thumb_place, gaps, ahead, spreads = 12, 13, 16, 20, 22
    value[thumb_bend], sigma[thumb_bend] = degrees(bend[0, 1] + bend[0, 2]), sigma_deg[0]
    for i in range(3):
        place = 0.0
        for k in range(3):
            place += (tips[0, k] - T[k, 3]) * T[k, i]
        value[thumb_place + i] = place * (side if i == 0 else -1.0 if i == 1 else 1.0) / size
        sigma[thumb_place + i] = tip_sigma_m[0] / size
    others, others_2, every, sigma_sum = 0.0, 0.0, 0.0, 0.0
    for f in range(1, 5):
        weight, sigma_deg[f] = _hidden(sigma_deg[f], seen[f])
        both, column = 0.0, 3 * (f - 1)
        for k in range(2):
            own = degrees(bend[f, k])
            value[column + k] = own + weight * (_HIDDEN_DEG[k] - own)
            both += value[column + k]
        value[column + 2] = both
        for k in range(3):
            sigma[column + k] = sigma_deg[f]
        off = sqrt(
            (tips[f, 0] - tips[0, 0]) ** 2 + (tips[f, 1] - tips[0, 1]) ** 2 + (tips[f, 2] - tips[0, 2]) ** 2
        )
        value[gaps + f - 1] = 1e3 * (off - radius[f] - radius[0])
        sigma[gaps + f - 1] = 1e3 * hypot(tip_sigma_m[f], tip_sigma_m[0])
        every += both / 4.0
        sigma_sum += sigma_deg[f] / 4.0  # neighbours are wrong alike
        if f > 1:
            others += both / 3.0
            others_2 += sigma_deg[f] * sigma_deg[f]
    value[ahead], sigma[ahead] = value[2] - others, hypot(sigma_deg[1], sqrt(others_2) / 3.0)
    value[_ALL], sigma[_ALL] = every, sigma_sum
    before = 0.0
    for f in range(1, 5):
        heading = _heading(f, joints, T, side)
        if f > 1:
            value[spreads + f - 2] = before - heading
            sigma[spreads + f - 2] = hypot(sigma_deg[f - 1], sigma_deg[f])
        before = heading


@inner
def _length(joints: Float, a: int, b: int) -> float:
    """Distance of two joints [m]."""
    x, y, z = joints[b, 0] - joints[a, 0], joints[b, 1] - joints[a, 1], joints[b, 2] - joints[a, 2]
    return sqrt(x * x + y * y + z * z)


@inner
def _hidden(sigma: float, seen: bool) -> tuple[float, float]:
    """Return how far a finger is taken for hidden, 0..1, and its sigma [deg].

    A straight finger is seldom hidden, neither from cameras nor from a device at the wrist; a bent one lies behind the
    hand or before the palm. That an unseen finger hides is fused with its prior, as one more observation.
    """
    if not isfinite(sigma):
        return (0.0, 0.0) if seen else (1.0, _HIDDEN_SIGMA_DEG)
    weight = 0.0 if seen else sigma * sigma / (sigma * sigma + _HIDDEN_SIGMA_DEG * _HIDDEN_SIGMA_DEG)
    return weight, sqrt(1.0 - weight) * sigma


@inner
def _heading(f: int, joints: Float, T: Float, side: float) -> float:
    """Return where a finger's first bone heads [deg] in the palm's plane.

    To the thumb is positive.

    Fingers that stand up from that plane have no heading in it: their angle fades with what is left.
    """
    x, y, z = 0.0, 0.0, 0.0
    for k in range(3):
        bone = joints[CHAINS[f, 1], k] - joints[CHAINS[f, 0], k]
        x, y, z = x + bone * T[k, 0], y + bone * T[k, 1], z + bone * T[k, 2]
    level = hypot(x, z) / sqrt(x * x + y * y + z * z)
    return degrees(side * atan2(x, z) * min(level / 0.6, 1.0))


def known_bends(features: HandFeatures) -> tuple[list[float], list[bool]]:
    """Return the flexions (4,) [deg] of index ... little and which are known.

    A flexion is MCP and PIP together.
    """
    bends: list[list[float]] = features.bend_rad.tolist()
    return [degrees(mcp + pip) for mcp, pip, _ in bends[1:]], features.known.tolist()[1:]


def known_of(quantities: Quantities) -> Bool:
    """(Q,) which of them are known at all."""
    return np.isfinite(quantities.value) & np.isfinite(quantities.sigma)
