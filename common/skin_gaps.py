"""How near two fingers' skins are: the distance between round cones, which flesh on a bone nearly is.

A round cone is the union of balls whose middles go along a line and whose radii go evenly from one end to the other. So
the gap of two is the least, over s and t in 0..1, of

    |(a + s u) - (b + t v)| - (r_a + s d_a) - (r_b + t d_b),

which is convex in (s, t): descending in each in turn, in closed form, leads to it.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.hand_model import CHAINS

_ROUNDS = 12  # what is left then is below 0.1 mm, at worst where fingers are parallel


@dataclass(frozen=True, slots=True, eq=False)
class RoundCones:
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
    def of_segments(cls, joints_m: Float, radius_m: Float) -> "RoundCones":
        """Segments (..., 5, 3), thumb ... little, from the root on, of joints (..., 26, 3) and radii (26,) [m]."""
        chain, radius = joints_m[..., CHAINS, :], radius_m[CHAINS]
        return cls(chain[..., :-1, :], np.diff(chain, axis=-2), radius[..., :-1], np.diff(radius, axis=-1))

    def part(self, *at: int | slice | None) -> "RoundCones":
        """Some of the segments: indices into the two last axes, (finger, segment)."""
        where, place = (..., *at), (..., *at, slice(None))
        return RoundCones(
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


def gaps_between(a: RoundCones, b: RoundCones) -> Gaps:
    """The gaps of cones against cones, broadcast against each other."""
    apart = b.start_m - a.start_m
    uu, vv = np.vecdot(a.along_m, a.along_m), np.vecdot(b.along_m, b.along_m)
    uv, au, bv = (
        np.vecdot(one, two) for one, two in ((a.along_m, b.along_m), (apart, a.along_m), (apart, b.along_m))
    )
    square = np.vecdot(apart, apart)
    on_a = _Foot.of(au / uu, uv / uu, square / uu, 2.0 * bv / uu, vv / uu, _lean(a.growth_m, uu))
    on_b = _Foot.of(-bv / vv, uv / vv, square / vv, -2.0 * au / vv, uu / vv, _lean(b.growth_m, vv))
    s = t = np.full(apart.shape[:-1], 0.5)
    for _ in range(_ROUNDS):
        s, before = on_a.nearest(t), t
        t = on_b.nearest(s)
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


@dataclass(frozen=True, slots=True, eq=False)
class _Foot:
    """Where along a cone its skin is nearest to a point that goes along the other's bone, both by their shares 0..1.

    The foot of the point is linear in its share, and the square of its distance from the bone, in units of the bone's
    length, is a quadratic: so a round needs no vectors.

    Attributes:
        foot, foot_by: (...) the foot of the other's start, and by how much it goes on.
        off_2, off_by, off_by_2: (...) coefficients of that square.
        lean: (...) by how much the nearest place is beyond the foot, to where the cone is thicker, per distance.
    """

    foot: Float
    foot_by: Float
    off_2: Float
    off_by: Float
    off_by_2: Float
    lean: Float

    @classmethod
    def of(cls, foot: Float, foot_by: Float, c0: Float, c1: Float, c2: Float, lean: Float) -> "_Foot":
        """By the feet, and the square of the distance from this cone's start, c0 + c1 x + c2 x^2 of a share x."""
        off = c0 - foot * foot, c1 - 2.0 * foot * foot_by, c2 - foot_by * foot_by
        return cls(foot, foot_by, *off, lean)

    def nearest(self, share: Float) -> Float:
        """Where (...) along the cone, for shares (...) of the other."""
        off_2 = self.off_2 + share * (self.off_by + share * self.off_by_2)
        beyond = self.lean * np.sqrt(np.maximum(off_2, 0.0))
        return np.minimum(np.maximum(self.foot + share * self.foot_by + beyond, 0.0), 1.0)


def _lean(growth_m: Float, square: Float) -> Float:
    """Of cones by their growth and the squares of their lengths: the tangent of half their angle, outwards."""
    return growth_m / np.sqrt(np.maximum(square - growth_m * growth_m, 1e-12))
