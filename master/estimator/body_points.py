"""Points fixed to a hand, and how they move with its angles.

The model is rigid bodies rotating about known axes.

A point on a finger is turned by the axes of the joints before it: abduction and flexion at the root (level 0), PIP
(1) and DIP (2). Turning about axis a through o moves it by a x (point - o). All in the palm frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import skew
from common.hand.model import CHAINS, Chains, HandJoints, HandModel
from master.estimator.parameters import HandParameters

_AXIS_JOINT: Int = np.array([0, 0, 1, 2])  # joint of the chain at which abduction, flexion, PIP, DIP turn


@dataclass(frozen=True, slots=True, eq=False)
class BodyPoints:
    """P points, each fixed to a joint of a finger's chain or to the palm.

    Attributes:
        finger, level: (P,) chain and joint of the chain (0 root ... 3 tip); zeros for the palm.
        on_finger: (P, 1) whether it is fixed to a chain.
        offset_m: (P, 3) place in that joint's frame; palm: in the palm frame.
        moves: (P, 4, n) how much the free angles turn each of the four axes, 0 where that leaves the point alone.
        abduction_axis: (5, 1, 3) palm frame; the only axis that no angle turns.
        parameters: The free angles.
    """

    finger: Int
    level: Int
    on_finger: Bool
    offset_m: Float
    moves: Float
    abduction_axis: Float
    parameters: HandParameters

    @classmethod
    def markers(cls, model: HandModel, parameters: HandParameters, names: Sequence[str]) -> "BodyPoints":
        """The markers of these names.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        mounts = [model.mount(name) for name in names]
        places: list[tuple[int | None, Float]] = []
        for mount in mounts:
            if mount.joint is None or mount.finger is not None:
                places.append((mount.joint, mount.offset_m))
            else:  # wrist and metacarpals do not move against the palm
                R, p = model.rest_rotation[mount.joint], model.rest_position_m[mount.joint]
                places.append((None, p + R @ mount.offset_m))
        return cls._of(model, parameters, places)

    @classmethod
    def joints(cls, model: HandModel, parameters: HandParameters) -> "BodyPoints":
        """The 26 joints themselves."""
        on_chain = np.isin(np.arange(26), CHAINS)
        places = [
            (joint, np.zeros(3)) if on_chain[joint] else (None, model.rest_position_m[joint])
            for joint in range(26)
        ]
        return cls._of(model, parameters, places)

    @classmethod
    def _of(
        cls, model: HandModel, parameters: HandParameters, places: Sequence[tuple[int | None, Float]]
    ) -> "BodyPoints":
        """Build points from their places on the hand.

        A place is (joint of a chain, offset in its frame), or (None, place in the palm frame).
        """
        count = len(places)
        finger, level, on_finger = np.zeros(count, int), np.zeros(count, int), np.zeros((count, 1), bool)
        moves = np.zeros((count, 4, len(parameters.free)))
        for p, (joint, _) in enumerate(places):
            if joint is not None:
                finger[p], level[p] = np.argwhere(joint == CHAINS)[0]
                on_finger[p] = True
                used = min(int(level[p]), 2) + 2
                moves[p, :used] = parameters.complete[4 * finger[p] : 4 * finger[p] + used]
        axis = np.zeros((5, 1, 3))
        axis[:, 0, 1] = model.side_sign
        axis[0, 0] = model.side_sign * model.rest_rotation[CHAINS[0, 0]][:, 1]
        offset = np.array([offset for _, offset in places]).reshape(count, 3)
        return cls(finger, level, on_finger, offset, moves, axis, parameters)

    def only(self, use: Bool) -> "BodyPoints":
        """The points where `use` (P,) is true."""
        if use.all():
            return self
        return BodyPoints(
            self.finger[use],
            self.level[use],
            self.on_finger[use],
            self.offset_m[use],
            self.moves[use],
            self.abduction_axis,
            self.parameters,
        )

    def place(self, chains: Chains) -> Float:
        """Return the positions of the points (..., P, 3) [m], palm frame.

        The leading axes are those of the chains.
        """
        R = chains.rotation[..., self.finger, self.level, :, :]
        p = chains.position_m[..., self.finger, self.level, :]
        return np.where(self.on_finger, p + (R @ self.offset_m[..., None])[..., 0], self.offset_m)

    def on(self, joints: HandJoints) -> Float:
        """Where the points are (P, 3) [m], rig frame, on a hand whose joints are there."""
        T, at = joints.T_rig_palm, CHAINS[self.finger, self.level]
        R = np.where(self.on_finger[..., None], joints.rotation[at], T[:3, :3])
        p = np.where(self.on_finger, joints.position_m[at], T[:3, 3])
        return p + (R @ self.offset_m[..., None])[..., 0]

    def jacobian(self, chains: Chains, points_m: Float, x: Float) -> Float:
        """Return the derivatives of the points by the parameters.

        The result is (..., P, 3, n) [m/rad] for points (..., P, 3), palm frame, at x (..., n).
        """
        axes = np.empty((*chains.position_m.shape[:-3], 5, 4, 3))
        axes[..., :1, :] = self.abduction_axis
        np.negative(chains.rotation[..., :3, :, 0], out=axes[..., 1:, :])
        arm = points_m[..., None, :] - chains.position_m[..., self.finger[:, None], _AXIS_JOINT, :]
        moments = skew(axes)[..., self.finger, :, :, :] @ arm[..., None]  # (..., P, 4, 3, 1)
        return self.parameters.by_parameters(moments[..., 0].swapaxes(-1, -2) @ self.moves, x)
