"""Round cones model a simulated hand and the things that it holds.

A solver models a finger as cones with the radii of the profile. Real fingers are not that: so each seed draws other
radii, adds the pads on the palmar side of every phalanx and the pulp at its tip, and gives the thumb its thenar. What
a finger carries moves with its joints; what the palm carries turns with the wrist alone, and while that is straight
it stands still in the camera's frame, as the end of the forearm always does. Held things are bodies after those of
the hand, matt and dark: they hide what is behind them from the camera, and keep the laser and the LEDs from it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from common.arrays import Float, Int
from common.geometry.tapered_capsules import Capsules
from common.hand.model import CHAINS, FINGERS, METACARPALS, WRIST, HandJoints, HandModel
from common.sim.motion import Cylinder

GROUPS = ("palm", *FINGERS, "thenar")
PALM_GROUP, THUMB_GROUP, THENAR_GROUP = 0, 1, 6
THING_GROUP = len(GROUPS)  # of what is no hand: bodies that follow those of the flesh
THUMB_SEGMENTS, FINGER_SEGMENTS = (0, 1, 3), (1, 2, 3)  # by phalanx: 3 is the last of every finger

_PAD_M, _PULP_M = (0.0002, 0.0010), (0.0006, 0.0016)  # how far pads and pulps stand out of the cone


@dataclass(frozen=True, slots=True, eq=False)
class HandCapsules:
    """Round cones fixed to joints.

    Attributes:
        joint: (B,) joint whose frame carries the body; 1, the wrist, for the palm.
        start, stop: (B, 3) ends in that frame [m].
        start_radius_m, stop_radius_m: (B,) [m].
        group: (B,) index in GROUPS.
        segment: (B,) 0 palm or metacarpal, 1 proximal, 2 intermediate, 3 distal.
        tip: (5,) body that ends each finger.
        thumb: (2,) bodies of the thumb's metacarpal and of the phalanx after it.
        forearm: (F,) bodies of the palm's group that a bent wrist does not turn.
        still: How many bodies, the first ones, belong to the palm and the forearm.
    """

    joint: Int
    start: Float
    stop: Float
    start_radius_m: Float
    stop_radius_m: Float
    group: Int
    segment: Int
    tip: Int
    thumb: Int
    forearm: Int
    still: int

    @classmethod
    def of(cls, model: HandModel, seed: int) -> "HandCapsules":
        """Draw the flesh of one hand; the same seed, the same flesh."""
        rng = np.random.default_rng([seed, 21])
        radius_spread = 0.05  # of the radius of a joint, standard deviation: 95 % within a tenth
        radius = (model.radius_m * np.clip(rng.normal(1.0, radius_spread, 26), 0.88, 1.12)).tolist()
        parts = _palm(model, radius, rng)
        still = len(parts)
        forearm_parts = 2
        forearm = np.arange(still, still + forearm_parts) - forearm_parts
        tips: list[int] = []
        for finger in range(5):
            parts += _finger(model, radius, finger, rng)
            tips.append(len(parts) - 1)
        parts += _thenar(model, radius, rng)
        columns: dict[str, Any] = {
            name: np.array([getattr(part, name) for part in parts]) for name in _Part._fields
        }
        thumb = np.array([still, still + 2])  # the phalanx's pad lies between them
        return cls(**columns, tip=np.array(tips), thumb=thumb, forearm=forearm, still=still)

    def bodies(self, joints: HandJoints, R_straight: Float | None = None) -> Capsules:
        """Return the bodies in the frame of the joints.

        Of a flexed wrist, `R_straight` (3, 3) is the rotation that its joint would have if it were straight:
        the forearm's.
        """
        rotation, position = joints.rotation[self.joint], joints.position_m[self.joint]
        if R_straight is not None:
            rotation[self.forearm] = R_straight
        start = position + np.einsum("bij,bj->bi", rotation, self.start)
        stop = position + np.einsum("bij,bj->bi", rotation, self.stop)
        return Capsules(start, stop, self.start_radius_m, self.stop_radius_m)

    def same_palm(self, bodies: Capsules, others: Capsules) -> bool:
        """Whether the palm is identical in two sets of bodies, to the last bit."""
        palm = slice(self.still)
        return np.array_equal(bodies.start_m[palm], others.start_m[palm]) and np.array_equal(
            bodies.stop_m[palm], others.stop_m[palm]
        )

    def group_of(self, body: Int) -> Int:
        """Groups of bodies (N,); THING_GROUP for those after its own."""
        last = len(self.group) - 1
        return np.where(body > last, THING_GROUP, self.group[np.minimum(body, last)])

    def parts(self, bodies: Capsules, body: Int, points: Float) -> tuple[Int, Int]:
        """Group and segment (N,) of lit points (N, 3) [m] of bodies (N,); a thing has 0.

        Where the thumb's ball and its phalanx run into each other, the plane that halves their angle parts
        them.
        """
        group = self.group_of(body)
        segment = np.where(group == THING_GROUP, 0, self.segment[np.minimum(body, len(self.segment) - 1)])
        axis = bodies.stop_m[self.thumb] - bodies.start_m[self.thumb]
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        beyond = (points - bodies.start_m[self.thumb[1]]) @ axis.sum(axis=0) > 0.0
        near = (group == THENAR_GROUP) | ((group == THUMB_GROUP) & (segment == THUMB_SEGMENTS[1]))
        group = np.where(near, np.where(beyond, THUMB_GROUP, THENAR_GROUP), group)
        return group, np.where(near, np.where(beyond, THUMB_SEGMENTS[1], THUMB_SEGMENTS[0]), segment)

    def tips(self, bodies: Capsules) -> Float:
        """Outermost skin points (5, 3) [m] along the last bones of the five fingers."""
        along = bodies.stop_m[self.tip] - bodies.start_m[self.tip]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        return bodies.stop_m[self.tip] + self.stop_radius_m[self.tip, None] * along


class _Part(NamedTuple):
    """One body: joint, ends (3,) in its frame [m], radii [m], group, segment."""

    joint: int
    start: Float
    stop: Float
    start_radius_m: float
    stop_radius_m: float
    group: int
    segment: int


def _finger(model: HandModel, radius: list[float], finger: int, rng: np.random.Generator) -> list[_Part]:
    """The cones along the phalanges, with a pad each; the last one's own comes last."""
    segments = FINGER_SEGMENTS if finger else THUMB_SEGMENTS
    out: list[_Part] = []
    for k in range(3):
        near, far = int(CHAINS[finger, k]), int(CHAINS[finger, k + 1])
        bone = model.bone_m[finger, k]
        group = finger + 1 if finger or k else THENAR_GROUP
        if group != THENAR_GROUP:
            low, high, proud = (0.3, 0.92, _PULP_M) if k == 2 else (0.25, 0.8, _PAD_M)
            palmar, r1, r2 = np.array([0.0, -rng.uniform(*proud), 0.0]), radius[near], radius[far]
            out.append(_Part(near, low * bone + palmar, high * bone + palmar, r1, r2, group, segments[k]))
        out.append(_Part(near, np.zeros(3), bone, radius[near], radius[far], group, segments[k]))
    return out


def _thenar(model: HandModel, radius: list[float], rng: np.random.Generator) -> list[_Part]:
    """The ball of the thumb, which moves with its metacarpal."""
    bone, near = model.bone_m[0, 0], int(CHAINS[0, 0])
    ball = rng.uniform(0.95, 1.1) * radius[near]
    # Across the palm: towards the middle finger, in the frame of the thumb's metacarpal.
    inward = model.rest_rotation[near].T @ np.array([-model.side_sign, 0.0, 0.0])
    side = 0.009 * inward + np.array([0.0, rng.uniform(-0.003, -0.001), 0.0])
    deep = np.array([0.0, 0.004, 0.0])
    ends = (
        (0.05 * bone + side, 0.62 * bone + 0.6 * side, ball, 0.85 * ball),
        (0.1 * bone + 1.8 * side, 0.75 * bone + 1.5 * side, 0.9 * ball, 0.65 * ball),
        (0.2 * bone + 2.6 * side + deep, 0.7 * bone + 2.3 * side + deep, 0.8 * ball, 0.6 * ball),
    )
    return [_Part(near, *end, THENAR_GROUP, 0) for end in ends]


def _palm(model: HandModel, radius: list[float], rng: np.random.Generator) -> list[_Part]:
    """Metacarpals, fillings between them, mounds before the fingers, heel, forearm."""
    place, wrist_rotation, s = model.rest_position_m, model.rest_rotation[WRIST], model.side_sign
    roots = CHAINS[1:, 0]
    heads, bases = place[roots], place[list(METACARPALS)]
    head_m, base_m = 1.15 * np.array(radius)[roots], np.array(radius)[list(METACARPALS)]
    out: list[_Part] = []

    def add(start: Float, stop: Float, r1: float, r2: float) -> None:
        # The frame of the wrist's joint is turned to the palm's, and does not move in it.
        ends = wrist_rotation.T @ start, wrist_rotation.T @ stop
        out.append(_Part(WRIST, *ends, float(r1), float(r2), PALM_GROUP, 0))

    for k in range(4):
        add(bases[k], heads[k], base_m[k], head_m[k])
    mound, web = np.array([0.0, -rng.uniform(0.002, 0.004), -0.004]), np.array([0.0, -0.001, 0.009])
    for k in range(3):
        j = k + 1
        base, head = 0.5 * (bases[k] + bases[j]), 0.5 * (heads[k] + heads[j])
        add(base, head, 0.5 * (base_m[k] + base_m[j]), head_m[k])
        add(heads[k] + mound, heads[j] + mound, 0.87 * head_m[k], 0.87 * head_m[j])
        add(heads[k] + web, heads[j] + web, 0.75 * head_m[k], 0.75 * head_m[j])
    thick = -rng.uniform(0.003, 0.006)
    heel = np.array([-0.017 * s, thick - 0.010, 0.012])
    add(heel, heads[3] + np.array([0.0, thick, -0.016]), rng.uniform(0.012, 0.014), 0.0105)
    for side in (-0.008, 0.010):  # the last two bodies are the forearm
        add(np.array([side * s, -0.004, -0.06]), np.array([0.7 * side * s, -0.004, 0.008]), 0.021, 0.0185)
    return out


ALBEDO = 0.05  # of matt black coating or rubber in the near infrared, against usual skin


def bodies_of(things: Sequence[Cylinder], T_camera_rig: Float) -> Capsules:
    """Round cones of equal radii that stand for closed cylinders, camera frame.

    Their round ends hold as much as the flat ones: a hand that holds one in its middle touches none of them.

    Raises:
        ValueError: One is wider than long; it would be a ball.
    """
    for one in things:
        if one.length_m < 2.0 * one.radius_m:
            raise ValueError(
                f"cylinder of {one.length_m} m: shorter than its width of {2.0 * one.radius_m} m"
            )
    radius = np.array([one.radius_m for one in things])
    T = np.array([T_camera_rig @ one.T_rig_object for one in things])
    # 4/3 pi r^3 are in the ends
    half = (0.5 * np.array([one.length_m for one in things]) - 2.0 / 3.0 * radius)[:, None] * T[:, :3, 2]
    return Capsules(T[:, :3, 3] - half, T[:, :3, 3] + half, radius, radius)
