"""Joints have limits, and a chain of them has forward kinematics.

What a joint allows: hinge (1 degree of freedom) and rotor (2). The limits are on the direction of the bone
behind a joint. It is asked in a frame: the orientation its bone has at rest, that is the parent's orientation
times the rest turn (`local`), or one that stays with the chain's root (`world`: a global axis). In that frame

    hinge   Q = R(axis, a)                                      a in [low, high]
    rotor   Q = R_y(sign a) rest R_x(-f)                        a abduction, f flexion

and the bone vector b of the joint's own frame lies along Q b. Bones need not be perpendicular to the axes:
the rest pose of a real hand is not planar. `fit` turns "I would like the bone to point there" into the
nearest legal angles; a direction that is legal comes back unchanged.

The rotor has four half-angles. `box`: every flexion with every abduction. `ellipse`: the four quadrants of a
cone, (a / A)^2 + (f / F)^2 <= 1 with the A and F of the quadrant (FABRIK's elliptic cone; Aristidou & Lasenby
2011). Both may lose abduction with flexion by the parabola of `common.hand.profiles`. A rotor has no third
angle: the twist of its bone is what these two rotations make of it. A chain is a few arrays, so that one
compiled solver serves all.
"""

from dataclasses import dataclass
from math import acos, atan2, cos, hypot, pi, sin, sqrt
from typing import Literal, NamedTuple

from common.arrays import Float, Int
from common.hand.profiles import spread_left
from common.kernels import constant, inner, kernel
from master.fabrik.linear_algebra import (
    IDENTITY,
    Matrix,
    Vector,
    cross,
    dot,
    length,
    plus,
    product,
    rotate,
    rotate_back,
    rotation_about,
)

Pair = tuple[float, float]

HINGE, BOX, ELLIPSE = 0, 1, 2
_TINY = 1e-15

_spread_left = inner(spread_left)


class Limits(NamedTuple):
    """A joint for kernels, its angles a pair, of which a hinge uses the first."""

    kind: int  # HINGE, BOX or ELLIPSE
    low: float  # of the hinge's angle, or of the rotor's abduction [rad]
    high: float
    flexion_low: float  # of the rotor [rad]
    flexion_high: float
    spread_at_full_flexion: float  # with `sign`, `rest` as of `Rotor`
    sign: float
    axis: Vector  # as of `Hinge`
    rest: Matrix


@kernel
def rotation(limits: Limits, angles: Pair) -> Matrix:
    """Rotation Q of a joint's angles [rad]."""
    if limits.kind == HINGE:
        return rotation_about(limits.axis, angles[0])
    swing = rotation_about((0.0, limits.sign, 0.0), angles[0])
    return product(product(swing, limits.rest), rotation_about((-1.0, 0.0, 0.0), angles[1]))


@kernel
def clamp(limits: Limits, angles: Pair) -> Pair:
    """Legal angles nearest to the given ones [rad].

    A hinge goes round the shorter way; a cone is entered on the line to its rest pose.
    """
    if limits.kind == HINGE:
        return _nearer_end(limits.low, limits.high, angles[0]), 0.0
    a, f = angles
    if limits.kind == ELLIPSE:
        half_a = limits.high if a > 0.0 else limits.low
        half_f = limits.flexion_high if f > 0.0 else limits.flexion_low
        a = a if half_a != 0.0 else 0.0
        f = f if half_f != 0.0 else 0.0
        out = hypot(a / half_a if a != 0.0 else 0.0, f / half_f if f != 0.0 else 0.0)
        if out > 1.0:
            a, f = a / out, f / out
    f = min(max(f, limits.flexion_low), limits.flexion_high)
    low, high = abduction_span(limits, f)
    return min(max(a, low), high), f


@kernel
def fit(limits: Limits, bone: Vector, direction: Vector, now: Pair) -> Pair:
    """Legal angles [rad] that bring a bone nearest to `direction`, joint's frame.

    `bone` [m], in the joint's own frame; `direction` of any length; on a hinge's axis or zero: `now` stays.
    Where two exact pairs of a rotor are legal (bones out of plane, near the pole of the abduction) the one
    nearer to `now` is taken.
    """
    if limits.kind == HINGE:
        return hinge_fit(limits.low, limits.high, limits.axis, bone, direction, now[0]), 0.0
    reach, wanted = length(bone), length(direction)
    if not reach > _TINY or not wanted > _TINY:
        return clamp(limits, now)
    scale = reach / wanted
    target = (direction[0] * scale, direction[1] * scale, direction[2] * scale)
    first, second = swing_and_flex(bone, target, limits.rest, limits.sign)
    best, miss, far = _legalised(limits, first, now)
    other, other_miss, other_far = _legalised(limits, second, now)
    if other_miss < miss or (other_miss == miss and other_far < far):
        best, miss = other, other_miss
    if miss > 0.0:
        # the abduction was cut: the flexion that suits what is left of it
        swing = rotation_about((0.0, limits.sign, 0.0), best[0])
        inner = rotate_back(limits.rest, rotate_back(swing, target))
        low, high = limits.flexion_low, limits.flexion_high
        best = clamp(limits, (best[0], hinge_fit(low, high, (-1.0, 0.0, 0.0), bone, inner, best[1])))
    return best


@inner
def _legalised(limits: Limits, pair: Pair, now: Pair) -> tuple[Pair, float, float]:
    """A pair clamped, by how much, and how far it is from the present one [rad]."""
    legal = clamp(limits, pair)
    miss = max(abs(legal[0] - pair[0]), abs(legal[1] - pair[1]))
    rounding_rad = 1e-12
    # below: rounding, not a violation; then continuity decides
    return (legal, miss if miss > rounding_rad else 0.0, abs(legal[0] - now[0]) + abs(legal[1] - now[1]))


@inner
def hinge_fit(low: float, high: float, axis: Vector, bone: Vector, direction: Vector, now: float) -> float:
    """Angle that brings R(axis, angle) bone nearest to `direction`; as of `fit`."""
    y = dot(direction, cross(axis, bone))
    x = dot(direction, bone) - dot(axis, bone) * dot(direction, axis)
    if hypot(x, y) <= 1e-12 * length(bone) * length(direction):
        return _nearer_end(low, high, now)
    return _nearer_end(low, high, atan2(y, x))


@inner
def _nearer_end(low: float, high: float, angle: float) -> float:
    """The angle, or the end of its range that is nearer, going round the shorter way."""
    if low <= angle <= high:
        return angle
    return low if (low - angle) % (2.0 * pi) < (angle - high) % (2.0 * pi) else high


@kernel
def abduction_span(limits: Limits, flexion: float) -> Pair:
    """Low and high of a rotor's abduction at one flexion [rad]."""
    share, _ = narrowing(limits, flexion)
    if limits.kind == ELLIPSE:
        half = limits.flexion_high if flexion > 0.0 else limits.flexion_low
        used = flexion / half if half != 0.0 else 0.0
        share = min(share, sqrt(max(1.0 - used * used, 0.0)))
    return limits.low * share, limits.high * share


@kernel
def narrowing(limits: Limits, flexion: float) -> Pair:
    """Share of the abduction range left at a flexion [rad], and its slope [1/rad]."""
    most, left = limits.flexion_high, limits.spread_at_full_flexion
    if left == 1.0 or not flexion > 0.0 or not most > 0.0:
        return 1.0, 0.0
    flexed = min(flexion / most, 1.0)
    return _spread_left(flexed, left), -2.0 * (1.0 - left) * flexed / most


@kernel
def swing_and_flex(bone: Vector, target: Vector, rest: Matrix, sign: float) -> tuple[Pair, Pair]:
    """Both pairs with R_y(sign a) rest R_x(-f) bone = target, equal lengths.

    R_y leaves the y component alone, so the flexion follows from it: with the bone's y, z part as (rho, phi),
    y = c + rho k cos(f - f0). The abduction then turns x, z onto the target's. A y out of reach is clamped.
    """
    y_row = rest[1]
    along = y_row[1] * bone[1] + y_row[2] * bone[2]
    across = y_row[1] * bone[2] - y_row[2] * bone[1]
    amplitude = hypot(along, across)
    middle = atan2(across, along)
    ratio = (target[1] - y_row[0] * bone[0]) / amplitude if amplitude > _TINY else 1.0
    half = acos(min(max(ratio, -1.0), 1.0))
    return (_swung(bone, target, rest, sign, middle + half), _swung(bone, target, rest, sign, middle - half))


@inner
def _swung(bone: Vector, target: Vector, rest: Matrix, sign: float, f: float) -> Pair:
    """The abduction that goes with a flexion, which is taken to [-pi, pi] [rad]."""
    f = f - 2.0 * pi if f > pi else f + 2.0 * pi if f < -pi else f
    c, s = cos(f), sin(f)
    flexed = (bone[0], bone[1] * c + bone[2] * s, bone[2] * c - bone[1] * s)
    x, z = dot(rest[0], flexed), dot(rest[2], flexed)
    return sign * atan2(target[0] * z - target[2] * x, target[0] * x + target[2] * z), f


_FLEXION_AXIS: Vector = (-1.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Hinge:
    """Turns about one axis; by default flexion about the joint's own +x (by -angle)."""

    low_rad: float  # range of the angle; flexion is positive with the default axis
    high_rad: float
    axis: Vector = _FLEXION_AXIS  # unit vector in the joint's frame
    frame: Literal["local", "world"] = "local"  # axis moves with the parent bone, or stays with the root

    def __post_init__(self) -> None:
        _check_span("hinge", self.low_rad, self.high_rad)
        if abs(length(self.axis) - 1.0) > 1e-9:
            raise ValueError(f"hinge: axis {self.axis} is not a unit vector")

    @property
    def limits(self) -> Limits:
        """The joint for kernels."""
        return Limits(
            HINGE, float(self.low_rad), float(self.high_rad), 0.0, 0.0, 1.0, 1.0, self.axis, IDENTITY
        )


@dataclass(frozen=True, slots=True)
class Rotor:
    """Two directions, four half-angles; `rest` lies between the two rotations.

    The thumb has it in front, in the chain's turn.
    """

    abduction_rad: Pair  # low and high
    flexion_rad: Pair  # low and high
    shape: Literal["box", "ellipse"] = "box"
    spread_at_full_flexion: float = 1.0  # share of the abduction range left at the highest flexion
    sign: float = 1.0  # +1 right hand, -1 left hand (abduction is positive towards the thumb)
    rest: Matrix = IDENTITY
    frame: Literal["local", "world"] = "local"  # as of `Hinge`

    def __post_init__(self) -> None:
        cone = self.shape == "ellipse"
        for name, (low, high), halves in (
            ("abduction", self.abduction_rad, cone or self.spread_at_full_flexion < 1.0),
            ("flexion", self.flexion_rad, cone),
        ):
            _check_span(f"rotor {name}", low, high)
            if halves and not low <= 0.0 <= high:
                raise ValueError(f"rotor: half-angles need 0 inside the {name} range, not {low} ... {high}")
        if not 0.0 <= self.spread_at_full_flexion <= 1.0:
            raise ValueError(f"rotor: spread_at_full_flexion {self.spread_at_full_flexion} is not in 0 ... 1")

    @property
    def limits(self) -> Limits:
        """The joint for kernels."""
        kind = ELLIPSE if self.shape == "ellipse" else BOX
        low, high, f_low, f_high, left, sign = map(
            float, (*self.abduction_rad, *self.flexion_rad, self.spread_at_full_flexion, self.sign)
        )
        return Limits(kind, low, high, f_low, f_high, left, sign, _FLEXION_AXIS, self.rest)


Joint = Hinge | Rotor


def _check_span(what: str, low: float, high: float) -> None:
    if not -pi <= low <= high <= pi:
        raise ValueError(f"{what}: range {low} ... {high} rad is not within -pi ... pi, low first")


# the first link; where the numbers of a row begin that is all one vector or matrix
ROOT = START = constant(0)
KIND, WORLD, FIRST = map(constant, range(3))  # columns of `ChainArrays.joints`
ROTATION, REST, BONE, AXIS, SPREAD, SIGN = map(constant, (0, 9, 18, 21, 24, 25))  # and of `ChainArrays.links`


class ChainArrays(NamedTuple):
    """A chain of N links with n angles, for kernels.

    `joints` (N, 3): kind as in `Limits`; 1 where the joint's frame stays with the chain's root, else 0; index
    of its first angle (columns KIND, WORLD, FIRST). `links` (N, 26): in the columns from TURN, REST, BONE
    [m], AXIS, SPREAD and SIGN, as of `Link`, `Rotor`, `Hinge`.
    """

    joints: Int
    spans: Float  # (n, 2) low and high of every angle [rad]
    links: Float
    leader: int  # links of the coupling, with `follower`; -1: none
    follower: int
    ratio: float  # of the coupling


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
