"""Rays against round cones: two spheres and the cone that touches both, which flesh on a bone nearly is.

A ray o + t d (d of unit length) meets the side where k2 t^2 + 2 k1 t + k0 = 0 with a foot between the spheres, or else
one of the two spheres; the body is convex and holds both, so the first of all hits is its surface. (The quadric is
that of Quilez, "Round cone - intersection".)
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from common.arrays import Float, Int

Real = npt.NDArray[np.floating[Any]]  # single precision for pictures, double for truth

_ALONG = 1e-6  # a ray within the cone's own angle of its axis meets the spheres only


@dataclass(frozen=True, slots=True, eq=False)
class Cones:
    """B round cones.

    Attributes:
        start_m, stop_m: Centres of the spheres (B, 3) [m].
        start_radius_m, stop_radius_m: Their radii (B,) [m].
    """

    start_m: Float
    stop_m: Float
    start_radius_m: Float
    stop_radius_m: Float

    def of(self, bodies: slice) -> "Cones":
        """Some of them."""
        return Cones(
            self.start_m[bodies], self.stop_m[bodies], self.start_radius_m[bodies], self.stop_radius_m[bodies]
        )

    def normals(self, body: Int, points: Real) -> Float:
        """Outward unit normals (N, 3) at surface points (N, 3) [m] of the bodies `body` (N,)."""
        foot, start = self.feet(body, points), self.start_m[body]
        out = points - start - foot[:, None] * (self.stop_m - self.start_m)[body]
        out /= np.sqrt(np.einsum("ij,ij->i", out, out))[:, None]
        return out

    def feet(self, body: Int, points: Real) -> Float:
        """Where along the axis (0 ... 1) the normals at surface points (N, 3) [m] of the bodies (N,) begin, (N,)."""
        axis = self.stop_m - self.start_m
        narrowing = self.start_radius_m - self.stop_radius_m
        square = np.einsum("ij,ij->i", axis, axis)
        # On the side the normal leans by half the angle of the cone.
        shift, scale = self.start_radius_m * narrowing, 1.0 / np.maximum(square - narrowing**2, 1e-12)
        along = np.einsum("ij,ij->i", points - self.start_m[body], axis[body])
        return np.clip((along - shift[body]) * scale[body], 0.0, 1.0)


def distances(cones: Cones, origin: Float, directions: Real) -> Real:
    """How far along rays (N, 3) of unit length from one origin (3,) [m] each body begins, (N, B) [m]; inf: not hit.

    In the precision of `directions`.
    """
    kind = directions.dtype
    axis = cones.stop_m - cones.start_m
    r1, r2 = cones.start_radius_m, cones.stop_radius_m
    narrowing = r1 - r2
    away, beyond = origin - cones.start_m, origin - cones.stop_m
    m0, m1 = (axis * axis).sum(1), (axis * away).sum(1)
    m5, m7 = (away * away).sum(1), (beyond * beyond).sum(1)
    d2 = m0 - narrowing**2
    k0 = d2 * m5 - m1**2 + 2.0 * m1 * narrowing * r1 - m0 * r1**2
    lean, shift, c1, c2 = (
        x.astype(kind) for x in (narrowing * r1 - m1, m1 - r1 * narrowing, m5 - r1**2, m7 - r2**2)
    )
    d2, k0 = d2.astype(kind), k0.astype(kind)
    m2, m3 = directions @ axis.T.astype(kind), directions @ away.T.astype(kind)
    with np.errstate(invalid="ignore", divide="ignore"):
        k2 = d2 - m2 * m2
        k1 = d2 * m3 + m2 * lean
        side = (-np.sqrt(k1 * k1 - k0 * k2) - k1) / k2
        foot = shift + side * m2
        side[~((foot > 0.0) & (foot < d2) & (k2 > _ALONG * d2))] = np.inf
        first = -m3 - np.sqrt(m3 * m3 - c1)
        m3 -= m2
        second = -m3 - np.sqrt(m3 * m3 - c2)
    best = np.fmin(np.fmin(first, second), side)
    best[~(best > 0.0)] = np.inf
    return best
