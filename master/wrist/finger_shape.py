"""A finger from its knuckle on as a rigid body: what its joints beyond the first bone make of it, in that bone's frame.

Abduction and flexion turn the whole finger about its knuckle and change nothing of its shape. So whoever asks for many
poses takes the shape by PIP and DIP alone, which along a valley (`master.wrist.valley`) are the same from step to step
and those of a grid, and brings the few things that it meets (the laser, its plane) into the finger's frame: that is a
third of the arithmetic of bringing the finger to them.

Arrays here have the N poses last, since whatever is done is done to all of them.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.hand_limits import FLEXION
from common.hand_model import CHAINS, Chains, HandModel
from master.wrist.fingertip import Fingertips
from master.wrist.forward import DIP, PIP
from master.wrist.skin import Skin


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Fingers (N) in the frame of their first bone, the knuckle its origin [m].

    Attributes:
        spheres: (3, 8, N) of the skin.
        along: (3, 8, N) the way of the chain through them, unit vectors.
        radius: (8, N) of the spheres [m].
        fixed: (3, 6, N) joints of PIP and DIP [m], the tip [m], and the unit axes about which flexion, PIP and DIP
            turn.
    """

    spheres: Float
    along: Float
    radius: Float
    fixed: Float

    def of(self, rows: Int) -> "Shape":
        """Some of them (M,)."""
        return Shape(
            *(np.take(a, rows, axis=-1) for a in (self.spheres, self.along, self.radius, self.fixed))
        )


@dataclass(frozen=True, slots=True, eq=False)
class ShapedFingers:
    """Fingers (N) in the palm frame.

    Attributes:
        finger: (N,) which.
        rotation: (N, 3, 3) first bone -> palm.
        shape: What they are beyond the knuckle.
    """

    finger: Int
    rotation: Float
    shape: Shape


class FingerShapes:
    """Those of one hand. What it holds was prepared by the constructor."""

    def __init__(self, model: HandModel) -> None:
        self._skin, self._beyond_m = Skin.of(model), Fingertips.of(model).beyond_m
        self._swing, self._bone_m = model.swing, model.bone_m
        self.knuckle_m = model.rest_position_m[CHAINS[:, 0]]
        self.abduction = model.side_sign * model.rest_rotation[CHAINS[:, 0], :, 1]

    def __call__(self, angles_rad: Float, finger: Int) -> Shape:
        """Those of angles (N, 4) of fingers (N,), each its own; what its first two are does not matter."""
        chains = self._chains(angles_rad, finger)
        radius = self._skin.radius_m[finger]
        spheres = Skin(self._skin.palmar_m[finger], radius).spheres(chains)
        bone = np.diff(spheres, axis=1)
        bone /= np.sqrt(np.vecdot(bone, bone))[..., None]
        along = np.concatenate([bone[:, :1], bone[:, 1:] + bone[:, :-1], bone[:, -1:]], axis=1)
        along /= np.sqrt(np.vecdot(along, along))[..., None]
        tip = Fingertips(self._beyond_m[finger]).points(chains)
        axes = -chains.rotation[..., 0]
        fixed = np.concatenate([chains.position_m[:, 1:3], tip[:, None], axes], axis=1)
        spheres, along, fixed = (np.ascontiguousarray(a.T) for a in (spheres, along, fixed))
        return Shape(spheres, along, np.ascontiguousarray(radius.T), fixed)

    def fingers(self, angles_rad: Float, finger: Int, shape: Shape | None = None) -> ShapedFingers:
        """Those of angles (N, 4) of fingers (N,), whose shape may be known."""
        local = self._local(angles_rad, finger, slice(FLEXION + 1))
        shape = self(angles_rad, finger) if shape is None else shape
        return ShapedFingers(finger, local[:, 0] @ local[:, 1], shape)

    def _local(self, angles_rad: Float, finger: Int, which: slice) -> Float:
        """Rotations (N, K, 3, 3) of some of the angles, as of `HandModel.swing`."""
        still, with_cosine, with_sine = self._swing[:, finger, which]
        angle = angles_rad[:, which, None, None]
        return still + np.cos(angle) * with_cosine + np.sin(angle) * with_sine

    def _chains(self, angles_rad: Float, finger: Int) -> Chains:
        """The joints (N, 4, ...) in the frame of the first bone; of the last one no rotation."""
        local, bone = self._local(angles_rad, finger, slice(PIP, DIP + 1)), self._bone_m[finger]
        rotation = np.empty((len(finger), 3, 3, 3))
        rotation[:, 0], rotation[:, 1] = np.eye(3), local[:, 0]
        np.matmul(local[:, 0], local[:, 1], out=rotation[:, 2])
        position = np.zeros((len(finger), 4, 3))
        np.matmul(rotation, bone[..., None], out=position[:, 1:, :, None])
        return Chains(position.cumsum(axis=1), rotation)
