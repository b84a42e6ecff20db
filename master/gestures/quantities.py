"""The quantities that poses are told by (`common.gesture_settings.Quantity`), of one hand, and how sure each is.

A tip that is off by s turns the finger's last two bones about the PIP, so that a bend is off by s over their length;
that is the lever of all bends here. What is said of the thumb's tip is off as the tip is, gaps as both tips are.
Places are in the palm and gaps between tips, so that only what the hand's shape leaves unsure counts: the part of a
tip's doubt that the palm's place has as well moves all of them alike, and is left out.
"""

from dataclasses import dataclass
from typing import get_args

import numpy as np

from common.arrays import Bool, Float
from common.gesture_settings import Quantity
from common.hand_model import CHAINS
from master.gestures.features import HandFeatures

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
HIDDEN_DEG, HIDDEN_SIGMA_DEG = (
    np.array([55.0, 75.0]),
    45.0,
)  # MCP and PIP of a finger that hides; of their sum
_COUNT = len(QUANTITIES)
_BENDS = slice(0, 12)  # index ... little, each MCP, PIP, both
_THUMB_BEND, _THUMB_PLACE, _GAPS, _AHEAD, _SPREADS = 12, slice(13, 16), slice(16, 20), 20, slice(22, 25)


@dataclass(frozen=True, slots=True, eq=False)
class Quantities:
    """All quantities of a hand at one instant, in the order of `QUANTITIES` and in the units of their names.

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
        chain, doubt = features.joints_m[CHAINS], features.shape_sigma_m
        bend = np.degrees(features.bend_rad)
        bone = chain[:, 2:] - chain[:, 1:-1]
        lever = np.sqrt(np.vecdot(bone, bone)).sum(axis=1)
        turned = np.degrees(doubt / lever)
        bend[1:, :2], turned[1:] = _hidden(bend[1:, :2], turned[1:], features.seen[1:])
        both = bend[1:, :2].sum(axis=1)
        each = value[_BENDS].reshape(4, 3)  # a view
        each[:, :2], each[:, 2] = bend[1:, :2], both
        sigma[_BENDS] = turned[1:].repeat(3)
        value[_THUMB_BEND], sigma[_THUMB_BEND] = bend[0, 1:].sum(), turned[0]
        place = (features.tips_m[0] - features.T_rig_palm[:3, 3]) @ features.T_rig_palm[:3, :3]
        value[_THUMB_PLACE] = place * [features.side_sign, -1.0, 1.0] / features.size_m
        sigma[_THUMB_PLACE] = doubt[0] / features.size_m
        off = features.tips_m[1:] - features.tips_m[0]
        apart = np.sqrt(np.vecdot(off, off))
        value[_GAPS] = 1e3 * (apart - features.radius_m[1:] - features.radius_m[0])
        sigma[_GAPS] = 1e3 * np.hypot(doubt[1:], doubt[0])
        value[_AHEAD] = both[0] - both[1:].mean()
        sigma[_AHEAD] = np.hypot(turned[1], np.sqrt((turned[2:] ** 2).sum()) / 3.0)
        value[_AHEAD + 1], sigma[_AHEAD + 1] = both.mean(), turned[1:].mean()  # neighbours are wrong alike
        value[_SPREADS], sigma[_SPREADS] = _spreads(chain, features), np.hypot(turned[1:-1], turned[2:])
        return cls(value, sigma)


def _hidden(bend: Float, sigma: Float, seen: Bool) -> tuple[Float, Float]:
    """Bends (4, 2) [deg] of MCP and PIP and their doubt (4,) [deg], where fingers that hide are likely bent.

    A straight finger is seldom hidden, neither from cameras nor from a device at the wrist; a bent one lies behind the
    hand or before the palm. That an unseen finger hides is joined with what is believed of it, as one more witness.
    """
    known = np.isfinite(sigma)
    own = np.where(known, sigma, 0.0)
    weight = np.where(seen, 0.0, np.where(known, own * own / (own * own + HIDDEN_SIGMA_DEG**2), 1.0))
    joined = np.sqrt(1.0 - weight) * own
    return bend + weight[:, None] * (HIDDEN_DEG - bend), np.where(weight >= 1.0, HIDDEN_SIGMA_DEG, joined)


def _spreads(chain: Float, features: HandFeatures) -> Float:
    """Angles (3,) [deg] between neighbouring fingers' first bones (5, 4, 3) in the palm's plane, open is positive.

    Fingers that stand up from that plane have no heading in it: their angle fades with what is left.
    """
    first = (chain[1:, 1] - chain[1:, 0]) @ features.T_rig_palm[:3, :3]
    level = np.hypot(first[:, 0], first[:, 2]) / np.sqrt(np.vecdot(first, first))
    heading = features.side_sign * np.arctan2(first[:, 0], first[:, 2]) * np.minimum(level / 0.6, 1.0)
    return np.degrees(heading[:-1] - heading[1:])


def known_bends(features: HandFeatures) -> tuple[Float, Bool]:
    """Bends (4,) [deg] of index ... little, MCP and PIP together, and which of these fingers are known."""
    return np.degrees(features.bend_rad[1:, :2].sum(axis=1)), features.known[1:]


def known_of(quantities: Quantities) -> Bool:
    """(Q,) which of them are known at all."""
    return np.isfinite(quantities.value) & np.isfinite(quantities.sigma)
