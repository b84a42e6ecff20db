"""A limited chain of bones, for the solvers: rest turns, joints and bone vectors, and its forward kinematics.

Everything is in the chain's root frame, its first joint at the origin. Link k turns from its parent's frame by
the fixed `turn`, then by its joint's Q(angles), and its bone leads to joint k + 1:

    O_k = O_{k-1} turn_k Q_k          p_{k+1} = p_k + O_k bone_k
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.hand_model import CHAINS, HandModel
from master.ik.joints import Angles, Hinge, Joint, Rotor
from master.ik.vectors import IDENTITY, Matrix, Vector, as_matrix, as_vector, length, product, rotate

THUMB = 0


@dataclass(frozen=True, slots=True)
class Link:
    """One joint and the bone behind it.

    Attributes:
        turn: Rest orientation in the parent's frame (`world` joints: in the root frame).
        joint: What it allows.
        bone: To the next joint, in the joint's own frame [m].
    """

    turn: Matrix
    joint: Joint
    bone: Vector


@dataclass(frozen=True, slots=True)
class Coupling:
    """A hinge that follows another: angle[follower] = ratio * angle[leader], within its own limits."""

    leader: int
    follower: int
    ratio: float


@dataclass(frozen=True, slots=True)
class Chain:
    """Links from the root to the end effector, and an optional coupling of two hinges."""

    links: tuple[Link, ...]
    coupling: Coupling | None = None

    def __post_init__(self) -> None:
        if not self.links:
            raise ValueError("a chain needs a link")
        c = self.coupling
        if c is not None:
            hinges = [isinstance(link.joint, Hinge) for link in self.links]
            if not 0 <= c.leader < c.follower < len(hinges) or not (hinges[c.leader] and hinges[c.follower]):
                raise ValueError(
                    f"a coupling leads from a hinge to a later one, not {c.leader} to {c.follower}"
                )

    @property
    def lengths(self) -> tuple[float, ...]:
        """Bone lengths [m]."""
        return tuple(length(link.bone) for link in self.links)

    @property
    def root_sign(self) -> float:
        """Sense of the first joint's abduction; +1 for a hinge."""
        joint = self.links[0].joint
        return joint.sign if isinstance(joint, Rotor) else 1.0

    @property
    def spans(self) -> tuple[tuple[float, float], ...]:
        """Low and high of every angle of every joint, in order [rad]; the abduction's where nothing narrows it."""
        spans: list[tuple[float, float]] = []
        for link in self.links:
            joint = link.joint
            if isinstance(joint, Rotor):
                spans += [joint.abduction_rad, joint.flexion_rad]
            else:
                spans.append((joint.low_rad, joint.high_rad))
        return tuple(spans)

    def rest_frame(self, k: int, orientations: list[Matrix]) -> Matrix:
        """Frame in which joint k's angles are measured, given the orientations of the links before it."""
        link = self.links[k]
        if k == 0 or link.joint.frame == "world":
            return link.turn
        return product(orientations[k - 1], link.turn)

    def clamp(self, angles: tuple[Angles, ...]) -> tuple[Angles, ...]:
        """The nearest legal angles, coupling obeyed."""
        legal = [link.joint.clamp(a) for link, a in zip(self.links, angles, strict=True)]
        c = self.coupling
        if c is not None:
            legal[c.follower] = self.links[c.follower].joint.clamp((c.ratio * legal[c.leader][0],))
        return tuple(legal)

    def forward(self, angles: tuple[Angles, ...]) -> tuple[list[Vector], list[Matrix]]:
        """Joint positions (links + 1, root first) [m] and link orientations, root frame."""
        position: Vector = (0.0, 0.0, 0.0)
        positions, orientations = [position], list[Matrix]()
        for k, link in enumerate(self.links):
            orientation = product(self.rest_frame(k, orientations), link.joint.rotation(angles[k]))
            x, y, z = rotate(orientation, link.bone)
            position = (position[0] + x, position[1] + y, position[2] + z)
            orientations.append(orientation)
            positions.append(position)
        return positions, orientations


def finger_chain(model: HandModel, finger: int, offset_m: Float, *, coupled: bool = True) -> Chain:
    """The chain of one finger in the palm frame's axes, from MCP (thumb: CMC) to a point fixed to the tip joint.

    Args:
        model: The hand.
        finger: 0 thumb ... 4 little.
        offset_m: End effector (3,) in the tip joint's frame [m]; zero: the tip joint itself.
        coupled: Whether the DIP follows the PIP where the model keeps their ratio exactly (never for the thumb).
    """
    limits = [(float(low), float(high)) for low, high in model.limits_rad[finger]]
    rest = as_matrix(model.rest_rotation[CHAINS[finger, 0]])
    turn, bone = model.turn[finger], model.bone_m[finger]
    thumb = finger == THUMB
    root = Rotor(
        limits[0],
        limits[1],
        spread_at_full_flexion=float(model.spread_at_full_flexion[finger]),
        sign=model.side_sign,
        rest=IDENTITY if thumb else rest,
    )
    last = bone[2] + turn[2] @ np.asarray(offset_m, dtype=np.float64)
    links = (
        Link(rest if thumb else IDENTITY, root, as_vector(bone[0])),
        Link(as_matrix(turn[0]), Hinge(*limits[2]), as_vector(bone[1])),
        Link(as_matrix(turn[1]), Hinge(*limits[3]), as_vector(last)),
    )
    ratio = model.dip_per_pip
    if not coupled or thumb or ratio is None or model.dip_spread_rad > 0.0:
        return Chain(links)
    return Chain(links, Coupling(1, 2, ratio))


def finger_root(model: HandModel, finger: int) -> Vector:
    """The MCP (thumb: CMC) in the palm frame [m]."""
    return as_vector(model.rest_position_m[CHAINS[finger, 0]])


def nearest_reach(chain: Chain) -> float:
    """Least |end - root| [m] inside the limits: pattern search over the joints behind the first, several starts."""
    spans = chain.spans
    first = 2 if isinstance(chain.links[0].joint, Rotor) else 1

    def distance(flat: list[float]) -> float:
        pose: list[Angles] = []
        rest = iter(flat)
        for link in chain.links:
            count = 2 if isinstance(link.joint, Rotor) else 1
            pose.append(tuple(next(rest) for _ in range(count)))
        return length(chain.forward(chain.clamp(tuple(pose)))[0][-1])

    least = float("inf")
    for share in (1.0, 0.5, 0.0):
        flat = [
            min(max(0.0, low), high) if i < first else low + share * (high - low)
            for i, (low, high) in enumerate(spans)
        ]
        here, step = distance(flat), 0.25
        while step > 1e-4:
            before = here
            for i in range(first, len(flat)):
                low, high = spans[i]
                for move in (step, -step):
                    trial = flat.copy()
                    trial[i] = min(max(flat[i] + move * (high - low), low), high)
                    found = distance(trial)
                    if found < here:
                        flat, here = trial, found
            if here >= before - 1e-12:
                step *= 0.5
        least = min(least, here)
    return least
