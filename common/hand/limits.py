"""Joint limits of a hand: a range per angle.

The range of abduction narrows with flexion.

Spread fingers cannot stay spread in a fist: the collateral ligaments of the MCP tighten, because the head of the
metacarpal is a cam. With f the flexion, F the highest and s what is left there, the range of the abduction is
multiplied by

    1 - (1 - s) (min(max(f, 0), F) / F)^2

the parabolic limit Kalbfleisch wished for. It narrows towards 0, so 0 lies in the range.
"""

from typing import TypeVar

import numpy as np

from common.arrays import Float
from common.calibration import FingerLimits, Limits
from common.errors import CalibrationError

ABDUCTION, FLEXION = 0, 1  # columns of the angles
_FINGERS = Limits.__struct_fields__  # thumb ... little
_ANGLES = ("abduction", "flexion", "pip", "dip")

FloatOrArray = TypeVar("FloatOrArray", float, Float)


def spread_left(flexed: FloatOrArray, at_full_flexion: FloatOrArray) -> FloatOrArray:
    """Return the share of the abduction range that remains at a flexion.

    A parabola from 1 down to `at_full_flexion`.

    Args:
        flexed: Flexion as a share of the highest, 0 ... 1.
        at_full_flexion: Share left where `flexed` is 1.
    """
    return 1.0 - (1.0 - at_full_flexion) * flexed * flexed


def limit_table(limits: Limits, where: str) -> Float:
    """Low and high (5, 4, 2) [rad] of every angle, where nothing narrows them.

    Raises:
        CalibrationError: A low is above its high.
    """
    table = np.array(
        [[getattr(getattr(limits, finger), f"{angle}_rad") for angle in _ANGLES] for finger in _FINGERS]
    )
    crossed = np.argwhere(table[..., 0] > table[..., 1])
    if len(crossed):
        finger, angle = crossed[0]
        raise CalibrationError(
            f"{where}: limits_rad.{_FINGERS[finger]}.{_ANGLES[angle]}_rad: low is above high"
        )
    return table


def tolerance_table(limits: Limits) -> Float:
    """Standard deviations (5, 4) [rad] by which people differ from the limits."""
    return np.array([getattr(limits, finger).tolerance_rad for finger in _FINGERS])


def spread_table(limits: Limits, where: str) -> Float:
    """Share (5,) of the abduction range left at the highest flexion.

    Raises:
        CalibrationError: A range that does not contain 0 cannot narrow towards it.
    """
    shares: list[float] = []
    for finger in _FINGERS:
        of: FingerLimits = getattr(limits, finger)
        low, high = of.abduction_rad
        if of.spread_at_full_flexion < 1.0 and not low <= 0.0 <= high:
            raise CalibrationError(
                f"{where}: limits_rad.{finger}.spread_at_full_flexion: below 1 it narrows abduction_rad towards 0,"
                f" which {low} ... {high} does not contain"
            )
        shares.append(of.spread_at_full_flexion)
    return np.array(shares)
