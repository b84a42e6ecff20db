"""Kernels of a single joint: rotation, limits and the nearest legal angles.

The definitions are in `master.fabrik.joints`. A joint's angles are a pair, of which a hinge uses the first.
"""

from math import acos, atan2, cos, hypot, pi, sin, sqrt
from typing import NamedTuple

from common.hand.limits import spread_left
from common.kernels import inner, kernel
from master.fabrik.rotations import (
    Matrix,
    Vector,
    cross,
    dot,
    length,
    product,
    rotate_back,
    rotation_about,
)

Pair = tuple[float, float]

HINGE, BOX, ELLIPSE = 0, 1, 2
_TINY = 1e-15

_spread_left = inner(spread_left)


class Limits(NamedTuple):
    """A joint for kernels.

    Attributes:
        kind: HINGE, BOX or ELLIPSE.
        low, high: Of the hinge's angle, or of the rotor's abduction [rad].
        flexion_low, flexion_high: Of the rotor [rad].
        spread_at_full_flexion, sign, rest: As of `Rotor`.
        axis: As of `Hinge`.
    """

    kind: int
    low: float
    high: float
    flexion_low: float
    flexion_high: float
    spread_at_full_flexion: float
    sign: float
    axis: Vector
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
    """Legal angles nearest to the given ones [rad]; as of `Hinge` and `Rotor`."""
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
    """Legal angles [rad] that bring Q bone to `direction`; as of `Hinge`, `Rotor`."""
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
    return (
        legal,
        miss if miss > rounding_rad else 0.0,
        abs(legal[0] - now[0]) + abs(legal[1] - now[1]),
    )


@inner
def hinge_fit(low: float, high: float, axis: Vector, bone: Vector, direction: Vector, now: float) -> float:
    """Angle that brings R(axis, angle) bone nearest to `direction`; as of `Hinge`."""
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
    even = y_row[1] * bone[1] + y_row[2] * bone[2]
    odd = y_row[1] * bone[2] - y_row[2] * bone[1]
    amplitude = hypot(even, odd)
    middle = atan2(odd, even)
    ratio = (target[1] - y_row[0] * bone[0]) / amplitude if amplitude > _TINY else 1.0
    half = acos(min(max(ratio, -1.0), 1.0))
    return (
        _swung(bone, target, rest, sign, middle + half),
        _swung(bone, target, rest, sign, middle - half),
    )


@inner
def _swung(bone: Vector, target: Vector, rest: Matrix, sign: float, f: float) -> Pair:
    """The abduction that goes with a flexion, which is taken to [-pi, pi] [rad]."""
    f = f - 2.0 * pi if f > pi else f + 2.0 * pi if f < -pi else f
    c, s = cos(f), sin(f)
    flexed = (bone[0], bone[1] * c + bone[2] * s, bone[2] * c - bone[1] * s)
    x, z = dot(rest[0], flexed), dot(rest[2], flexed)
    return sign * atan2(target[0] * z - target[2] * x, target[0] * x + target[2] * z), f
