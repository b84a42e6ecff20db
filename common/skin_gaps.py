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
    shape = apart.shape[:-1]
    s, t = np.full(shape, 0.5), np.full(shape, 0.5)
    for _ in range(_ROUNDS):
        s = _nearest(apart + t[..., None] * b.along_m, a.along_m, a.growth_m)
        t = _nearest(s[..., None] * a.along_m - apart, b.along_m, b.growth_m)
    from_a = a.start_m + s[..., None] * a.along_m
    between = b.start_m + t[..., None] * b.along_m - from_a
    length = np.sqrt(np.vecdot(between, between))
    way = between / np.maximum(length, 1e-9)[..., None]
    radius_a, radius_b = a.radius_m + s * a.growth_m, b.radius_m + t * b.growth_m
    gap = length - radius_a - radius_b
    middle = from_a + (radius_a + 0.5 * gap)[..., None] * way
    return Gaps(gap, s, t, middle, way)


def _nearest(point_m: Float, along_m: Float, growth_m: Float) -> Float:
    """Where (...) along a cone from 0 its skin is nearest to points (..., 3) outside: the foot, and a little on to
    where it is thicker."""
    square = np.vecdot(along_m, along_m)
    foot = np.vecdot(point_m, along_m) / square
    off = point_m - foot[..., None] * along_m
    lean = growth_m / np.sqrt(np.maximum(square - growth_m**2, 1e-12))
    return np.clip(foot + lean * np.sqrt(np.vecdot(off, off) / square), 0.0, 1.0)
