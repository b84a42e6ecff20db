"""A limited chain of bones, for the solvers: rest turns, joints and bone vectors, and its forward kinematics.

Everything is in the chain's root frame, its first joint at the origin. Link k turns from its parent's frame by
the fixed `turn`, then by its joint's Q(angles), and its bone leads to joint k + 1:

    O_k = O_{k-1} turn_k Q_k          p_{k+1} = p_k + O_k bone_k

Kernels see a chain of any length as `ChainArrays` and its angles as one array (n,), joint after joint, so that there
is one compiled solver for all chains.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from common.arrays import Float, Int
from common.kernels import constant, inner, kernel
from master.fabrik.joints import HINGE, Angles, Hinge, Joint, Limits, Pair, clamp, rotation
from master.fabrik.rotations import Matrix, Vector, length, product, rotate

Pose = tuple[Angles, ...]
"""Angles of every joint [rad]: one of a hinge, abduction and flexion of a rotor."""

ROOT = START = constant(
    0
)  # the first link; where the numbers of a row begin that is all one vector or matrix
KIND, WORLD, FIRST = map(constant, range(3))  # columns of `ChainArrays.joints`
TURN, REST, BONE, AXIS, SPREAD, SIGN = map(constant, (0, 9, 18, 21, 24, 25))  # and of `ChainArrays.links`

_SEARCH_STARTS = (1.0, 0.5, 0.0)
_FIRST_STEP, _LEAST_STEP = 0.25, 1e-4
_NO_GAIN_M = 1e-12


class ChainArrays(NamedTuple):
    """A chain of N links with n angles, for kernels.

    Attributes:
        joints: (N, 3): kind as in `Limits`; 1 where the joint's frame stays with the chain's root, else 0; index of its
            first angle (columns KIND, WORLD, FIRST).
        spans: (n, 2) low and high of every angle [rad].
        links: (N, 26), in the columns from TURN, REST, BONE [m], AXIS, SPREAD and SIGN, as of `Link`, `Rotor`, `Hinge`.
        leader, follower: Links of the coupling; -1: none.
        ratio: Of the coupling.
    """

    joints: Int
    spans: Float
    links: Float
    leader: int
    follower: int
    ratio: float


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
    """Links from the root to the end effector, and an optional coupling of two hinges.

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
        """Low and high of every angle of every joint, in order [rad]; the abduction's where nothing narrows it."""
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
        """Joint positions (N + 1, 3) [m], root first, and link orientations (N, 3, 3), root frame."""
        return self.forward_flat(self.flat(pose))

    def forward_flat(self, angles_rad: Float) -> tuple[Float, Float]:
        """As `forward`, from angles (n,) [rad]."""
        positions, orientations = np.zeros((len(self.links) + 1, 3)), np.zeros((len(self.links), 9))
        forward(self.arrays, angles_rad, positions, orientations)
        return positions, orientations.reshape(-1, 3, 3)


def nearest_reach(chain: Chain) -> float:
    """Least |end - root| [m] inside the limits: pattern search over the joints behind the first, several starts."""
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
    here, step = distance(angles), _FIRST_STEP
    while step > _LEAST_STEP:
        before = here
        for i in range(first, len(angles)):
            start = angles[i]
            for move in (step, -step):
                trial = angles.copy()
                trial[i] = min(max(start + move * (high[i] - low[i]), low[i]), high[i])
                found = distance(trial)
                if found < here:
                    angles, here = trial, found
        if here >= before - _NO_GAIN_M:
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
            [np.ravel(link.turn), np.ravel(j.rest), link.bone, j.axis, [j.spread_at_full_flexion, j.sign]]
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


@inner
def vector_at(rows: Float, k: int, start: int) -> Vector:
    """Three numbers of row k of an array, from a column on."""
    return rows[k, start], rows[k, start + 1], rows[k, start + 2]


@inner
def matrix_at(rows: Float, k: int, start: int) -> Matrix:
    """Nine numbers of row k of an array, from a column on, as a matrix."""
    return vector_at(rows, k, start), vector_at(rows, k, start + 3), vector_at(rows, k, start + 6)


@inner
def put_vector(rows: Float, k: int, v: Vector) -> None:
    """Write row k of vectors (N, 3)."""
    rows[k, 0], rows[k, 1], rows[k, 2] = v


@inner
def put_matrix(rows: Float, k: int, m: Matrix) -> None:
    """Write row k of matrices (N, 9)."""
    rows[k, 0], rows[k, 1], rows[k, 2] = m[0]
    rows[k, 3], rows[k, 4], rows[k, 5] = m[1]
    rows[k, 6], rows[k, 7], rows[k, 8] = m[2]


@inner
def limits_of(chain: ChainArrays, k: int) -> Limits:
    """What joint k allows."""
    i = int(chain.joints[k, FIRST])
    j = i if chain.joints[k, KIND] == HINGE else i + 1
    return Limits(
        chain.joints[k, KIND],
        chain.spans[i, 0],
        chain.spans[i, 1],
        chain.spans[j, 0],
        chain.spans[j, 1],
        chain.links[k, SPREAD],
        chain.links[k, SIGN],
        vector_at(chain.links, k, AXIS),
        matrix_at(chain.links, k, REST),
    )


@inner
def angles_of(chain: ChainArrays, angles: Float, k: int) -> Pair:
    """Angles of joint k [rad]; a hinge's second is 0."""
    i = int(chain.joints[k, FIRST])
    return angles[i], 0.0 if chain.joints[k, KIND] == HINGE else angles[i + 1]


@inner
def put_angles(chain: ChainArrays, angles: Float, k: int, pair: Pair) -> None:
    """Write the angles of joint k [rad]."""
    i = int(chain.joints[k, FIRST])
    angles[i] = pair[0]
    if chain.joints[k, KIND] != HINGE:
        angles[i + 1] = pair[1]


@kernel
def clamp_angles(chain: ChainArrays, angles: Float) -> None:
    """Replace angles (n,) [rad] by the nearest legal ones, coupling obeyed."""
    for k in range(len(chain.joints)):
        put_angles(chain, angles, k, clamp(limits_of(chain, k), angles_of(chain, angles, k)))
    if chain.follower >= 0:
        follow(chain, angles)


@inner
def follow(chain: ChainArrays, angles: Float) -> None:
    """Set the coupled hinge's angle by its leader's, within its own limits."""
    k = chain.follower
    led = chain.ratio * float(angles[int(chain.joints[chain.leader, FIRST])])
    put_angles(chain, angles, k, clamp(limits_of(chain, k), (led, 0.0)))


@inner
def rest_frame(chain: ChainArrays, k: int, parent: Matrix) -> Matrix:
    """Frame in which joint k's angles are measured, given the orientation of the link before it."""
    turn = matrix_at(chain.links, k, TURN)
    return turn if k == 0 or chain.joints[k, WORLD] else product(parent, turn)


@kernel
def forward(chain: ChainArrays, angles: Float, positions: Float, orientations: Float) -> None:
    """Write joint positions (N + 1, 3) [m], root first, and link orientations (N, 9) of angles (n,) [rad]."""
    x, y, z = 0.0, 0.0, 0.0
    put_vector(positions, 0, (x, y, z))
    parent = matrix_at(chain.links, ROOT, TURN)
    for k in range(len(chain.joints)):
        own = rotation(limits_of(chain, k), angles_of(chain, angles, k))
        parent = product(rest_frame(chain, k, parent), own)
        step = rotate(parent, vector_at(chain.links, k, BONE))
        x, y, z = x + step[0], y + step[1], z + step[2]
        put_vector(positions, k + 1, (x, y, z))
        put_matrix(orientations, k, parent)


@kernel
def end_of(chain: ChainArrays, angles: Float) -> Vector:
    """Where the chain ends at angles (n,) [rad]; [m], root frame."""
    x, y, z = 0.0, 0.0, 0.0
    parent = matrix_at(chain.links, ROOT, TURN)
    for k in range(len(chain.joints)):
        own = rotation(limits_of(chain, k), angles_of(chain, angles, k))
        parent = product(rest_frame(chain, k, parent), own)
        step = rotate(parent, vector_at(chain.links, k, BONE))
        x, y, z = x + step[0], y + step[1], z + step[2]
    return x, y, z
