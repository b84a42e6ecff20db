"""Flexion synergy: the joints of a finger bend together (Kim et al. 2012).

The MCP of a finger is 0.54 of its PIP and the DIP 0.84 (Kamper et al. 2003); a hand file that states couplings has its
own. A thumb closes in proportion, from one end of its limits to the other.
"""

from dataclasses import dataclass
from math import radians

import numpy as np

from common.arrays import Float
from common.calibration.hand_presets import preset_couplings
from common.hand.limits import ABDUCTION, FLEXION
from common.hand.model import HandModel

PIP, DIP = 2, 3
FULL_CURL_RAD = radians(120.0)


@dataclass(frozen=True, slots=True, eq=False)
class FlexionSynergy:
    """Angles by closing: base + closing * slope.

    Attributes:
        base_rad, slope: (5, 4); the slope of the PIP (thumb MCP) is 1.
        range_rad: (5, 2) of the closing.
    """

    base_rad: Float
    per_pip: Float
    range_rad: Float

    @classmethod
    def of(cls, model: HandModel) -> "FlexionSynergy":
        """Return the flexion synergy of a hand.

        It uses the hand's own couplings where its file states them, else those of Digits.
        """
        stated = model.profile.couplings is not None
        digits = preset_couplings("D")
        mcp, dip = (model.mcp_per_pip, model.dip_per_pip) if stated else (None, None)
        base, per_pip, range_rad = np.zeros((5, 4)), np.zeros((5, 4)), np.empty((5, 2))
        per_pip[1:, FLEXION] = digits.mcp_per_pip if mcp is None else mcp
        per_pip[1:, DIP] = digits.dip_per_pip if dip is None else dip
        per_pip[:, PIP] = 1.0
        range_rad[1:] = 0.0, FULL_CURL_RAD
        low, high = model.limits_rad[0, 1:].T
        span = np.maximum(high - low, 1e-3)
        per_pip[0, 1:] = span / span[1]
        base[0, 1:] = low - low[1] * per_pip[0, 1:]
        range_rad[0] = low[1], low[1] + span[1]
        return cls(base, per_pip, range_rad)

    def angles(self, curl_rad: Float, abduction_rad: Float) -> Float:
        """Angles (..., 5, 4) [rad] of closings and abductions (..., 5) [rad]."""
        angles = self.base_rad + curl_rad[..., None] * self.per_pip
        angles[..., ABDUCTION] = abduction_rad
        return angles
