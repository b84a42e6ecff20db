"""The 26 joints as one tree at rest, the basis of BVH files and glTF skeletons.

The wrist is the root. Palm, thumb and the metacarpals hang on it, every further joint on the one before it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from common.arrays import Float
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import FINGER_JOINTS, JOINTS, PALM, WRIST, HandModel

PARENT: dict[int, int] = {PALM: WRIST} | {
    joint: before for chain in FINGER_JOINTS for before, joint in pairwise((WRIST, *chain))
}
ORDER = (WRIST, *PARENT)  # each joint behind its parent
CHILDREN: dict[int, tuple[int, ...]] = {
    joint: tuple(child for child in PARENT if PARENT[child] == joint) for joint in ORDER
}


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """A hand at rest, in its palm frame.

    Attributes:
        hand: Name of the hand profile.
        side: right or left.
        position_m: (26, 3) [m], palm frame.
        orientation_wxyz: (26, 4) joint -> palm frame.
        radius_m: (26,) [m].
    """

    hand: str
    side: str
    position_m: Float
    orientation_wxyz: Float
    radius_m: Float

    @classmethod
    def of(cls, model: HandModel) -> "Skeleton":
        """That of a hand profile."""
        return cls(
            hand=model.profile.name,
            side=model.profile.side,
            position_m=model.rest_position_m,
            orientation_wxyz=matrix_to_quaternion(model.rest_rotation),
            radius_m=model.radius_m,
        )

    def ahead_m(self, joint: int) -> Float:
        """Return the vector from a joint to the end of its flesh (3,) [m].

        It is in the palm frame: the joint's radius along its -z.
        """
        rotated = rotate(self.orientation_wxyz[joint], np.array([0.0, 0.0, -1.0]))
        return self.radius_m[joint] * rotated


def name_of(joint: int) -> str:
    """The joint as XR_EXT_hand_tracking calls it, in the spelling of WebXR."""
    return JOINTS[joint]


def times(a_wxyz: Float, b_wxyz: Float) -> Float:
    """The rotation b, then a: products (..., 4) of quaternions (..., 4)."""
    aw, ax, ay, az = np.moveaxis(a_wxyz, -1, 0)
    bw, bx, by, bz = np.moveaxis(b_wxyz, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def back(q_wxyz: Float) -> Float:
    """The rotations the other way round (..., 4), of unit quaternions (..., 4)."""
    return q_wxyz * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q_wxyz: Float, vector: Float) -> Float:
    """Vectors (..., 3) turned by unit quaternions (..., 4)."""
    w, axis = q_wxyz[..., :1], q_wxyz[..., 1:]
    side = 2.0 * np.cross(axis, vector)
    return vector + w * side + np.cross(axis, side)
