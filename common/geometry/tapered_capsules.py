"""Intersection of rays with round cones: two spheres and the cone about both.

A ray o + t d (d of unit length) meets the side where k2 t^2 + 2 k1 t + k0 = 0 with a foot between the spheres, or else
one of the two spheres; the body is convex and holds both, so the first of all hits is its surface. (The quadric is
that of Quilez, "Round cone - intersection".)
"""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from common.arrays import Float, Int

Plane = npt.NDArray[np.float32]
Real = TypeVar("Real", Float, Plane)  # double for truth, single for pictures


@dataclass(frozen=True, slots=True, eq=False)
class Capsules:
    """B round cones, or several hands of them: (..., B).

    Attributes:
        start_m, stop_m: Centres of the spheres (B, 3) [m].
        start_radius_m, stop_radius_m: Their radii (B,) [m].
    """

    start_m: Float
    stop_m: Float
    start_radius_m: Float
    stop_radius_m: Float

    def of(self, *at: int | slice | Int) -> "Capsules":
        """Some of them, by indices into the last axes, such as (finger, segment)."""
        end, radius = (..., *at, slice(None)), (..., *at)
        return Capsules(
            self.start_m[end], self.stop_m[end], self.start_radius_m[radius], self.stop_radius_m[radius]
        )

    def before(self, others: "Capsules") -> "Capsules":
        """These and then others."""
        return Capsules(
            np.concatenate([self.start_m, others.start_m]),
            np.concatenate([self.stop_m, others.stop_m]),
            np.concatenate([self.start_radius_m, others.start_radius_m]),
            np.concatenate([self.stop_radius_m, others.stop_radius_m]),
        )

    def normals(self, body: Int, points: Real) -> Real:
        """Outward unit normals (N, 3) at surface points (N, 3) of bodies `body` (N,)."""
        kind = points.dtype
        axis = self.stop_m - self.start_m
        narrowing = self.start_radius_m - self.stop_radius_m
        # On the side the normal leans by half the angle of the cone, so its foot is not the nearest point of the axis.
        scale = 1.0 / np.maximum((axis * axis).sum(axis=1) - narrowing**2, 1e-12)
        table = np.concatenate([self.start_m, axis, axis * scale[:, None]], axis=1)
        shift = (self.start_radius_m * narrowing * scale).astype(kind)
        own = table.astype(kind)[body]
        out = points - own[:, :3]
        foot = np.einsum("ij,ij->i", out, own[:, 6:]) - shift[body]
        out -= np.clip(foot, 0.0, 1.0)[:, None] * own[:, 3:6]
        out /= np.sqrt(np.einsum("ij,ij->i", out, out))[:, None]
        return out


def terms(capsules: Capsules, origin: Float, kind: type[np.float32] | type[np.float64]) -> Any:
    """Terms (12, ..., B) that `first_hits` needs, for rays from one origin (3,)."""
    axis = capsules.stop_m - capsules.start_m
    r1, narrowing = capsules.start_radius_m, capsules.start_radius_m - capsules.stop_radius_m
    away, beyond = origin - capsules.start_m, origin - capsules.stop_m
    m0, m1, m5 = (np.vecdot(a, b) for a, b in ((axis, axis), (axis, away), (away, away)))
    d2 = m0 - narrowing**2
    k0 = d2 * m5 - m1**2 + 2.0 * m1 * narrowing * r1 - m0 * r1**2
    ends = m5 - r1**2, np.vecdot(beyond, beyond) - capsules.stop_radius_m**2
    ways = np.moveaxis(axis, -1, 0), np.moveaxis(away, -1, 0)
    return np.array((*ways[0], *ways[1], d2, k0, narrowing * r1 - m1, m1 - r1 * narrowing, *ends), dtype=kind)


def first_hits(known: Any, directions: Real) -> Real:
    """How far along unit rays (3, ...) their body begins, (...) [m]; inf: not hit.

    Args:
        known: `terms` of one body (12,), or of the body of each ray (12, ...), or what fits the rays by broadcasting.
        directions: The rays, from the origin of the terms.
    """
    ax, ay, az, wx, wy, wz, d2, k0, lean, shift, c1, c2 = known
    dx, dy, dz = directions
    m2, m3 = dx * ax + dy * ay + dz * az, dx * wx + dy * wy + dz * wz
    with np.errstate(invalid="ignore", divide="ignore"):
        k2 = d2 - m2 * m2
        k1 = d2 * m3 + m2 * lean
        side = (-np.sqrt(k1 * k1 - k0 * k2) - k1) / k2
        foot = shift + side * m2
        along = 1e-6  # a ray within the cone's own angle of its axis meets the spheres only
        side = np.where((foot > 0.0) & (foot < d2) & (k2 > along * d2), side, np.inf)
        first = -m3 - np.sqrt(m3 * m3 - c1)
        m3 -= m2
        best = np.fmin(np.fmin(first, side), -m3 - np.sqrt(m3 * m3 - c2))
    hit: Any = np.where(best > 0.0, best, np.inf)
    return hit


def distances(capsules: Capsules, origin: Float, directions: Float) -> Float:
    """Distance (N, B) [m] along rays (N, 3) at which each body begins; inf: not hit."""
    middle = 0.5 * (capsules.start_m + capsules.stop_m) - origin
    half = 0.5 * np.linalg.norm(capsules.stop_m - capsules.start_m, axis=1)
    radius = half + np.maximum(capsules.start_radius_m, capsules.stop_radius_m)
    along = directions @ middle.T
    # Only bodies whose spheres about them are met.
    ray, body = np.nonzero((middle * middle).sum(axis=1) - along * along < radius**2)
    out = np.full(along.shape, np.inf)
    out[ray, body] = first_hits(terms(capsules, origin, np.float64)[:, body], directions[ray].T)
    return out
