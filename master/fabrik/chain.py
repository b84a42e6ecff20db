"""A chain of bones with limited joints, and its forward kinematics.

Everything is in the chain's root frame, its first joint at the origin. Link k turns from its parent's frame by
the fixed `rotation`, then by its joint's Q(angles), and its bone leads to joint k + 1:

    O_k = O_{k-1} turn_k Q_k          p_{k+1} = p_k + O_k bone_k

Kernels see it as `ChainArrays`, and its angles as one array (n,), joint after joint.
"""

from dataclasses import dataclass, field

import numpy as np

from common.arrays import Float
from master.fabrik.chain_arrays import ChainArrays, clamp_angles, end_of, forward
from master.fabrik.joints import Angles, Hinge, Joint
from master.fabrik.limits import HINGE, Pair
from master.fabrik.rotations import Matrix, Vector, length

Pose = tuple[Angles, ...]
"""Angles of every joint [rad]: one of a hinge, abduction and flexion of a rotor."""

_SEARCH_STARTS = (1.0, 0.5, 0.0)


@dataclass(frozen=True, slots=True)
class Link:
    """One joint and the bone behind it.

    Attributes:
        rotation: Rest orientation in the parent's frame (`world` joints: in the root frame).
        joint: What it allows.
        bone: To the next joint, in the joint's own frame [m].
    """

    rotation: Matrix
    joint: Joint
    bone: Vector


@dataclass(frozen=True, slots=True)
class Coupling:
    """A hinge that follows another within its own limits, by a ratio of angles."""

    leader: int
    follower: int
    ratio: float


@dataclass(frozen=True, slots=True)
class Chain:
    """Links from the root to the end effector; two hinges may be coupled.

    Attributes:
        links: At least one.
        coupling: None: every joint is free.
        arrays: The same for kernels.
    """

    links: tuple[Link, ...]
    coupling: Coupling | None = None
    arrays: ChainArrays = field(init=False, repr=False, compare=False)

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
        object.__setattr__(self, "arrays", _arrays(self))

    @property
    def lengths(self) -> tuple[float, ...]:
        """Bone lengths [m]."""
        return tuple(length(link.bone) for link in self.links)

    @property
    def spans(self) -> tuple[Pair, ...]:
        """Low and high of every angle [rad]; the abduction's where nothing narrows it."""
        return tuple((low, high) for low, high in self.arrays.spans.tolist())

    def flat(self, pose: Pose) -> Float:
        """Angles (n,) [rad] of a pose.

        Raises:
            ValueError: A joint has too many angles, or too few.
        """
        for link, angles in zip(self.links, pose, strict=True):
            if len(angles) != _count(link.joint):
                raise ValueError(f"{len(angles)} angles for a joint that has {_count(link.joint)}")
        return np.array([angle for angles in pose for angle in angles], np.float64)

    def pose(self, angles_rad: Float) -> Pose:
        """Angles (n,) [rad] joint by joint."""
        rest = iter(angles_rad.tolist())
        return tuple(tuple(next(rest) for _ in range(_count(link.joint))) for link in self.links)

    def clamp(self, pose: Pose) -> Pose:
        """The nearest legal pose, coupling obeyed."""
        angles = self.flat(pose)
        clamp_angles(self.arrays, angles)
        return self.pose(angles)

    def forward(self, pose: Pose) -> tuple[Float, Float]:
        """Joint positions (N + 1, 3) [m] and link orientations (N, 3, 3), root frame."""
        return self.forward_flat(self.flat(pose))

    def forward_flat(self, angles_rad: Float) -> tuple[Float, Float]:
        """As `forward`, from angles (n,) [rad]."""
        positions, orientations = np.zeros((len(self.links) + 1, 3)), np.zeros((len(self.links), 9))
        forward(self.arrays, angles_rad, positions, orientations)
        return positions, orientations.reshape(-1, 3, 3)


def least_root_to_end(chain: Chain) -> float:
    """Least |end - root| [m] inside the limits.

    Pattern search over the joints behind the first, from several starts.
    """
    return min(_nearest_from(chain, share) for share in _SEARCH_STARTS)


def _nearest_from(chain: Chain, share: float) -> float:
    """Least |end - root| [m] from joints at a share of their range."""

    def distance(angles: Float) -> float:
        legal = angles.copy()
        clamp_angles(chain.arrays, legal)
        return length(end_of(chain.arrays, legal))

    low, high = chain.arrays.spans.T
    first = _count(chain.links[0].joint)
    angles = np.append(np.clip(0.0, low[:first], high[:first]), (low + share * (high - low))[first:])
    first_step, least_step = 0.25, 1e-4
    here, step = distance(angles), first_step
    while step > least_step:
        before = here
        for i in range(first, len(angles)):
            start = angles[i]
            for move in (step, -step):
                trial = angles.copy()
                trial[i] = min(max(start + move * (high[i] - low[i]), low[i]), high[i])
                found = distance(trial)
                if found < here:
                    angles, here = trial, found
        no_gain_m = 1e-12
        if here >= before - no_gain_m:
            step *= 0.5
    return here


def _arrays(chain: Chain) -> ChainArrays:
    joints = [link.joint.limits for link in chain.links]
    counts = [_count(link.joint) for link in chain.links]
    spans: list[Pair] = []
    for joint in joints:
        spans.append((joint.low, joint.high))
        if joint.kind != HINGE:
            spans.append((joint.flexion_low, joint.flexion_high))
    kinds = [(j.kind, link.joint.frame == "world") for j, link in zip(joints, chain.links, strict=True)]
    rows = [
        np.concatenate(
            [np.ravel(link.rotation), np.ravel(j.rest), link.bone, j.axis, [j.spread_at_full_flexion, j.sign]]
        )
        for j, link in zip(joints, chain.links, strict=True)
    ]
    c = chain.coupling or Coupling(-1, -1, 0.0)
    return ChainArrays(
        joints=np.column_stack([kinds, np.cumsum([0, *counts[:-1]])]).astype(np.int64, order="C"),
        spans=np.array(spans, np.float64),
        links=np.array(rows, np.float64),
        leader=c.leader,
        follower=c.follower,
        ratio=float(c.ratio),
    )


def _count(joint: Joint) -> int:
    return 1 if isinstance(joint, Hinge) else 2
