"""Distance between the skins of two fingers, modelled as round cones.

The flesh on a bone is nearly a round cone.

A round cone is the union of balls whose middles go along a line and whose radii go evenly from one end to the other. So
the gap of two is the least, over s and t in 0..1, of

    |(a + s u) - (b + t v)| - (r_a + s d_a) - (r_b + t d_b),

which is convex in (s, t): descending in each in turn, in closed form, leads to it. `foot_of` and `nearest` take numbers
as well as arrays and call nothing of their own, so that kernels may compile them.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from common.arrays import Float
from common.hand.model import CHAINS

Foot: TypeAlias = tuple[Float, Float, Float, Float, Float, Float]

ROUNDS = 12  # what is left then is below 0.1 mm, at worst where fingers are parallel


@dataclass(frozen=True, slots=True, eq=False)
class TaperedCapsules:
    """Cones of any leading shape.

    Attributes:
        start_m, along_m: (..., 3) [m] middle of the first ball, and from there to the last.
        radius_m, growth_m: (...) [m] radius of the first ball, and by how much that of the last is larger.
    """

    start_m: Float
    along_m: Float
    radius_m: Float
    growth_m: Float

    @classmethod
    def of_segments(cls, joints_m: Float, radius_m: Float) -> "TaperedCapsules":
        """Return the segments (..., 5, 3), thumb ... little, from the root on.

        From joints (..., 26, 3) and radii (26,) [m].
        """
        chain, radius = joints_m[..., CHAINS, :], radius_m[CHAINS]
        return cls(chain[..., :-1, :], np.diff(chain, axis=-2), radius[..., :-1], np.diff(radius, axis=-1))

    def part(self, *at: int | slice | None) -> "TaperedCapsules":
        """Some of the segments: indices into the two last axes, (finger, segment)."""
        where, place = (..., *at), (..., *at, slice(None))
        return TaperedCapsules(
            self.start_m[place], self.along_m[place], self.radius_m[where], self.growth_m[where]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Where two sets of cones are nearest.

    Attributes:
        gap_m: (...) [m] between the skins, negative where they overlap.
        on_a, on_b: (...) 0..1 how far along each cone the two balls are that are nearest.
        middle_m: (..., 3) [m] half way between the skins there.
        a_to_b: (..., 3) unit vector from the one ball to the other.
    """

    gap_m: Float
    on_a: Float
    on_b: Float
    middle_m: Float
    a_to_b: Float


def gaps_between(a: TaperedCapsules, b: TaperedCapsules) -> Gaps:
    """The gaps of cones against cones, broadcast against each other."""
    apart = b.start_m - a.start_m
    uu, vv = np.vecdot(a.along_m, a.along_m), np.vecdot(b.along_m, b.along_m)
    uv, au, bv = (
        np.vecdot(one, two) for one, two in ((a.along_m, b.along_m), (apart, a.along_m), (apart, b.along_m))
    )
    square = np.vecdot(apart, apart)
    on_a = foot_of(au / uu, uv / uu, square / uu, 2.0 * bv / uu, vv / uu, a.growth_m, uu)
    on_b = foot_of(-bv / vv, uv / vv, square / vv, -2.0 * au / vv, uu / vv, b.growth_m, vv)
    s = t = np.full(apart.shape[:-1], 0.5)
    for _ in range(ROUNDS):
        s, before = nearest(on_a, t), t
        t = nearest(on_b, s)
        if (t == before).all():  # as where the nearest are ends of bones: more rounds change nothing
            break
    from_a = a.start_m + s[..., None] * a.along_m
    between = b.start_m + t[..., None] * b.along_m - from_a
    length = np.sqrt(np.vecdot(between, between))
    way = between / np.maximum(length, 1e-9)[..., None]
    radius_a, radius_b = a.radius_m + s * a.growth_m, b.radius_m + t * b.growth_m
    gap = length - radius_a - radius_b
    middle = from_a + (radius_a + 0.5 * gap)[..., None] * way
    return Gaps(gap, s, t, middle, way)


def foot_of(
    foot: Float, foot_by: Float, c0: Float, c1: Float, c2: Float, growth_m: Float, square: Float
) -> Foot:
    """Return where along a cone the foot of a point on the other's bone is.

    The foot is linear in the point's share, and the square of its distance from the bone, in units of the bone's
    length, is a quadratic: so a round needs no vectors.

    Args:
        foot, foot_by: The foot of the other's start, and by how much it goes on; shares of this bone.
        c0, c1, c2: The square of the distance from this cone's start is c0 + c1 x + c2 x^2 of a share x.
        growth_m, square: Of this cone: growth [m], and the square of its bone's length [m^2].

    Returns:
        `foot` and `foot_by`, the three coefficients of the square of the distance from the bone, and by how much the
        nearest place is beyond the foot, to where the cone is thicker, per distance: the tangent of half its angle.
    """
    lean = growth_m / np.sqrt(np.maximum(square - growth_m * growth_m, 1e-12))
    return foot, foot_by, c0 - foot * foot, c1 - 2.0 * foot * foot_by, c2 - foot_by * foot_by, lean


def nearest(on: Foot, share: Float) -> Float:
    """Return the position along a cone, 0..1, where its skin is nearest to a point.

    The point is given by its share of the other cone's bone.
    """
    foot, foot_by, off_2, off_by, off_by_2, lean = on
    beyond = lean * np.sqrt(np.maximum(off_2 + share * (off_by + share * off_by_2), 0.0))
    return np.minimum(np.maximum(foot + share * foot_by + beyond, 0.0), 1.0)
