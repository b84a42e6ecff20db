"""What a joint allows: hinge (1 degree of freedom) and rotor (2), as limits on the direction of the bone behind it.

A joint is asked in a frame: the orientation its bone has at rest, that is the parent's orientation times the
rest turn (`local`), or one that stays with the chain's root (`world`: a global axis). In that frame

    hinge   Q = R(axis, a)                                      a in [low, high]
    rotor   Q = R_y(sign a) rest R_x(-f)                        a abduction, f flexion

and the bone vector b of the joint's own frame lies along Q b. Bones need not be perpendicular to the axes: the
rest pose of a real hand is not planar. `fit` turns "I would like the bone to point there" into the nearest legal
angles; a direction that is legal comes back unchanged.

The rotor has four half-angles. `box`: every flexion with every abduction. `ellipse`: the four quadrants of a cone,
(a / A)^2 + (f / F)^2 <= 1 with the A and F of the quadrant (FABRIK's elliptic cone; Aristidou & Lasenby 2011).
Both may lose abduction with flexion by the parabola of `common.hand_limits`. A rotor has no third angle: the twist
of its bone is what these two rotations make of it, and no solver can turn it further.
"""

from dataclasses import dataclass
from math import acos, atan2, cos, hypot, inf, pi, sin, sqrt
from typing import Literal

from common.hand_limits import spread_left
from master.ik.vectors import (
    IDENTITY,
    Matrix,
    Vector,
    cross,
    dot,
    length,
    product,
    rotate,
    rotate_back,
    rotation_about,
)

Angles = tuple[float, ...]

_TINY = 1e-15


@dataclass(frozen=True, slots=True)
class Hinge:
    """Turns about one axis.

    Attributes:
        low_rad, high_rad: Range of the angle; flexion is positive with the default axis.
        axis: Unit vector in the joint's frame; the default is flexion about the joint's own +x (by -angle).
        frame: Whether the axis moves with the parent bone or stays with the chain's root.
    """

    low_rad: float
    high_rad: float
    axis: Vector = (-1.0, 0.0, 0.0)
    frame: Literal["local", "world"] = "local"

    def __post_init__(self) -> None:
        _check_span("hinge", self.low_rad, self.high_rad)
        if abs(length(self.axis) - 1.0) > 1e-9:
            raise ValueError(f"hinge: axis {self.axis} is not a unit vector")

    def rotation(self, angles: Angles) -> Matrix:
        """Q of one angle [rad]."""
        return rotation_about(self.axis, angles[0])

    def clamp(self, angles: Angles) -> Angles:
        """The nearest legal angle, going round the shorter way."""
        (angle,) = angles
        if self.low_rad <= angle <= self.high_rad:
            return angles
        below, above = _turn(self.low_rad - angle), _turn(angle - self.high_rad)
        return (self.low_rad,) if below < above else (self.high_rad,)

    def fit(self, bone: Vector, direction: Vector, now: Angles) -> Angles:
        """The legal angle that brings Q bone nearest to `direction` (both in the joint's frame).

        Args:
            bone: Bone vector in the joint's own frame [m].
            direction: Wanted direction, any length; on the axis or zero: every angle is as good, `now` stays.
            now: Present angle.
        """
        across = cross(self.axis, bone)
        y = dot(direction, across)
        along = dot(self.axis, bone)
        x = dot(direction, bone) - along * dot(direction, self.axis)
        if hypot(x, y) <= 1e-12 * length(bone) * length(direction):
            return self.clamp(now)
        return self.clamp((atan2(y, x),))


@dataclass(frozen=True, slots=True)
class Rotor:
    """Turns in two directions, with four half-angles.

    Attributes:
        abduction_rad: Low and high.
        flexion_rad: Low and high.
        shape: `box` or `ellipse` (see the module).
        spread_at_full_flexion: Share of the abduction range left at the highest flexion; 1: no loss.
        sign: +1 right hand, -1 left hand (abduction is positive towards the thumb).
        rest: Rest orientation of the joint between the two rotations (fingers); the thumb has it in front, in
            the chain's turn.
        frame: As of `Hinge`.
    """

    abduction_rad: tuple[float, float]
    flexion_rad: tuple[float, float]
    shape: Literal["box", "ellipse"] = "box"
    spread_at_full_flexion: float = 1.0
    sign: float = 1.0
    rest: Matrix = IDENTITY
    frame: Literal["local", "world"] = "local"

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

    def rotation(self, angles: Angles) -> Matrix:
        """Q of (abduction, flexion) [rad]."""
        swing = rotation_about((0.0, self.sign, 0.0), angles[0])
        return product(product(swing, self.rest), rotation_about((-1.0, 0.0, 0.0), angles[1]))

    def clamp(self, angles: Angles) -> Angles:
        """A legal pair near the wanted one: box per angle, cone along the line to the rest pose."""
        a, f = angles
        low, high = self.flexion_rad
        if self.shape == "ellipse":
            half_a, half_f = self.abduction_rad[a > 0.0], self.flexion_rad[f > 0.0]
            a = a if half_a != 0.0 else 0.0
            f = f if half_f != 0.0 else 0.0
            out = hypot(a / half_a if a else 0.0, f / half_f if f else 0.0)
            if out > 1.0:
                a, f = a / out, f / out
        f = min(max(f, low), high)
        low, high = self.abduction_span(f)
        return min(max(a, low), high), f

    def abduction_span(self, flexion_rad: float) -> tuple[float, float]:
        """Low and high of the abduction at one flexion [rad]."""
        low, high = self.abduction_rad
        share, _ = self.narrowing(flexion_rad)
        if self.shape == "ellipse":
            half = self.flexion_rad[flexion_rad > 0.0]
            used = flexion_rad / half if half else 0.0
            share = min(share, sqrt(max(1.0 - used * used, 0.0)))
        return low * share, high * share

    def narrowing(self, flexion_rad: float) -> tuple[float, float]:
        """Share of the abduction range that the parabola leaves at one flexion [rad], and its slope [1/rad]."""
        most = self.flexion_rad[1]
        if self.spread_at_full_flexion == 1.0 or not flexion_rad > 0.0 or not most > 0.0:
            return 1.0, 0.0
        flexed = min(flexion_rad / most, 1.0)
        slope = -2.0 * (1.0 - self.spread_at_full_flexion) * flexed / most
        return spread_left(flexed, self.spread_at_full_flexion), slope

    def fit(self, bone: Vector, direction: Vector, now: Angles) -> Angles:
        """Legal (abduction, flexion) that bring Q bone to `direction`, or near it when it is out of reach.

        Where two exact pairs are legal (bones out of plane, near the pole of the abduction) the one nearer to
        `now` is taken. Arguments as of `Hinge.fit`.
        """
        reach, wanted = length(bone), length(direction)
        if not reach > _TINY or not wanted > _TINY:
            return self.clamp(now)
        scale = reach / wanted
        target = (direction[0] * scale, direction[1] * scale, direction[2] * scale)
        best, best_key = now, (inf, inf)
        for pair in swing_and_flex(bone, target, self.rest, self.sign):
            legal = self.clamp(pair)
            miss = max(abs(legal[0] - pair[0]), abs(legal[1] - pair[1]))
            # below: rounding, not a violation; then continuity decides
            key = (miss if miss > 1e-12 else 0.0, abs(legal[0] - now[0]) + abs(legal[1] - now[1]))
            if key < best_key:
                best, best_key = legal, key
        if best_key[0] > 0.0:
            # the abduction was cut: the flexion that suits what is left of it
            swing = rotation_about((0.0, self.sign, 0.0), best[0])
            inner = rotate_back(self.rest, rotate_back(swing, target))
            flexion = Hinge(*self.flexion_rad).fit(bone, inner, (best[1],))
            best = self.clamp((best[0], flexion[0]))
        return best


Joint = Hinge | Rotor


def swing_and_flex(
    bone: Vector, target: Vector, rest: Matrix, sign: float
) -> tuple[tuple[float, float], ...]:
    """Both (abduction, flexion) with R_y(sign a) rest R_x(-f) bone = target, equal lengths.

    R_y leaves the y component alone, so the flexion follows from it: with the bone's y, z part as (rho, phi),
    y = c + rho k cos(f - f0). The abduction then turns x, z onto the target's. A y out of reach is clamped.
    """
    bx, by, bz = bone
    (ax, ay, az), (yx, yy, yz), (zx, zy, zz) = rest
    even, odd = yy * by + yz * bz, yy * bz - yz * by
    amplitude = hypot(even, odd)
    middle = atan2(odd, even)
    ratio = (target[1] - yx * bx) / amplitude if amplitude > _TINY else 1.0
    half = acos(min(max(ratio, -1.0), 1.0))
    pairs: list[tuple[float, float]] = []
    for f in (middle + half, middle - half):
        f = f - 2.0 * pi if f > pi else f + 2.0 * pi if f < -pi else f
        c, s = cos(f), sin(f)
        py, pz = by * c + bz * s, bz * c - by * s
        x, z = ax * bx + ay * py + az * pz, zx * bx + zy * py + zz * pz
        pairs.append((sign * atan2(target[0] * z - target[2] * x, target[0] * x + target[2] * z), f))
    return tuple(pairs)


def clamp_direction(
    joint: Joint, frame: Matrix, bone: Vector, direction: Vector, now: Angles
) -> tuple[Vector, Angles]:
    """The reachable bone direction nearest to a wanted one, and its angles.

    Args:
        joint: Hinge or rotor.
        frame: Joint frame -> world: the parent's orientation times the rest turn.
        bone: Bone vector in the joint's own frame [m].
        direction: Wanted direction in the world, any length.
        now: Present angles; kept where the direction leaves them free.

    Returns:
        Bone vector in the world (length of `bone`) and the joint's angles [rad].
    """
    angles = joint.fit(bone, rotate_back(frame, direction), now)
    return rotate(frame, rotate(joint.rotation(angles), bone)), angles


def _check_span(what: str, low: float, high: float) -> None:
    if not -pi <= low <= high <= pi:
        raise ValueError(f"{what}: range {low} ... {high} rad is not within -pi ... pi, low first")


def _turn(angle: float) -> float:
    """An angle in [0, 2 pi)."""
    return angle % (2.0 * pi)
