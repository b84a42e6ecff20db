"""A hand profile and its markers as flat arrays, for kernels."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand.model import CHAINS, FINGER_JOINTS, HandModel
from common.messages.records import filled
from master.estimator.parameters import REACH, HandParameters


class HandTables:
    """A hand profile with n free angles.

    Attributes:
        swing: (3, 5, 4, 3, 3) as `HandModel.swing`.
        tip_rotation: (5, 3, 3) rest rotation of the tip in the frame of the joint before it.
        root_m: (5, 3) first joint of each chain, palm frame [m].
        bone_m: (5, 3, 3) bones in the frames of their joints [m].
        abduction_axis: (5, 3) palm frame.
        first: (6,) column of the first free angle of each finger; those of finger f are first[f] ... first[f + 1] - 1.
        complete: (20, 4) all angles by the free ones of their finger, abductions before they narrow.
        narrows: (5,) whether flexion narrows the finger's abduction.
        most: (5,) [rad] highest flexion.
        left: (5,) share of the abduction left there.
        low, high: (n,) [rad] limits of the free angles.
        legal_low, legal_high, beyond_w2: (n,) as of `HandParameters`.
        rests: (n,) whether it often stands at its low limit, as that of a straight finger.
        anywhere: (6 + n,) inverse variances of a hand of which nothing is known but its limits.
        limits: (5, 4, 2) [rad] low and high of all angles, abductions before they narrow.
        finger: (26,) chain of each joint, -1: fixed to the palm.
        level: (26,) its place in the chain.
        middle: (26,) the PIP of its finger, a metacarpal's too; those of thumb, palm and wrist: themselves.
        rest_m, rest_R: (26, 3) [m], (26, 3, 3) place and rotation of those fixed to the palm, palm frame.
        twist: (5,) [rad] by which the hinges of each finger are rolled about its first bone, in `swing` (`twist_hand`).
        twist_axis: (5, 3) that bone, in the frame of the abduction.
        untwisted: (3, 5, 3, 3) `swing` of the abductions with hinges as the profile has them.
        product: (3, 3) room.
    """

    swing: Float
    tip_rotation: Float
    root_m: Float
    bone_m: Float
    abduction_axis: Float
    first: Int
    complete: Float
    narrows: Bool
    most: Float
    left: Float
    low: Float
    high: Float
    legal_low: Float
    legal_high: Float
    beyond_w2: Float
    at_low_limit: Bool
    anywhere: Float
    limits: Float
    finger: Int
    level: Int
    middle: Int
    rest_m: Float
    rest_R: Float
    twist: Float
    twist_axis: Float
    untwisted: Float
    product: Float

    @classmethod
    def of(cls, model: HandModel, parameters: HandParameters) -> "HandTables":
        """Lay out a hand model."""
        axis = np.zeros((5, 3))
        axis[:, 1] = model.side_sign
        axis[0] = model.side_sign * model.rest_rotation[CHAINS[0, 0]][:, 1]
        finger, level = np.full(26, -1, np.int64), np.zeros(26, np.int64)
        for f, chain in enumerate(CHAINS):
            finger[chain], level[chain] = f, np.arange(4)
        middle: Int = np.arange(26)
        for chain, joints in zip(CHAINS[1:], FINGER_JOINTS[1:], strict=True):
            middle[list(joints)] = chain[1]
        first = np.searchsorted(parameters.free, 4 * np.arange(6)).astype(np.int64)
        complete = np.zeros((20, 4))
        for f in range(5):
            own = parameters.complete[4 * f : 4 * f + 4, first[f] : first[f + 1]]
            complete[4 * f : 4 * f + 4, : own.shape[1]] = own
        most = np.ascontiguousarray(model.limits_rad[:, 1, 1])
        first_bone = np.einsum("fij,fj->fi", model.swing[:2, :, 1].sum(axis=0), model.bone_m[:, 0])
        stiff_rad = 1e-9  # an angle whose highest flexion is 0 narrows nothing
        tables: dict[str, Float | Int | Bool] = {
            "swing": model.swing,
            "tip_rotation": model.link_rotation[:, 2],
            "root_m": model.rest_position_m[CHAINS[:, 0]],
            "bone_m": model.bone_m,
            "abduction_axis": axis,
            "first": first,
            "complete": complete,
            "narrows": (model.spread_at_full_flexion < 1.0) & (most > 0.0),
            "most": np.maximum(most, stiff_rad),
            "left": model.spread_at_full_flexion,
            "low": parameters.low,
            "high": parameters.high,
            "legal_low": parameters.legal_low,
            "legal_high": parameters.legal_high,
            "beyond_w2": parameters.beyond_w2,
            "at_low_limit": parameters.at_low_limit,
            "anywhere": parameters.anywhere,
            "limits": model.limits_rad
            + REACH * np.stack([-model.tolerance_rad, model.tolerance_rad], axis=2),
            "finger": finger,
            "level": level,
            "middle": middle,
            "rest_m": model.rest_position_m,
            "rest_R": model.rest_rotation,
            "twist": np.zeros(5),
            "twist_axis": first_bone / np.linalg.norm(first_bone, axis=1, keepdims=True),
            "untwisted": model.swing[:, :, 0],
            "product": np.zeros((3, 3)),
        }
        return filled(cls, tables)


class Mounts(NamedTuple):
    """Where M markers sit on a hand.

    Attributes:
        finger: (M,) chain; -1: the palm.
        level: (M,) joint of the chain.
        offset_m: (M, 3) [m] place in that joint's frame.
        on_back: (M,) whether it is on the palm itself.
    """

    finger: Int
    level: Int
    offset_m: Float
    on_back: Bool

    @classmethod
    def of(cls, model: HandModel, names: Sequence[str]) -> "Mounts":
        """Lay out the markers of these names.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        finger, level = np.full(len(names), -1, np.int64), np.zeros(len(names), np.int64)
        offset = np.zeros((len(names), 3))
        for m, name in enumerate(names):
            mount = model.mount(name)
            offset[m] = mount.offset_m
            if mount.finger is not None:
                finger[m], level[m] = np.argwhere(mount.joint == CHAINS)[0]
            elif mount.joint is not None:  # wrist and metacarpals do not move against the palm
                R, p = model.rest_rotation[mount.joint], model.rest_position_m[mount.joint]
                offset[m] = p + R @ mount.offset_m
        on_back = np.array([model.mount(name).joint is None for name in names], np.bool_)
        return cls(finger, level, offset, on_back)
