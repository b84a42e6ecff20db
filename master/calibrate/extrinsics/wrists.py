"""Wrist angles: two anatomical ones, and a third that no wrist has.

Also how they change with a rotation.
"""

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.wrist_joint import wrist_angles_of


def wrist_rotation_angles(R_forearm_palm: Float) -> Float:
    """Flexion, deviation and twist (..., 3) [rad] of rotations (..., 3, 3)."""
    return np.concatenate([wrist_angles_of(R_forearm_palm), R_forearm_palm[..., 1, :1]], axis=-1)


def bends_by_rotation(R_forearm_palm: Float) -> Float:
    """Return the derivatives (T, 3, 3) of `wrist_rotation_angles`.

    By a rotation of the palms (T, 3, 3), forearm axes.
    """
    here, out = wrist_rotation_angles(R_forearm_palm), np.empty((len(R_forearm_palm), 3, 3))
    for k in range(3):
        difference_step = 1e-5
        rotated = rotation_vector_to_matrix(difference_step * np.eye(3)[k]) @ R_forearm_palm
        out[..., k] = (wrist_rotation_angles(rotated) - here) / difference_step
    return out
