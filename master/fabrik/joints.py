"""What a joint allows: hinge (1 degree of freedom) and rotor (2).

The limits are on the direction of the bone behind a joint. It is asked in a frame: the orientation its bone has at
rest, that is the parent's orientation times the rest turn (`local`), or one that stays with the chain's root
(`world`: a global axis). In that frame

    hinge   Q = R(axis, a)                                      a in [low, high]
    rotor   Q = R_y(sign a) rest R_x(-f)                        a abduction, f flexion

and the bone vector b of the joint's own frame lies along Q b. Bones need not be perpendicular to the axes: the
rest pose of a real hand is not planar. `fit` turns "I would like the bone to point there" into the nearest legal
angles; a direction that is legal comes back unchanged.

The rotor has four half-angles. `box`: every flexion with every abduction. `ellipse`: the four quadrants of a cone,
(a / A)^2 + (f / F)^2 <= 1 with the A and F of the quadrant (FABRIK's elliptic cone; Aristidou & Lasenby 2011).
Both may lose abduction with flexion by the parabola of `common.hand.limits`. A rotor has no third angle: the twist
of its bone is what these two rotations make of it, and no solver can turn it further.

What they do is compiled (`master.fabrik.limits`).
"""

from dataclasses import dataclass
from math import pi
from typing import Literal

from master.fabrik.limits import (
    BOX,
    ELLIPSE,
    HINGE,
    Limits,
    Pair,
    abduction_span,
    clamp,
    fit,
    narrowing,
    rotation,
)
from master.fabrik.rotations import IDENTITY, Matrix, Vector, length

Angles = tuple[float, ...]

_FLEXION_AXIS: Vector = (-1.0, 0.0, 0.0)


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
    axis: Vector = _FLEXION_AXIS
    frame: Literal["local", "world"] = "local"

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

    def rotation(self, angles: Angles) -> Matrix:
        """Rotation Q of one angle [rad]."""
        return rotation(self.limits, (angles[0], 0.0))

    def clamp(self, angles: Angles) -> Angles:
        """The nearest legal angle, going round the shorter way."""
        return clamp(self.limits, (angles[0], 0.0))[:1]

    def fit(self, bone: Vector, direction: Vector, now: Angles) -> Angles:
        """Legal angle that brings Q bone nearest to `direction`, in the joint's frame.

        Args:
            bone: Bone vector in the joint's own frame [m].
            direction: Wanted direction, any length; on the axis or zero: every angle is as good, `now` stays.
            now: Present angle.
        """
        return fit(self.limits, bone, direction, (now[0], 0.0))[:1]


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

    abduction_rad: Pair
    flexion_rad: Pair
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

    @property
    def limits(self) -> Limits:
        """The joint for kernels."""
        kind = ELLIPSE if self.shape == "ellipse" else BOX
        low, high, f_low, f_high, left, sign = map(
            float, (*self.abduction_rad, *self.flexion_rad, self.spread_at_full_flexion, self.sign)
        )
        return Limits(kind, low, high, f_low, f_high, left, sign, _FLEXION_AXIS, self.rest)

    def rotation(self, angles: Angles) -> Matrix:
        """Rotation Q of (abduction, flexion) [rad]."""
        return rotation(self.limits, (angles[0], angles[1]))

    def clamp(self, angles: Angles) -> Pair:
        """A legal pair near the wanted one; in a cone, on the line to the rest pose."""
        return clamp(self.limits, (angles[0], angles[1]))

    def abduction_span(self, flexion_rad: float) -> Pair:
        """Low and high of the abduction at one flexion [rad]."""
        return abduction_span(self.limits, flexion_rad)

    def narrowing(self, flexion_rad: float) -> Pair:
        """Share of the abduction range left at a flexion [rad], and its slope [1/rad]."""
        return narrowing(self.limits, flexion_rad)

    def fit(self, bone: Vector, direction: Vector, now: Angles) -> Pair:
        """Legal (abduction, flexion) that bring Q bone to `direction`, or near it.

        Where two exact pairs are legal (bones out of plane, near the pole of the abduction) the one nearer to
        `now` is taken. Arguments as of `Hinge.fit`.
        """
        return fit(self.limits, bone, direction, (now[0], now[1]))


Joint = Hinge | Rotor


def _check_span(what: str, low: float, high: float) -> None:
    if not -pi <= low <= high <= pi:
        raise ValueError(f"{what}: range {low} ... {high} rad is not within -pi ... pi, low first")
