"""Hands of exact angles for the tests of poses."""

import numpy as np

from common.arrays import Bool, Float
from common.hand.model import HandModel
from common.messages import HandPose
from common.sim.motion import POSES, angles_of
from tests.hand_helpers import RIGHT, palm
from tests.results import pose_of

FRAME_NS = 16_666_667
OPEN, TWO, POINT, SMALL, LARGE, PINCH = POSES  # the paper's A to F


def posture(name: str, change_deg: Float | None = None, model: HandModel = RIGHT) -> Float:
    """Angles (5, 4) [rad] of a study pose, changed by (5, 3) [deg]."""
    degrees = np.array(POSES[name], np.float64) + (0.0 if change_deg is None else change_deg)
    return angles_of(model, degrees, np.zeros((5, 4)))


def shown(
    angles_rad: Float,
    t_ns: int = 0,
    model: HandModel = RIGHT,
    T_rig_palm: Float | None = None,
    sigma_m: Float | None = None,
    tracked: Bool | None = None,
    markers: int = 0,
) -> HandPose:
    """The hand of these angles; per finger the sigma of its joints (5,) [m] and whether it is observed (5,)."""
    joints = model.forward(palm() if T_rig_palm is None else T_rig_palm, angles_rad)
    joint_sigma_m, seen = np.full(26, 1e-3), np.ones(26, np.bool_)
    for f in range(5):
        own = slice(2, 6) if f == 0 else slice(7 + 5 * (f - 1), 11 + 5 * (f - 1))
        joint_sigma_m[own] = 1e-3 if sigma_m is None else sigma_m[f]
        seen[own] = True if tracked is None else tracked[f]
    return pose_of(
        model,
        joints,
        t_ns=t_ns,
        tracked=seen,
        cov_m2=joint_sigma_m[:, None, None] ** 2 * np.eye(3),
        source=np.ones(26, np.uint8),
        angles_rad=angles_rad,
        markers_m=np.full((markers, 3), np.nan),
    )
