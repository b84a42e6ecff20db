"""Close a hand round a bar: the bar's place and the angles of each finger.

The bar lies in the hooked fingers, across the hand and a little aslant, as that of a bucket or a drawer. Index to
little finger close as fingers do, the knuckle by a fixed share of the middle joint, until the first of their bones
meets the bar; the thumb closes over it from the other side, its tip across the palm. Bones are round cones with the
radii of the profile.
"""

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, MIDDLE_PROXIMAL, HandModel
from common.sim.motion import angles_of

MCP_PER_PIP = 0.54  # Kamper's ratio, in Kim et al. 2012
ASLANT = np.radians(15.0)  # further from the wrist on the side of the thumb
SPREAD_DEG = (0.0, 2.0, 0.0, 1.0, 4.0)  # closing fingers come together
_ALONG = np.linspace(0.0, 1.0, 13)  # where on a bone its distance is taken
_PIP_DEG = np.arange(0.0, 110.1, 1.0)
_THUMB_DEG = (np.arange(-15.0, 45.1, 5.0), np.arange(-12.5, 45.1, 2.5), np.arange(0.0, 55.1, 5.0))


def bar_in_palm(model: HandModel, radius_m: float) -> Float:
    """Return `T_palm_object` (4, 4) [m] of a bar of that radius in the closed hand.

    The bar's axis is its z.
    """
    axis = np.array([model.side_sign * np.cos(ASLANT), 0.0, np.sin(ASLANT)])
    rotation = np.stack([np.cross([0.0, 1.0, 0.0], axis), [0.0, 1.0, 0.0], axis], axis=1)
    _, y, z = model.rest_position_m[MIDDLE_PROXIMAL].tolist()
    phalanx_m = float(np.linalg.norm(model.bone_m[2, 0]))
    along_hand = 1.04  # how far the bar's middle is from the wrist, against the middle knuckle
    below_knuckles = 0.92  # how far its back lies below that, in lengths of the middle finger's first phalanx
    return rigid(rotation, np.array([0.0, y - below_knuckles * phalanx_m - radius_m, along_hand * z]))


def gaps_m(model: HandModel, angles_rad: Float, T_palm_object: Float, radius_m: float) -> Float:
    """Return the gap (..., 5, 3) [m] between each phalanx's skin and a long bar.

    At angles (..., 5, 4); negative: inside.
    """
    bones, girth = _phalanges(model, angles_rad)
    return _clear_of(bones, girth, T_palm_object, radius_m).min(axis=-1)


def closed_round(
    model: HandModel, T_palm_object: Float, radius_m: float, wobble: Float, mcp_per_pip: Float
) -> Float:
    """Posture (5, 3) [deg] in which all fingers touch the bar.

    Args:
        model: The hand.
        T_palm_object: (4, 4) where the bar lies [m].
        radius_m: Its radius.
        wobble: (5, 4) that `angles_of` is given with this posture.
        mcp_per_pip: (4,) by how much the knuckles flex as index to little finger close.
    """
    posture = np.zeros((len(_PIP_DEG), 5, 3))
    posture[..., 0] = SPREAD_DEG
    posture[:, 1:, 1], posture[..., 2] = _PIP_DEG[:, None] * mcp_per_pip, _PIP_DEG[:, None]
    air = gaps_m(model, angles_of(model, posture, wobble), T_palm_object, radius_m).min(axis=-1)
    closed = np.zeros((5, 3))
    closed[:, 0] = SPREAD_DEG
    for finger in range(1, 5):
        last = int(np.logical_and.accumulate(air[:, finger] >= 0.0).sum()) - 1
        before, after = air[max(last, 0), finger], air[min(last + 1, len(air) - 1), finger]
        more = before / (before - after) if after < 0.0 < before else 0.0
        pip = _PIP_DEG[max(last, 0)] + more * (_PIP_DEG[1] - _PIP_DEG[0])
        closed[finger, 1:] = pip * mcp_per_pip[finger - 1], pip
    closed[0] = _thumb(model, closed, T_palm_object, radius_m, wobble)
    return closed


def _thumb(
    model: HandModel, fingers_deg: Float, T_palm_object: Float, radius_m: float, wobble: Float
) -> Float:
    """Return the thumb's posture (3,) [deg] in which it touches the bar.

    It lies on the fingers at most, its tip below the palm.
    """
    grid = np.stack(np.meshgrid(*_THUMB_DEG, indexing="ij"), axis=-1).reshape(-1, 3)
    posture = np.tile(fingers_deg, (len(grid), 1, 1))
    posture[:, 0] = grid
    angles = angles_of(model, posture, wobble)
    bones, girth = _phalanges(model, angles)
    to_bar = _clear_of(bones[:, 0], girth[:, 0], T_palm_object, radius_m).min(axis=(-1, -2))
    # near
    near = np.argsort(np.abs(to_bar))[:200]
    own, own_girth = (
        bones[near, 0, 1:].reshape(len(near), -1, 1, 3),
        girth[near, 0, 1:].reshape(len(near), -1, 1),
    )
    others, other_girth = bones[0, 1:].reshape(-1, 3), girth[0, 1:].ravel()
    to_fingers = (np.linalg.norm(own - others, axis=-1) - own_girth - other_girth).min(axis=(1, 2))
    touches_m, pressed_m, across_m = 0.0012, 0.0010, 0.012
    out = np.maximum(np.abs(to_bar[near]) - touches_m, 0.0) + np.maximum(-pressed_m - to_fingers, 0.0)
    tip = np.abs(bones[near, 0, 2, -1, 0] - across_m * model.side_sign)
    return grid[near[int((tip + 100.0 * out).argmin())]]


def _phalanges(model: HandModel, angles_rad: Float) -> tuple[Float, Float]:
    """Return points (..., 5, 3, n, 3) [m] along the phalanges, and their radii.

    Palm frame; the fingers' radius there is (..., 5, 3, n).
    """
    joints = model.chains(angles_rad).position_m
    radius = np.broadcast_to(model.radius_m[CHAINS], joints.shape[:-1])
    return _thick(
        np.stack([joints[..., :-1, :], joints[..., 1:, :]], axis=-2),
        np.stack([radius[..., :-1], radius[..., 1:]], axis=-1),
    )


def _thick(ends: Float, radius_m: Float) -> tuple[Float, Float]:
    """Return points (..., n, 3) along bones and their radii (..., n).

    Bones have ends (..., 2, 3); the radii follow from those at the ends (..., 2).
    """
    along = _ALONG[:, None]
    points = (1.0 - along) * ends[..., :1, :] + along * ends[..., 1:, :]
    return points, (1.0 - _ALONG) * radius_m[..., :1] + _ALONG * radius_m[..., 1:]


def _clear_of(points: Float, girth: Float, T_palm_object: Float, radius_m: float) -> Float:
    """Air (...) [m] between balls at points (..., 3) and a long bar."""
    axis = T_palm_object[:3, 2]
    aside = points - T_palm_object[:3, 3]
    along = (aside @ axis)[..., None] * axis
    return np.linalg.norm(aside - along, axis=-1) - girth - radius_m
