"""A hand profile and its markers as flat arrays, for kernels."""

from typing import NamedTuple

import numpy as np

from common.arrays import Float, Int
from common.hand_model import CHAINS, HandModel
from master.estimator.attached import Attached
from master.estimator.parameters import HandParameters


class HandTables(NamedTuple):
    """A hand profile with n free angles.

    Attributes:
        swing: (3, 5, 4, 3, 3) as `HandModel.swing`.
        tip_turn: (5, 3, 3) rest rotation of the tip in the frame of the joint before it.
        root_m: (5, 3) first joint of each chain, palm frame [m].
        bone_m: (5, 3, 3) bones in the frames of their joints [m].
        abduction_axis: (5, 3) palm frame.
        complete: (20, n) all angles by the free ones, abductions before they narrow.
        abduction, flexion: (5,) columns of the free angles; -1: nothing narrows the finger's abduction.
        most: (5,) [rad] highest flexion.
        left: (5,) share of the abduction left there.
        low, high: (n,) [rad] limits of the free angles.
        finger: (26,) chain of each joint, -1: fixed to the palm.
        level: (26,) its place in the chain.
        rest_m, rest_R: (26, 3) [m], (26, 3, 3) place and rotation of those fixed to the palm, palm frame.
    """

    swing: Float
    tip_turn: Float
    root_m: Float
    bone_m: Float
    abduction_axis: Float
    complete: Float
    abduction: Int
    flexion: Int
    most: Float
    left: Float
    low: Float
    high: Float
    finger: Int
    level: Int
    rest_m: Float
    rest_R: Float

    @classmethod
    def of(cls, model: HandModel, parameters: HandParameters) -> "HandTables":
        """Lay out a hand."""
        axis = np.zeros((5, 3))
        axis[:, 1] = model.side_sign
        axis[0] = model.side_sign * model.rest_rotation[CHAINS[0, 0]][:, 1]
        finger, level = np.full(26, -1, np.int64), np.zeros(26, np.int64)
        for f, chain in enumerate(CHAINS):
            finger[chain], level[chain] = f, np.arange(4)
        abduction, flexion = np.full(5, -1, np.int64), np.full(5, -1, np.int64)
        most = np.ascontiguousarray(model.limits_rad[:, 1, 1])
        for f in np.flatnonzero((model.spread_at_full_flexion < 1.0) & (most > 0.0)):
            abduction[f], flexion[f] = np.searchsorted(parameters.free, (4 * f, 4 * f + 1))
        return cls(
            np.ascontiguousarray(model.swing),
            np.ascontiguousarray(model.turn[:, 2]),
            np.ascontiguousarray(model.rest_position_m[CHAINS[:, 0]]),
            np.ascontiguousarray(model.bone_m),
            axis,
            np.ascontiguousarray(parameters.complete),
            abduction,
            flexion,
            most,
            np.ascontiguousarray(model.spread_at_full_flexion, np.float64),
            np.ascontiguousarray(parameters.low),
            np.ascontiguousarray(parameters.high),
            finger,
            level,
            np.ascontiguousarray(model.rest_position_m),
            np.ascontiguousarray(model.rest_rotation),
        )


class Mounts(NamedTuple):
    """Where M markers sit on a hand.

    Attributes:
        finger: (M,) chain; -1: the palm.
        level: (M,) joint of the chain.
        offset_m: (M, 3) [m] place in that joint's frame.
    """

    finger: Int
    level: Int
    offset_m: Float

    @classmethod
    def of(cls, attached: Attached) -> "Mounts":
        """Lay out markers."""
        return cls(
            np.where(attached.on_finger[:, 0], attached.finger, -1),
            np.ascontiguousarray(attached.level),
            np.ascontiguousarray(attached.offset_m),
        )
