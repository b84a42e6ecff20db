"""A simulated hand closes round a bar, lifts it, rotates it, puts it back.

The bar lies in the hooked fingers, across the hand and a little aslant, as that of a bucket or a drawer. Index to
little finger close as fingers do, the knuckle by a fixed share of the middle joint, until the first of their bones
meets the bar; the thumb closes over it from the other side, its tip across the palm. Bones are round cones with the
radii of the profile.

Five times a minute the hand comes from below with open fingers until the bar lies before them, and closes; palm and
fingers then hide the finger tips from cameras that see the back of the hand. It lifts the bar, turns it briskly in
the picture and towards the cameras, lowers it to its old place, opens and goes back. Place, pace, turns and postures
are drawn from the seed. While the bar is held it follows the palm, else it lies still; the hand stands still to the
bar whenever its skin touches it. The wrist is a little flexed round the bar, and bends by up to 7 degrees either way
about that and by up to 8 to the sides while the bar is turned; by 3 either way else.
"""

from typing import NamedTuple

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, MIDDLE_PROXIMAL, HandModel
from common.sim.motion import (
    PERIOD_S,
    REST,
    Cylinder,
    DriftingMotion,
    HandState,
    Waves,
    angles_of,
    base_pose,
    posture_of,
    smooth_step,
    window,
)

MCP_PER_PIP = 0.54  # Kamper's ratio, in Kim et al. 2012
ASLANT = np.radians(15.0)  # further from the wrist on the side of the thumb
SPREAD_DEG = (0.0, 2.0, 0.0, 1.0, 4.0)  # closing fingers come together
_ALONG = np.linspace(0.0, 1.0, 13)  # where on a bone its distance is taken
_PIP_DEG = np.arange(0.0, 110.1, 1.0)
_THUMB_DEG = (np.arange(-15.0, 45.1, 5.0), np.arange(-12.5, 45.1, 2.5), np.arange(0.0, 55.1, 5.0))


def bar_in_palm(model: HandModel, radius_m: float) -> Float:
    """Return `T_palm_object` (4, 4) [m] of a bar (axis z) in the closed hand."""
    axis = np.array([model.side_sign * np.cos(ASLANT), 0.0, np.sin(ASLANT)])
    rotation = np.stack([np.cross([0.0, 1.0, 0.0], axis), [0.0, 1.0, 0.0], axis], axis=1)
    _, y, z = model.rest_position_m[MIDDLE_PROXIMAL].tolist()
    phalanx_m = float(np.linalg.norm(model.bone_m[2, 0]))
    along_hand = 1.04  # how far the bar's middle is from the wrist, against the middle knuckle
    below_knuckles = 0.92  # how far its back lies below that, in lengths of the middle finger's first phalanx
    return rigid(rotation, np.array([0.0, y - below_knuckles * phalanx_m - radius_m, along_hand * z]))


def gaps_m(model: HandModel, angles_rad: Float, T_palm_object: Float, radius_m: float) -> Float:
    """Gap (..., 5, 3) [m] between each phalanx and a long bar; negative: inside."""
    bones, girth = _phalanges(model, angles_rad)
    return _clear_of(bones, girth, T_palm_object, radius_m).min(axis=-1)


def closed_round(
    model: HandModel, T_palm_object: Float, radius_m: float, wobble: Float, mcp_per_pip: Float
) -> Float:
    """Posture (5, 3) [deg] in which all fingers touch the bar.

    Args:
        T_palm_object: (4, 4) where the bar lies [m].
        wobble: (5, 4) that `angles_of` is given with this posture.
        mcp_per_pip: (4,) by how much the knuckles flex as index to little finger close.
    """
    posture = np.zeros((len(_PIP_DEG), 5, 3))
    posture[..., 0] = SPREAD_DEG
    posture[:, 1:, 1], posture[..., 2] = _PIP_DEG[:, None] * mcp_per_pip, _PIP_DEG[:, None]
    air = gaps_m(model, angles_of(model, posture, wobble), T_palm_object, radius_m).min(axis=-1)
    closed = posture[0].copy()
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
    """Thumb's posture (3,) [deg]: touches the bar, tip below the palm."""
    grid = np.stack(np.meshgrid(*_THUMB_DEG, indexing="ij"), axis=-1).reshape(-1, 3)
    posture = np.tile(fingers_deg, (len(grid), 1, 1))
    posture[:, 0] = grid
    angles = angles_of(model, posture, wobble)
    bones, girth = _phalanges(model, angles)
    to_bar = _clear_of(bones[:, 0], girth[:, 0], T_palm_object, radius_m).min(axis=(-1, -2))
    near = np.argsort(np.abs(to_bar))[:200]
    own = bones[near, 0, 1:].reshape(len(near), -1, 1, 3)
    own_girth = girth[near, 0, 1:].reshape(len(near), -1, 1)
    others, other_girth = bones[0, 1:].reshape(-1, 3), girth[0, 1:].ravel()
    to_fingers = (np.linalg.norm(own - others, axis=-1) - own_girth - other_girth).min(axis=(1, 2))
    touches_m, pressed_m, across_m = 0.0012, 0.0010, 0.012
    out = np.maximum(np.abs(to_bar[near]) - touches_m, 0.0) + np.maximum(-pressed_m - to_fingers, 0.0)
    tip = np.abs(bones[near, 0, 2, -1, 0] - across_m * model.side_sign)
    return grid[near[int((tip + 100.0 * out).argmin())]]


def _phalanges(model: HandModel, angles_rad: Float) -> tuple[Float, Float]:
    """Points (..., 5, 3, n, 3) [m] along the phalanges, palm frame, and their radii."""
    joints = model.chains(angles_rad).position_m
    radius = np.broadcast_to(model.radius_m[CHAINS], joints.shape[:-1])[..., None]
    along = _ALONG[:, None]
    points = (1.0 - along) * joints[..., :-1, None, :] + along * joints[..., 1:, None, :]
    return points, (1.0 - _ALONG) * radius[..., :-1, :] + _ALONG * radius[..., 1:, :]


def _clear_of(points: Float, girth: Float, T_palm_object: Float, radius_m: float) -> Float:
    """Air (...) [m] between balls at points (..., 3) and a long bar."""
    axis = T_palm_object[:3, 2]
    aside = points - T_palm_object[:3, 3]
    along = (aside @ axis)[..., None] * axis
    return np.linalg.norm(aside - along, axis=-1) - girth - radius_m


ROUNDS = 5
ROUND_S = PERIOD_S / ROUNDS


class GraspTiming(NamedTuple):
    """Times [s] since the beginning of a round of grasping, before its pace."""

    leave_s: float = 0.8
    arrive_s: float = 2.4
    closed_s: float = 3.3
    lift_s: float = 3.7
    lifted_s: float = 4.8
    lower_s: float = 8.4
    release_s: float = 9.8
    open_s: float = 10.5
    back_s: float = 11.8


TIMING = GraspTiming()
PACE = (0.92, 1.0)
LIFT_M = (0.08, 0.12)
PLACE_M = np.array([0.025, 0.015, 0.02])  # half of the box of places, rig axes
COMES_M = np.array([0.015, 0.0, -0.13])  # from there, palm axes
# of the whole hand: fingers and thumb a little away from the cameras
LEAN_DEG = np.array([-26.0, -10.0, 0.0])
SWAY_DEG, SWING_DEG = np.array([3.0, 3.0]), np.array([4.0, 5.0])  # flexion, deviation
_OPEN = posture_of((30, -8, 0), (3, 4, 5), (0, 4, 5), (-3, 4, 5), (-6, 4, 5))


class Grasp(DriftingMotion):
    """Five grasps in 60 s; `pace` (ROUNDS,) multiplies the times of each."""

    def __init__(self, model: HandModel, centre_m: Float, seed: int, radius_m: float = 0.012) -> None:
        """Write the script and close the hand (some 0.1 s)."""
        rng = np.random.default_rng([seed, 17])
        super().__init__(model, centre_m, rng)
        self._radius_m, self._sway = radius_m, Waves(rng, 2)
        up_m = 0.035  # of the bar above the middle of the view
        self._centre = self._centre + (rng.uniform(-1.0, 1.0, 3) * PLACE_M - np.array([0.0, up_m, 0.0]))
        self._rest = REST + rng.normal(0.0, (1.0, 2.0, 3.0), (5, 3))
        self._comes = COMES_M + rng.uniform(-0.01, 0.01, 3) * np.array([1.0, 0.0, 1.0])
        self.pace = rng.uniform(*PACE, ROUNDS)
        self._lift_m = rng.uniform(*LIFT_M, ROUNDS)
        self._first = rng.integers(0, 2, ROUNDS)  # which of the two turns comes first
        self._sign = rng.choice((-1.0, 1.0), (ROUNDS, 2))
        self._grip_wobble = np.zeros((5, 4))
        self._grip_wobble[:, 3] = rng.uniform(-0.5, 0.5, 5)
        self._lean = np.radians(LEAN_DEG) * np.array([1.0, model.side_sign, 1.0])
        mcp_per_pip = MCP_PER_PIP * (1.0 + rng.normal(0.0, 0.06, 4))
        self._T_palm_object = bar_in_palm(model, radius_m)
        self._grip = closed_round(model, self._T_palm_object, radius_m, self._grip_wobble, mcp_per_pip)
        self._T_grip = base_pose(model, self._centre, np.zeros(3), self._lean)

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        t = max(t_s, 0.0) % PERIOD_S
        wobble, shift, rotation = self._drift_at(t)
        k = min(int(t / ROUND_S), ROUNDS - 1)
        s = (t - k * ROUND_S) / float(self.pace[k])  # at a round's full length
        near = _between(s, TIMING.leave_s, TIMING.arrive_s, TIMING.open_s, TIMING.back_s)
        ready = _between(s, TIMING.leave_s, TIMING.arrive_s - 0.5, TIMING.open_s + 0.3, TIMING.back_s)
        closed = _between(s, TIMING.arrive_s, TIMING.closed_s, TIMING.release_s, TIMING.open_s)
        lowered_s = 9.5
        lifted = _between(s, TIMING.lift_s, TIMING.lifted_s, TIMING.lower_s, lowered_s)
        posture = self._rest + ready * (_OPEN - self._rest) + closed * (self._grip - _OPEN)
        angles = angles_of(self._model, posture, wobble + closed * (self._grip_wobble - wobble))
        still_s = 0.5  # in which the hand comes to stand still, and moves again
        still = window(s, TIMING.arrive_s - still_s, TIMING.lift_s + still_s, still_s)
        still += window(s, lowered_s - still_s, TIMING.open_s + still_s, still_s)
        side = np.array([self._model.side_sign, 1.0, 1.0])
        comes = self._T_grip[:3, :3] @ ((1.0 - near) * side * self._comes)
        place = comes + (1.0 - still) * shift - lifted * np.array([0.0, self._lift_m[k], 0.0])
        swung, swing = self._rotation_and_swing(k, s)
        turned = self._lean + swung + (1.0 - still) * rotation
        pose = base_pose(self._model, self._centre, place, turned)
        held = TIMING.closed_s <= s < TIMING.release_s
        bar = (pose if held else self._T_grip) @ self._T_palm_object
        flexed_deg, bar_length_m = 3.0, 0.18
        wrist_angles = np.radians(
            SWAY_DEG * self._sway.at(max(t_s, 0.0)) + swing + near * np.array([flexed_deg, 0.0])
        )
        return HandState(pose, angles, wrist_angles, (Cylinder(bar, self._radius_m, bar_length_m, held),))

    def _rotation_and_swing(self, k: int, s: float) -> tuple[Float, Float]:
        """Palm rotation (3,) [rad], rig axes, and wrist flexion (2,) [deg] of round `k`."""
        rotation, swing = np.zeros(3), np.zeros(2)
        for place in (0, 1):
            rotation_s, rotation_fade_s = 1.7, 0.3
            start = TIMING.lifted_s + 0.1 + place * rotation_s
            if not start < s < start + rotation_s:
                continue
            which = int(self._first[k]) ^ place
            inside = window(s, start, start + rotation_s, rotation_fade_s)
            swung = self._sign[k, place] * inside * np.sin(2.0 * np.pi * (s - start) / rotation_s)
            rotation_deg = 25.0
            rotation[(2, 0)[which]] = np.radians(rotation_deg) * swung
            swing[(1, 0)[which]] = SWING_DEG[(1, 0)[which]] * swung
        return rotation, swing


def _between(s: float, up: float, top: float, down: float, bottom: float) -> float:
    """0 before `up`, 1 from `top` to `down`, 0 after `bottom`, smooth (C2)."""
    return smooth_step((s - up) / (top - up)) * smooth_step((bottom - s) / (bottom - down))
