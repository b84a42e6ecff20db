"""The flesh of one simulated hand: round cones on its bones, which differ from every plain model of it.

A solver models a finger as cones with the radii of the profile. Real fingers are not that: so each seed draws other
radii, adds the pads on the palmar side of every phalanx and the pulp at its tip, and gives the thumb its thenar. What
the palm carries stands still in the camera's frame; what a finger carries moves with its joints.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.hand_model import CHAINS, FINGERS, METACARPALS, WRIST, HandJoints, HandModel
from common.sim.wrist.cones import Cones

GROUPS = ("palm", *FINGERS, "thenar")
PALM_GROUP, THENAR_GROUP = 0, 6
THUMB_SEGMENTS, FINGER_SEGMENTS = (0, 1, 3), (1, 2, 3)  # by phalanx: 3 is the last of every finger

_RADIUS_SPREAD = 0.05  # of the radius of a joint, standard deviation: 95 % within a tenth
_PAD_M, _PULP_M = (0.0006, 0.0016), (0.0008, 0.0020)  # how far pads and pulps stand out of the cone


@dataclass(frozen=True, slots=True, eq=False)
class Flesh:
    """Round cones fixed to joints.

    Attributes:
        joint: (B,) joint whose frame carries the body; 1, the wrist, for the palm.
        start, stop: (B, 3) ends in that frame [m].
        start_radius_m, stop_radius_m: (B,) [m].
        group: (B,) index in GROUPS.
        segment: (B,) 0 palm or metacarpal, 1 proximal, 2 intermediate, 3 distal.
        tip: (5,) body that ends each finger.
        still: How many bodies, the first ones, belong to the palm.
    """

    joint: Int
    start: Float
    stop: Float
    start_radius_m: Float
    stop_radius_m: Float
    group: Int
    segment: Int
    tip: Int
    still: int

    @classmethod
    def of(cls, model: HandModel, seed: int) -> "Flesh":
        """Draw the flesh of one hand; the same seed, the same flesh."""
        rng = np.random.default_rng([seed, 21])
        radius = model.radius_m * np.clip(rng.normal(1.0, _RADIUS_SPREAD, 26), 0.88, 1.12)
        bodies = [*_palm(model, radius, rng)]
        still = len(bodies)
        tips: list[int] = []
        for finger in range(5):
            bodies += _finger(model, radius, finger, rng)
            tips.append(len(bodies) - 1)
        bodies += _thenar(model, radius, rng)
        joint, start, stop, r1, r2, group, segment = zip(*bodies, strict=True)
        return cls(
            np.array(joint),
            np.array(start),
            np.array(stop),
            np.array(r1),
            np.array(r2),
            np.array(group),
            np.array(segment),
            np.array(tips),
            still,
        )

    def bodies(self, joints: HandJoints) -> Cones:
        """Where they are, in the frame of the joints."""
        rotation, position = joints.rotation[self.joint], joints.position_m[self.joint]
        start = position + np.einsum("bij,bj->bi", rotation, self.start)
        stop = position + np.einsum("bij,bj->bi", rotation, self.stop)
        return Cones(start, stop, self.start_radius_m, self.stop_radius_m)

    def tips(self, bodies: Cones) -> tuple[Float, Float]:
        """The outermost points of the five fingers along their last bones (5, 3) [m], and those directions (5, 3)."""
        along = bodies.stop_m[self.tip] - bodies.start_m[self.tip]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        return bodies.stop_m[self.tip] + self.stop_radius_m[self.tip, None] * along, along


_Body = tuple[int, Float, Float, float, float, int, int]


def _finger(model: HandModel, radius: Float, finger: int, rng: np.random.Generator) -> list[_Body]:
    """Cones along the phalanges with a pad each; the last phalanx's own cone comes last."""
    segments = FINGER_SEGMENTS if finger else THUMB_SEGMENTS
    out: list[_Body] = []
    for k in range(3):
        near, far = CHAINS[finger, k], CHAINS[finger, k + 1]
        bone, group = model.bone_m[finger, k], finger + 1 if finger or k else THENAR_GROUP
        at = (group, segments[k])
        if finger or k:
            share, size, proud = ((0.25, 0.8), 0.9, _PAD_M) if k < 2 else ((0.3, 0.92), 0.88, _PULP_M)
            r1, r2 = size * radius[near], size * radius[far]
            palmar = np.array([0.0, -1.0, 0.0]) * (rng.uniform(*proud) + (1.0 - size) * radius[near])
            out.append((int(near), share[0] * bone + palmar, share[1] * bone + palmar, r1, r2, *at))
        out.append((int(near), np.zeros(3), bone, radius[near], radius[far], *at))
    return out


def _thenar(model: HandModel, radius: Float, rng: np.random.Generator) -> list[_Body]:
    """The ball of the thumb, which moves with its metacarpal."""
    bone, near = model.bone_m[0, 0], int(CHAINS[0, 0])
    ball = rng.uniform(0.95, 1.1) * radius[near]
    # Across the palm: towards the middle finger, in the frame of the thumb's metacarpal.
    inward = model.rest_rotation[near].T @ np.array([-model.side_sign, 0.0, 0.0])
    at = (THENAR_GROUP, 0)
    side = 0.009 * inward + np.array([0.0, rng.uniform(-0.003, -0.001), 0.0])
    return [
        (near, 0.05 * bone + side, 0.62 * bone + 0.6 * side, ball, 0.85 * ball, *at),
        (near, 0.1 * bone + 1.8 * side, 0.8 * bone + 1.6 * side, 0.85 * ball, 0.55 * ball, *at),
    ]


def _palm(model: HandModel, radius: Float, rng: np.random.Generator) -> list[_Body]:
    """Metacarpals, what fills the gaps between them, the heel on the side of the little finger, and the forearm."""
    place, wrist_turn = model.rest_position_m, model.rest_rotation[WRIST]
    roots = CHAINS[1:, 0]
    heads = place[roots]
    bases = place[list(METACARPALS)]
    out: list[_Body] = []

    def add(start: Float, stop: Float, r1: float, r2: float) -> None:
        # The wrist's joint frame carries the palm: palm frame -> that frame.
        out.append((WRIST, wrist_turn.T @ start, wrist_turn.T @ stop, r1, r2, PALM_GROUP, 0))

    thick = radius[list(METACARPALS)]
    for k in range(4):
        add(bases[k], heads[k], thick[k], 1.2 * radius[roots[k]])
    for k in range(3):
        r = 1.12 * 0.5 * (radius[roots[k]] + radius[roots[k + 1]])
        add(
            0.5 * (bases[k] + bases[k + 1]),
            0.5 * (heads[k] + heads[k + 1]),
            0.5 * (thick[k] + thick[k + 1]),
            r,
        )
    pads = np.array([0.0, -rng.uniform(0.002, 0.004), -0.004])
    for k in range(3):
        add(heads[k] + pads, heads[k + 1] + pads, radius[roots[k]], radius[roots[k + 1]])
    s = model.side_sign
    palmar = -rng.uniform(0.003, 0.006)
    heel = np.array([-0.017 * s, -0.010 + palmar, 0.012])
    add(heel, heads[3] + np.array([0.0, palmar, -0.016]), rng.uniform(0.012, 0.014), 0.0105)
    add(np.array([-0.008 * s, -0.004, -0.06]), np.array([-0.005 * s, -0.004, 0.004]), 0.021, 0.019)
    add(np.array([0.010 * s, -0.004, -0.06]), np.array([0.008 * s, -0.004, 0.012]), 0.021, 0.018)
    return out
