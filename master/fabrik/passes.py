"""Kernels of one iteration of FABRIK: aim, backward pass, forward pass."""

from common.arrays import Float
from common.kernels import inner, kernel
from master.fabrik.chain_arrays import (
    BONE,
    KIND,
    ROOT,
    ROTATION,
    START,
    WORLD,
    ChainArrays,
    angles_of,
    follow,
    limits_of,
    matrix_at,
    put_angles,
    put_matrix,
    put_vector,
    rest_frame,
    vector_at,
)
from master.fabrik.limits import HINGE, fit, hinge_fit, rotation
from master.fabrik.rotations import (
    Matrix,
    Vector,
    between,
    minus,
    plus,
    product,
    rotate,
    rotate_back,
    rotation_about,
    transposed,
)


@inner
def aim(chain: ChainArrays, end: Vector, goal: Vector, angles: Float) -> None:
    """Turn the first joint so that the end lies towards the goal."""
    limits, link_rotation, now = (
        limits_of(chain, ROOT),
        matrix_at(chain.links, ROOT, ROTATION),
        angles_of(chain, angles, ROOT),
    )
    arm = rotate_back(rotation(limits, now), rotate_back(link_rotation, end))
    put_angles(chain, angles, ROOT, fit(limits, arm, rotate_back(link_rotation, goal), now))


@kernel
def backward_pass(
    chain: ChainArrays, positions: Float, orientations: Float, angles: Float, goal: Vector, places: Float
) -> None:
    """Write places (N + 1, 3) [m] of the joints when the end is on the target.

    Limits between neighbours are kept.
    """
    last = len(chain.joints) - 1
    place = goal
    put_vector(places, last + 1, place)
    wanted = minus(place, vector_at(positions, last, START))
    behind = _pointed(chain, last, matrix_at(orientations, last, START), angles, wanted)
    place = minus(place, rotate(behind, vector_at(chain.links, last, BONE)))
    put_vector(places, last, place)
    for k in range(last - 1, -1, -1):
        wanted, now, bone = (
            minus(place, vector_at(positions, k, START)),
            matrix_at(orientations, k, START),
            vector_at(chain.links, k, BONE),
        )
        if chain.joints[k, WORLD] or chain.joints[k + 1, WORLD]:
            here = _pointed(chain, k, now, angles, wanted)
        elif chain.joints[k + 1, KIND] == HINGE:
            here = _before_hinge(chain, k, behind, angles, wanted)
        else:
            here = _before_rotor(chain, k, behind, angles, _rotated_towards(now, bone, wanted))
        place = minus(place, rotate(here, bone))
        put_vector(places, k, place)
        behind = here


@inner
def _rotated_towards(orientation: Matrix, bone: Vector, wanted: Vector) -> Matrix:
    """Orientation turned the shortest way so that its bone points as wanted."""
    return product(between(rotate(orientation, bone), wanted), orientation)


@kernel
def _pointed(chain: ChainArrays, k: int, now: Matrix, angles: Float, wanted: Vector) -> Matrix:
    """Orientation of link k whose bone points as wanted.

    A joint with axes of the world turns it only as far as it allows.
    """
    bone = vector_at(chain.links, k, BONE)
    if not chain.joints[k, WORLD]:
        return _rotated_towards(now, bone, wanted)
    limits, link_rotation = limits_of(chain, k), matrix_at(chain.links, k, ROTATION)
    fitted = fit(limits, bone, rotate_back(link_rotation, wanted), angles_of(chain, angles, k))
    return product(link_rotation, rotation(limits, fitted))


@inner
def _before_hinge(chain: ChainArrays, k: int, behind: Matrix, angles: Float, wanted: Vector) -> Matrix:
    """Orientation of link k, its bone as wanted as far as the next hinge allows.

    Seen from the bone `behind`, this bone turns the other way about the same axis.
    """
    limits, link_rotation = limits_of(chain, k + 1), matrix_at(chain.links, k + 1, ROTATION)
    seen = rotate_back(link_rotation, vector_at(chain.links, k, BONE))
    now = angles_of(chain, angles, k + 1)
    angle = hinge_fit(-limits.high, -limits.low, limits.axis, seen, rotate_back(behind, wanted), -now[0])
    return product(behind, product(rotation_about(limits.axis, angle), transposed(link_rotation)))


@inner
def _before_rotor(chain: ChainArrays, k: int, behind: Matrix, angles: Float, here: Matrix) -> Matrix:
    """Orientation `here` of link k, turned so that the next rotor allows `behind`."""
    limits, bone = limits_of(chain, k + 1), vector_at(chain.links, k + 1, BONE)
    frame = product(here, matrix_at(chain.links, k + 1, ROTATION))
    actual = rotate(behind, bone)
    fitted = fit(limits, bone, rotate_back(frame, actual), angles_of(chain, angles, k + 1))
    allowed = rotate(frame, rotate(rotation(limits, fitted), bone))
    return product(between(allowed, actual), here)


@inner
def forward_pass(
    chain: ChainArrays, places: Float, angles: Float, positions: Float, orientations: Float
) -> None:
    """Write the legal pose whose bones point to the places; `angles`: in, out [rad]."""
    place = (0.0, 0.0, 0.0)
    put_vector(positions, ROOT, place)
    parent = matrix_at(chain.links, ROOT, ROTATION)
    for k in range(len(chain.joints)):
        limits, bone, frame = (
            limits_of(chain, k),
            vector_at(chain.links, k, BONE),
            rest_frame(chain, k, parent),
        )
        if k == chain.follower:
            follow(chain, angles)
        else:
            wanted = rotate_back(frame, minus(vector_at(places, k + 1, START), place))
            put_angles(chain, angles, k, fit(limits, bone, wanted, angles_of(chain, angles, k)))
        parent = product(frame, rotation(limits, angles_of(chain, angles, k)))
        place = plus(place, rotate(parent, bone))
        put_vector(positions, k + 1, place)
        put_matrix(orientations, k, parent)
