"""How a hand closes round a bar: where the bar lies in the palm, and the angles at which each finger meets it.

The bar lies across the palm below the knuckles, a little aslant as in every power grip, and touches the skin over the
metacarpals. A finger flexes in two joints (its last one follows the middle one), so two of its bones meet the bar;
the thumb, which has three, closes over the fingers, near to the bar and out of sight from behind the hand. Bones are
round cones with the radii of the profile.
"""

import numpy as np

from common.arrays import Float
from common.geometry import rigid
from common.hand_model import CHAINS, METACARPALS, MIDDLE_PROXIMAL, HandModel
from common.sim.motion import angles_of

ALONG_PALM = 0.81  # where the bar's middle lies between wrist and middle knuckle
ASLANT = np.radians(15.0)  # further from the wrist on the side of the thumb
FLESH_M = 0.0025  # over the metacarpals
SPREAD_DEG = (0.0, 3.0, 0.0, -3.0, -6.0)
_ALONG = np.linspace(0.0, 1.0, 13)  # where on a bone its distance is taken
_MCP_DEG, _PIP_DEG = np.arange(10.0, 90.1, 1.0), np.arange(0.0, 110.1, 2.0)
_THUMB_DEG = (np.arange(-10.0, 45.1, 5.0), np.arange(-15.0, 45.1, 2.5), np.arange(0.0, 55.1, 5.0))
_NEAR, _TOUCHES_M, _PRESSED_M = 200, 0.0012, 0.0010


def bar_in_palm(model: HandModel, radius_m: float) -> Float:
    """`T_palm_object` (4, 4) [m] of a bar of that radius in the palm; its axis is its z."""
    side = model.side_sign
    axis = np.array([side * np.cos(ASLANT), 0.0, np.sin(ASLANT)])
    rotation = np.stack([np.cross([0.0, 1.0, 0.0], axis), [0.0, 1.0, 0.0], axis], axis=1)
    root, head = list(METACARPALS), CHAINS[1:, 0]
    bones, girth = _thick(
        np.stack([model.rest_position_m[root], model.rest_position_m[head]], axis=1),
        np.stack([model.radius_m[root], model.radius_m[head]], axis=1),
    )
    middle = np.array([0.0, 0.0, ALONG_PALM * model.rest_position_m[MIDDLE_PROXIMAL, 2]])
    reach = girth + radius_m + FLESH_M
    aside = bones - middle
    aside = aside - (aside @ axis)[..., None] * axis
    # The bar goes down along -y until no bone reaches into it: (aside_y - y)^2 + across^2 = reach^2.
    across2 = (aside**2).sum(axis=-1) - aside[..., 1] ** 2
    deep = aside[..., 1] - np.sqrt(np.maximum(reach**2 - across2, 0.0))
    middle[1] = float(np.where(across2 < reach**2, deep, np.inf).min())
    return rigid(rotation, middle)


def gaps_m(model: HandModel, angles_rad: Float, T_palm_object: Float, radius_m: float) -> Float:
    """Air (..., 5, 3) [m] between the skin of each phalanx and a long bar, of angles (..., 5, 4); negative: inside."""
    bones, girth = _phalanges(model, angles_rad)
    return _clear_of(bones, girth, T_palm_object, radius_m).min(axis=-1)


def closed_round(model: HandModel, T_palm_object: Float, radius_m: float, wobble: Float) -> Float:
    """Posture (5, 3) [deg] in which all fingers touch the bar, where `angles_of` is given this `wobble` (5, 4).

    Of all flexions of its knuckle a finger takes the one in which it then meets the bar with two bones most closely.
    """
    count = len(_MCP_DEG), len(_PIP_DEG)
    posture = np.zeros((*count, 5, 3))
    posture[..., 0] = SPREAD_DEG
    posture[..., 1] = _MCP_DEG[:, None, None]
    posture[..., 2] = _PIP_DEG[:, None]
    gap = gaps_m(model, angles_of(model, posture, wobble), T_palm_object, radius_m)
    least = gap.min(axis=-1)  # MCP, PIP, finger
    free = np.logical_and.accumulate(least >= 0.0, axis=1)
    best = np.zeros((5, 3))
    best[:, 0] = SPREAD_DEG
    for finger in range(1, 5):
        last = free[..., finger].sum(axis=1) - 1
        two = np.sort(gap[np.arange(count[0]), last, finger], axis=-1)[:, :2].sum(axis=-1)
        mcp = int(np.where(last >= 0, two, np.inf).argmin())
        at = int(last[mcp])
        before, after = least[mcp, at, finger], least[mcp, min(at + 1, count[1] - 1), finger]
        more = before / (before - after) if after < 0.0 else 0.0
        best[finger, 1:] = _MCP_DEG[mcp], _PIP_DEG[at] + more * (_PIP_DEG[1] - _PIP_DEG[0])
    best[0] = _thumb(model, best, T_palm_object, radius_m, wobble)
    return best


def _thumb(
    model: HandModel, fingers_deg: Float, T_palm_object: Float, radius_m: float, wobble: Float
) -> Float:
    """The thumb's posture (3,) [deg]: touches the bar, lies on the fingers at most, its tip far across the palm."""
    grid = np.stack(np.meshgrid(*_THUMB_DEG, indexing="ij"), axis=-1).reshape(-1, 3)
    posture = np.tile(fingers_deg, (len(grid), 1, 1))
    posture[:, 0] = grid
    angles = angles_of(model, posture, wobble)
    bones, girth = _phalanges(model, angles)
    to_bar = _clear_of(bones[:, 0], girth[:, 0], T_palm_object, radius_m).min(axis=(-1, -2))
    near = np.argsort(np.abs(to_bar))[:_NEAR]
    own, own_girth = (
        bones[near, 0, 1:].reshape(len(near), -1, 1, 3),
        girth[near, 0, 1:].reshape(len(near), -1, 1),
    )
    others, other_girth = bones[0, 1:].reshape(-1, 3), girth[0, 1:].ravel()
    to_fingers = (np.linalg.norm(own - others, axis=-1) - own_girth - other_girth).min(axis=(1, 2))
    out = np.maximum(np.abs(to_bar[near]) - _TOUCHES_M, 0.0) + np.maximum(-_PRESSED_M - to_fingers, 0.0)
    tip = bones[near, 0, 2, -1, 0] * model.side_sign
    return grid[near[int((tip + 100.0 * out).argmin())]]


def _phalanges(model: HandModel, angles_rad: Float) -> tuple[Float, Float]:
    """Points (..., 5, 3, n, 3) [m] along the phalanges, palm frame, and the fingers' radius there (..., 5, 3, n)."""
    joints = model.chains(angles_rad).position_m
    radius = np.broadcast_to(model.radius_m[CHAINS], joints.shape[:-1])
    return _thick(
        np.stack([joints[..., :-1, :], joints[..., 1:, :]], axis=-2),
        np.stack([radius[..., :-1], radius[..., 1:]], axis=-1),
    )


def _thick(ends: Float, radius_m: Float) -> tuple[Float, Float]:
    """Points (..., n, 3) along bones with ends (..., 2, 3), and their radii (..., n) of those at the ends (..., 2)."""
    along = _ALONG[:, None]
    points = (1.0 - along) * ends[..., :1, :] + along * ends[..., 1:, :]
    return points, (1.0 - _ALONG) * radius_m[..., :1] + _ALONG * radius_m[..., 1:]


def _clear_of(points: Float, girth: Float, T_palm_object: Float, radius_m: float) -> Float:
    """Air (...) [m] between balls at points (..., 3) and a long bar."""
    axis = T_palm_object[:3, 2]
    aside = points - T_palm_object[:3, 3]
    along = (aside @ axis)[..., None] * axis
    return np.linalg.norm(aside - along, axis=-1) - girth - radius_m
