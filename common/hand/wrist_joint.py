"""Wrist joint between forearm and palm.

It stands between a device on the forearm and the hand.

`wrist_angles_rad` (..., 2) is flexion and deviation, 0 where forearm and palm agree. A flexion is a rotation about
the palm's x, positive where the fingers go to the side of the palm of the hand, a deviation one about its y, positive
towards the thumb of a right hand:

    R_forearm_palm = R_y(deviation) R_x(flexion)

The palm frame has its origin in the wrist joint, so a bend moves nothing but the turn: a camera on the forearm whose
`T_camera_palm` was calibrated with a straight wrist sees the palm at T_camera_palm [R_forearm_palm, 0].
"""

from math import cos, sin

import numpy as np

from common.arrays import Float
from common.geometry.transforms import Wxyz

STRAIGHT = np.zeros(2)
STRAIGHT.flags.writeable = False


def forearm_palm(wrist_angles_rad: Float) -> Float:
    """Rotations (..., 3, 3), palm axes -> forearm axes, of bends (..., 2) [rad]."""
    flexion, deviation = wrist_angles_rad[..., 0], wrist_angles_rad[..., 1]
    c, s, cd, sd = np.cos(flexion), np.sin(flexion), np.cos(deviation), np.sin(deviation)
    R = np.zeros((*wrist_angles_rad.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = cd, sd * s, sd * c
    R[..., 1, 1], R[..., 1, 2] = c, -s
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = -sd, cd * s, cd * c
    return R


def wrist_quaternion(flexion_rad: float, deviation_rad: float) -> Wxyz:
    """The quaternion of `forearm_palm` of one bend."""
    c, s, cd, sd = (
        cos(0.5 * flexion_rad),
        sin(0.5 * flexion_rad),
        cos(0.5 * deviation_rad),
        sin(0.5 * deviation_rad),
    )
    return cd * c, cd * s, sd * c, -sd * s


def wrist_angles_of(R_forearm_palm: Float) -> Float:
    """Return the wrist angles whose rotation comes near to a given rotation.

    Angles (..., 2) [rad], rotations (..., 3, 3): for a rotation about x and y the result is exact.
    """
    deviation = np.arctan2(-R_forearm_palm[..., 2, 0], R_forearm_palm[..., 0, 0])
    flexion = np.arctan2(-R_forearm_palm[..., 1, 2], R_forearm_palm[..., 1, 1])
    return np.stack([flexion, deviation], axis=-1)
