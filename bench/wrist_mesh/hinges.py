"""Forward kinematics of the mesh hand: from the 21 named angles to the poses of its 25 joints.

The hinges of one finger are parallel: all turn about one axis across its proximal bone (thumb: across its metacarpal).
That axis is the mean of the joints' own x axes, turned about the bone by `ROLL_RAD`, which was fitted to the joints of
the rendered recordings (largest error 1 um):

    fingers   R_MCP = R_y(s a) R_h(flexion)                    a from the palm's +z, s = +1 right hand, -1 left hand
    thumb     R_CMC = R_z(-s twist) R_u(s abduction) R_h(flexion)    z along the bone, u = z x h

and then R_h(PIP), R_h(DIP); of the thumb R_h(MCP), R_h(IP).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.hand.model import HandModel

ROLL_RAD = {  # thumb, index ... little
    "right": (0.041463, 0.002728, 0.001839, -0.000725, 0.000906),
    "left": (-0.014002, -0.003121, -0.003997, 0.000414, -0.000888),
}
CHAINS = np.array(
    [[1, 2, 3, 4], [6, 7, 8, 9], [11, 12, 13, 14], [16, 17, 18, 19], [21, 22, 23, 24]]
)  # of 25 joints


@dataclass(frozen=True, slots=True, eq=False)
class Hinges:
    """The mesh hand's kinematics.

    Attributes:
        rest_m: Joints at rest (25, 3) [m], palm frame.
        rest_rotation: (25, 3, 3), joint frame -> palm frame.
        frame: (5, 3, 3), columns h (hinge axis), u = z x h, z (the first bone), palm frame.
        ahead_rad: (5,) angle of the first bone at rest from the palm's +z, towards the thumb.
        side_sign: +1 right, -1 left.
    """

    rest_m: Float
    rest_rotation: Float
    frame: Float
    ahead_rad: Float
    side_sign: float

    @classmethod
    def of(cls, model: HandModel) -> "Hinges":
        """Of a hand whose profile is one of the mesh's."""
        rest, rotation = model.rest_position_m[1:], model.rest_rotation[1:]
        sign = model.side_sign
        frame = np.empty((5, 3, 3))
        ahead = np.empty(5)
        for f, chain in enumerate(CHAINS):
            along = rest[chain[1]] - rest[chain[0]]
            along /= np.linalg.norm(along)
            mean = -rotation[chain[:3], :, 0].mean(axis=0)
            across = mean - (mean @ along) * along
            across /= np.linalg.norm(across)
            roll = ROLL_RAD[model.profile.side][f]
            across = np.cos(roll) * across + np.sin(roll) * np.cross(along, across)
            frame[f] = np.stack([across, np.cross(along, across), along], axis=1)
            ahead[f] = np.arctan2(sign * along[0], along[2])
        return cls(rest, rotation, frame, ahead, sign)

    def pose(self, angles_rad: Float) -> tuple[Float, Float]:
        """Joints (25, 3) [m] in the palm frame, and how each is turned from its rest (25, 3, 3).

        Args:
            angles_rad: The named angles (21,).
        """
        rotated = np.tile(np.eye(3), (25, 1, 1))
        at = self.rest_m.copy()
        for f, chain in enumerate(CHAINS):
            across, up, along = self.frame[f].T
            if f:
                flexion, spread, second, third = angles_rad[1 + 4 * f : 5 + 4 * f]
                first = _rotation(np.array([0.0, 1.0, 0.0]), self.side_sign * (spread - self.ahead_rad[f]))
            else:
                flexion, spread, twist, second, third = angles_rad[:5]
                first = _rotation(along, -self.side_sign * twist) @ _rotation(up, self.side_sign * spread)
            rotation = first @ _rotation(across, flexion)
            for k, bend in enumerate((0.0, second, third)):
                rotation = rotation @ _rotation(across, bend)
                rotated[chain[k]] = rotation
                at[chain[k + 1]] = at[chain[k]] + rotation @ (
                    self.rest_m[chain[k + 1]] - self.rest_m[chain[k]]
                )
            rotated[chain[3]] = rotation
        return at, rotated


def _rotation(axis: Float, angle_rad: float) -> Float:
    """Rotation (3, 3) about a unit axis (3,)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross
