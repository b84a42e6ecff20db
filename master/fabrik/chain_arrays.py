"""Kernels of a chain of any length: its joints and its forward kinematics.

A chain is a few arrays and its angles are one, so that there is one compiled solver for all chains.
"""

from typing import NamedTuple

from common.arrays import Float, Int
from common.kernels import constant, inner, kernel
from master.fabrik.limits import HINGE, Limits, Pair, clamp, rotation
from master.fabrik.rotations import Matrix, Vector, plus, product, rotate

ROOT = START = constant(
    0
)  # the first link; where the numbers of a row begin that is all one vector or matrix
KIND, WORLD, FIRST = map(constant, range(3))  # columns of `ChainArrays.joints`
ROTATION, REST, BONE, AXIS, SPREAD, SIGN = map(constant, (0, 9, 18, 21, 24, 25))  # and of `ChainArrays.links`


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
    """Frame in which joint k is measured, given the orientation of its parent."""
    link_rotation = matrix_at(chain.links, k, ROTATION)
    return link_rotation if k == 0 or chain.joints[k, WORLD] else product(parent, link_rotation)


@kernel
def forward(chain: ChainArrays, angles: Float, positions: Float, orientations: Float) -> None:
    """Write joint positions (N + 1, 3) [m] and orientations (N, 9) of angles (n,)."""
    place = (0.0, 0.0, 0.0)
    put_vector(positions, ROOT, place)
    parent = matrix_at(chain.links, ROOT, ROTATION)
    for k in range(len(chain.joints)):
        own = rotation(limits_of(chain, k), angles_of(chain, angles, k))
        parent = product(rest_frame(chain, k, parent), own)
        place = plus(place, rotate(parent, vector_at(chain.links, k, BONE)))
        put_vector(positions, k + 1, place)
        put_matrix(orientations, k, parent)


@kernel
def end_of(chain: ChainArrays, angles: Float) -> Vector:
    """Where the chain ends at angles (n,) [rad]; [m], root frame."""
    place = (0.0, 0.0, 0.0)
    parent = matrix_at(chain.links, ROOT, ROTATION)
    for k in range(len(chain.joints)):
        own = rotation(limits_of(chain, k), angles_of(chain, angles, k))
        parent = product(rest_frame(chain, k, parent), own)
        place = plus(place, rotate(parent, vector_at(chain.links, k, BONE)))
    return place
