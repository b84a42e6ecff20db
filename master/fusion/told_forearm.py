"""What one instant tells of the palm's turn and the wrist's bend together: markers, and fingers before the device.

Fingers that a device on the forearm sees seem bent by the wrist's bend as well. Where markers tell how they truly are,
that is what the bend is; and where markers hardly tell how the palm is turned, as one on its back does, a bend that is
known so tells that. So the two are told together, as information and pull about the hand that was solved:

    cost(u) = u' information u / 2 - pull' u + constant,   u = (turn of the palm from there, bend less the believed one)

In the fit (`master.fusion.sensed_hand`) the bend is integrated out. In a least-squares fit information adds up, at its
solution the pulls of all that is known cancel. So what the other sensors said is taken out of both, and what sights
tell of fingers put in again, now with the bend as an unknown of which nothing is believed. Then shift and free angles
are integrated out (Schur complement). What the IMU said of the palm is not in it.
"""

from dataclasses import dataclass
from math import radians
from typing import Self

import numpy as np

from common.arrays import Float
from common.geometry import rotation_vector_to_matrix
from master.estimator.epoch import FittedHand
from master.estimator.parameters import HandParameters
from master.fusion.sensed_hand import SensedHand

_TURN, _PALM, _ANGLES, _SIGHTS = 3, 6, 20, 22
_EACH_RAD = radians(5.0)  # what one finger seems bent by, as by a wrist: a thumb alone tells no wrist
_ALIKE_RAD = radians(1.5)  # what all fingers seem bent by, as by a wrist, for how the device is put on


@dataclass(frozen=True, slots=True, eq=False)
class ToldForearm:
    """What an instant tells about a palm and a bend nearby.

    Attributes:
        R_rig_palm: (3, 3) palm axes -> rig frame, the palm from where `u` counts.
        bend_rad: (2,) flexion and deviation from where it counts.
        information: (5, 5) [1/rad^2] of turn, as a rotation vector in rig axes, and bend; may be singular.
        pull: (5,) [1/rad] information by where they are.
    """

    R_rig_palm: Float
    bend_rad: Float
    information: Float
    pull: Float

    @classmethod
    def of_palm(cls, R_rig_palm: Float, cov_rad2: Float) -> Self:
        """A palm (3, 3) with the covariance (3, 3) [rad^2] of the rotation vector, rig axes, to the true one."""
        information = np.zeros((5, 5))
        information[:_TURN, :_TURN] = np.linalg.inv(cov_rad2)
        return cls(R_rig_palm, np.zeros(2), information, np.zeros(5))

    @property
    def known(self) -> bool:
        """Whether it says anything that can be reckoned with."""
        return bool(np.isfinite(self.information).all() and np.isfinite(self.R_rig_palm).all())

    def palm(self, bend_rad: Float, bend_cov_rad2: Float) -> tuple[Float, Float]:
        """The palm (3, 3), rig frame, and its covariance (3, 3) [rad^2], with a belief about the bend."""
        believed = np.linalg.inv(bend_cov_rad2)
        information, pull = self.information.copy(), self.pull.copy()
        information[_TURN:, _TURN:] += believed
        pull[_TURN:] += believed @ (bend_rad - self.bend_rad)
        cov: Float = np.asarray(np.linalg.inv(information), np.float64)
        turn = (cov @ pull)[:_TURN]
        return rotation_vector_to_matrix(turn) @ self.R_rig_palm, cov[:_TURN, :_TURN]


def told_forearm(
    hand: FittedHand, sensed: SensedHand | None, bend_rad: Float, parameters: HandParameters
) -> ToldForearm:
    """What the instant of a solved hand tells.

    Args:
        hand: The hand, solved with what other sensors said at that bend.
        sensed: That, as the fit took it; None: nothing.
        bend_rad: (2,) the bend.
        parameters: Its free angles.
    """
    R, size = hand.T_rig_palm[:3, :3], len(hand.alone)
    normal, pull = np.zeros((size + 2, size + 2)), np.zeros(size + 2)
    normal[:size, :size] = np.linalg.inv(hand.alone)
    if sensed is not None:
        belief = sensed.of(parameters)
        added, gradient = np.zeros((size, size)), np.zeros(size)
        belief.add_to(R, hand.x, gradient, added)
        without = normal[:size, :size] - added / hand.scale
        normal[:size, :size] = _at_least(without, parameters.anywhere / hand.scale)
        pull[:size] = gradient / hand.scale
        by = np.zeros((_SIGHTS, size + 2))
        by[:_ANGLES, _PALM:size], by[_ANGLES:, size:] = belief.by_free, np.eye(2)
        off = np.concatenate([belief.by_free @ hand.x - belief.means, np.zeros(2)])
        weighed = by.T @ _of_sights(sensed) / hand.scale
        normal += weighed @ by
        pull -= weighed @ off
    told, rest = np.r_[:_TURN, size : size + 2], np.r_[_TURN:size]
    crossed = normal[np.ix_(rest, told)]
    along: Float = np.asarray(np.linalg.solve(normal[np.ix_(rest, rest)], crossed), np.float64)
    information = normal[np.ix_(told, told)] - crossed.T @ along
    return _for_all_alike(ToldForearm(R, bend_rad, information, pull[told] - pull[rest] @ along))


def _for_all_alike(told: ToldForearm) -> ToldForearm:
    """The same with a doubt that all fingers share."""
    by_bend = told.information[:, _TURN:]
    alike: Float = np.asarray(
        np.linalg.solve(by_bend[_TURN:] + _ALIKE_RAD**-2.0 * np.eye(2), by_bend.T), np.float64
    )
    information = told.information - by_bend @ alike
    return ToldForearm(
        told.R_rig_palm,
        told.bend_rad,
        0.5 * (information + information.T),
        told.pull - told.pull[_TURN:] @ alike,
    )


def _of_sights(belief: SensedHand) -> Float:
    """Information (22, 22) [1/rad^2] that sights of fingers have of their angles and the bend."""
    each = np.zeros((5, 6, 6))
    each[:, :4, :4], each[:, 4:, 4:] = belief.weight, belief.of_bend
    each[:, :4, 4:], each[:, 4:, :4] = belief.with_bend, np.swapaxes(belief.with_bend, 1, 2)
    # Of a bend that is a little other to each finger.
    own = each[:, 4:, 4:] + _EACH_RAD**-2.0 * np.eye(2)
    taken: Float = np.asarray(np.linalg.solve(own, each[:, 4:]), np.float64)
    each -= each[:, :, 4:] @ taken
    both = np.zeros((_SIGHTS, _SIGHTS))
    for f in range(5):
        at = np.r_[4 * f : 4 * f + 4, _ANGLES:_SIGHTS]
        both[np.ix_(at, at)] += each[f]
    return both


def _at_least(normal: Float, least: Float) -> Float:
    """A normal matrix (N, N) that in no direction has less than the diagonal one of (N,), which is always known.

    Where two hypotheses are mixed, the difference between them hides what a sensor said.
    """
    unit = np.sqrt(least)
    values, axes = np.linalg.eigh(normal / np.multiply.outer(unit, unit))
    axes = unit[:, None] * axes
    return np.asarray(axes * np.maximum(values, 1.0) @ axes.T, np.float64)
