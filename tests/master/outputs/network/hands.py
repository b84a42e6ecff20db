"""Hands for the tests of the outputs: of a profile, in any pose."""

import numpy as np

from common.arrays import Float
from common.geometry.transforms import matrix_to_quaternion, rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from common.messages import HandPose
from tests import results

FLAT = np.zeros((5, 4))
MODELS = {side: HandModel.of(generated_profile(f"my-{side}", side)) for side in ("left", "right")}


def hand_pose(
    side: str,
    angles_rad: Float = FLAT,
    rotation_vector: Float | None = None,
    place_m: tuple[float, float, float] = (0.05, -0.02, 0.4),
    t_ns: int = 5_000_000_000,
) -> HandPose:
    """A hand with these angles (5, 4), its palm turned by a rotation vector (3,) and at a place, rig frame."""
    model = MODELS[side]
    rotation = rotation_vector_to_matrix(np.zeros(3) if rotation_vector is None else rotation_vector)
    joints = model.forward(rigid(rotation, np.array(place_m)), angles_rad)
    return known_hand(model.profile.name, joints.position_m, joints.rotation, angles_rad, t_ns)


def known_hand(name: str, position_m: Float, rotation: Float, angles_rad: Float, t_ns: int) -> HandPose:
    """A pose of joints (26, 3) and (26, 3, 3), all known."""
    return results.hand_pose(
        hand=name,
        t_ns=t_ns,
        position_m=position_m,
        orientation_wxyz=matrix_to_quaternion(rotation),
        radius_m=np.full(26, 0.008),
        angles_rad=angles_rad,
        markers_m=np.empty((0, 3)),
        latency_ns=12_000_000,
    )
