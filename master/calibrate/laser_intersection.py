"""Intersect the laser's fan with the skin of a finger, as the camera sees it.

The skin (`common.hand.skin`) is cut by a fan of rays from the laser; each lights what it meets first, the
nearest intersection of Kim et al. 2012. What of the line the camera sees is kept, and its centroid in the
image is put back on the plane: that is what the sensing calls the laser point. Other fingers, which may cover
it, are ignored.

**Smooth.** Whoever inverts it follows the point over hundredths of a degree, so nothing may jump by a ray.
The fan ends at the two tangents of the finger and its rays are densest there (Chebyshev's nodes): a grazing
ray moves along the skin with the root of its angle. Where the line goes out of the camera's sight, the chord
between the last ray that is seen and the first that is not counts by share: as far as the edge of the phalanx
that hides the rest, or of its own.

Arrays within have the N fingers last: what is done is done to all of them.
"""

from copy import copy
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.tapered_capsules import Capsules, first_hits, terms
from common.geometry.transforms import transform
from common.hand.skin import ROOT, PalmarSurface
from master.estimator.sensors import PlaneAxes
from master.rig.setup import WristSetup


@dataclass(frozen=True, slots=True, eq=False)
class LaserLine:
    """The lit and seen line on fingers (...)."""

    point_m: Float  # (..., 2) its centroid on the plane (across, along) [m]; NaN where the laser misses
    length_px: Float  # (...) of it in the undistorted image
    place: Float  # (...) mean number of the cone that it lies on; NaN where the laser misses


class LaserIntersection:
    """Intersection of one hand's fingers with one device's laser."""

    def __init__(self, setup: WristSetup, rays: int = 64) -> None:
        self._setup, self._surface, self._axes = setup, PalmarSurface.of(setup.model), PlaneAxes.of(setup)
        inside = 1.0 - 1e-5  # of the fan between its tangents, where rays surely meet the finger
        self._nodes = -inside * np.cos(np.pi * np.arange(rays) / (rays - 1))

    def flexed(self, setup: WristSetup) -> "LaserIntersection":
        """The same hand before another palm pose of this device."""
        other = copy(self)
        other._setup = setup
        return other

    def __call__(self, angles_rad: Float) -> tuple[Float, Float, Float]:
        """Points (5, C, A, 2) [m], lengths and places (5, C, A) for angles (C, A, 5, 4).

        As of `LaserLine`.
        """
        spheres = self._surface.spheres(self._setup.model.chains(angles_rad))
        spheres = np.moveaxis(transform(self._setup.T_camera_palm, spheres), 2, 0)  # (5, C, A, K, 3)
        found = [self.line(spheres[f], self._surface.radius_m[f], np.bool_(f == 0)) for f in range(5)]
        return (
            np.stack([line.point_m for line in found]),
            np.stack([line.length_px for line in found]),
            np.stack([line.place for line in found]),
        )

    def line(self, spheres: Float, radius: Float, thumb: Bool | np.bool_) -> LaserLine:
        """The laser line on fingers given as spheres.

        Spheres (..., K, 3) [m], camera frame, of radii (..., K), thumbs or not (...).
        """
        batch, spheres = spheres.shape[:-2], spheres.reshape(-1, *spheres.shape[-2:])
        radius = np.broadcast_to(radius, (*batch, spheres.shape[1])).reshape(-1, spheres.shape[1])
        thumb = np.broadcast_to(thumb, batch).ravel()
        laser = self._setup.laser_m[:, None, None]
        chain = Capsules(spheres[:, :-1], spheres[:, 1:], radius[:, :-1], radius[:, 1:])
        known = _known(chain, self._setup.laser_m)
        rays, broad = self._fan(spheres, radius, known), 2.0 * radius.max(axis=1)
        hits = _hits(known, rays)
        body, far = hits.argmin(axis=0), hits.min(axis=0)
        # What the metacarpal of the thumb carries is its ball, and no finger.
        lit = np.isfinite(far) & ((body >= ROOT - 1) | ~thumb)
        points = laser + np.where(lit, far, 1.0) * rays
        distance = np.sqrt((points * points).sum(axis=0))
        lines_of_sight, from_camera = points / distance, _known(chain, np.zeros(3))
        before = _hits(from_camera, lines_of_sight)
        seen_at = before.min(axis=0)
        seen_m = 3e-4  # a lit point this near behind the first the camera sees is seen
        # How clearly it is seen [m]: at most _SEEN_M, and not at all below 0.
        clear = np.where(lit, np.minimum(seen_at - distance, 0.0) + seen_m, -np.inf)
        step = points[:, 1:] - points[:, :-1]
        whole = lit[1:] & lit[:-1]
        # share of the finger's breadth that one chord may span: more is a jump from part to part
        whole &= (step * step).sum(axis=0) < (0.25 * broad) ** 2
        first, last = _seen_part(clear[:-1], clear[1:])
        edges = np.nonzero(whole & ((clear[1:] > 0.0) != (clear[:-1] > 0.0)))
        _at_edge(first, last, edges, clear, lines_of_sight, before, from_camera)
        image = points[:2] / points[2]
        step = image[:, 1:] - image[:, :-1]
        weight = np.where(whole, np.sqrt((step * step).sum(axis=0)) * (last - first), 0.0)
        total = weight.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = weight / total
        middle = image[:, :-1] + 0.5 * (first + last) * step
        ray = np.ones((len(total), 3))
        ray[:, :2] = (share * middle).sum(axis=1).T
        point = ray * (self._setup.offset_m / (ray @ self._setup.normal))[:, None]
        place = (share * body[1:]).sum(axis=0).reshape(batch)
        length = (total * self._setup.optics.matrix[0, 0]).reshape(batch)
        return LaserLine(self._axes.flat(point).reshape(*batch, 2), length, place)

    def _fan(self, spheres: Float, radius: Float, known: Float) -> Float:
        """Rays (3, R, N) in the laser plane from one tangent of each finger to the other."""
        low, high = self._tangents(spheres, radius, known)
        angle = 0.5 * (low + high) + 0.5 * (high - low) * self._nodes[:, None]
        across, along = self._axes.axes[..., None, None]
        return np.sin(angle) * across + np.cos(angle) * along

    def _tangents(self, spheres: Float, radius: Float, known: Float) -> tuple[Float, Float]:
        """Angles (N,) [rad] in the plane of the rays that touch a finger; 0: none does.

        The plane cuts a sphere in a circle. It touches the side of a cone where the discriminant of its
        quadric (`common.geometry.tapered_capsules`), for directions (s, c) the form A s^2 + 2 B s c + C c^2,
        is 0.
        """
        flat = self._axes.flat(spheres)
        height = spheres @ self._setup.normal - self._setup.offset_m
        with np.errstate(invalid="ignore", divide="ignore"):
            angle = np.arctan2(flat[..., 0], flat[..., 1])
            room = np.arcsin(np.sqrt((radius**2 - height**2) / np.vecdot(flat, flat)))
            sides = self._sides(known)
            low = np.fmin.reduce(np.concatenate([(angle - room).T, *sides]), axis=0)
            high = np.fmax.reduce(np.concatenate([(angle + room).T, *sides]), axis=0)
        return np.nan_to_num(low), np.nan_to_num(high)

    def _sides(self, known: Float) -> tuple[Float, Float]:
        """Angles (K - 1, N) of both rays that touch the side of each cone; NaN: none."""
        d2, k0, lean, shift = known[6:10]
        axis = np.tensordot(self._axes.axes, known[:3], 1)  # (2, K - 1, N): across, along
        slope = d2 * np.tensordot(self._axes.axes, known[3:6], 1) + lean * axis
        a, c = slope * slope - k0 * (d2 - axis * axis)
        b = slope[0] * slope[1] + k0 * axis[0] * axis[1]
        root = np.sqrt(b * b - a * c)
        out: list[Float] = []
        for tangent in ((-b - root) / a, (-b + root) / a):
            cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
            sine = tangent * cosine
            towards = sine * axis[0] + cosine * axis[1]
            reach = (sine * slope[0] + cosine * slope[1]) / (towards * towards - d2)
            foot = shift + reach * towards
            out.append(np.where((reach > 0.0) & (foot > 0.0) & (foot < d2), np.arctan(tangent), np.nan))
        return out[0], out[1]


def _known(chain: Capsules, origin: Float) -> Float:
    """The terms (12, K - 1, N) of chains of cones (N, K - 1), seen from a point."""
    return np.ascontiguousarray(np.swapaxes(terms(chain, origin, np.float64), 1, 2))


def _hits(known: Float, rays: Float) -> Float:
    """Distance (K - 1, R, N) of cones along rays (3, R, N), by terms; inf: missed."""
    hits: Float = first_hits(known[:, :, None], rays[:, None])
    return hits


def _seen_part(here: Float, there: Float) -> tuple[Float, Float]:
    """Visible part, first and last place, of chords by the clearance at their ends."""
    with np.errstate(invalid="ignore", divide="ignore"):
        gone = here / (here - there)
    edges = (here > 0.0) != (there > 0.0)
    first = np.where(here > 0.0, 0.0, np.where(edges, gone, 1.0))
    return first, np.where(there > 0.0, 1.0, np.where(edges, gone, 0.0)).clip(min=first)


def _at_edge(
    first: Float,
    last: Float,
    edges: tuple[Int, ...],
    clear: Float,
    lines_of_sight: Float,
    before: Float,
    from_camera: Float,
) -> None:
    """Clip occluded chords at the edge of the occluding part of the finger.

    Args:
        first, last: (R - 1, N) seen part of each chord, which is changed.
        edges: Indices of the chords of which one end is seen.
        clear: (R, N) how clearly rays are seen.
        lines_of_sight: (3, R, N) unit rays of the camera.
        before: (K - 1, R, N) where the cones begin on them.
        from_camera: (12, K - 1, N) terms of the cones.
    """
    chord, pose = edges
    if not len(chord):
        return
    rises = clear[chord + 1, pose] > 0.0
    hidden, seen = np.where(rises, chord, chord + 1), np.where(rises, chord + 1, chord)
    body = before[:, hidden, pose].argmin(axis=0)
    known = from_camera[:, body, pose]
    inside, foot = _depths(known, lines_of_sight[:, hidden, pose])
    outside, _ = _depths(known, lines_of_sight[:, seen, pose])
    crossed = (inside > 0.0) & (outside < 0.0)
    crossed[2] &= (foot > 0.0) & (foot < known[6])
    share = np.where(crossed, outside / np.where(crossed, outside - inside, 1.0), np.inf).min(axis=0)
    # Where the part's own surface turns away from the camera no ray passes it by, and clearness measures how far.
    edge = np.isfinite(share)
    up, down = edge & rises, edge & ~rises
    first[chord[up], pose[up]] = 1.0 - share[up]
    last[chord[down], pose[down]] = share[down]


def _depths(known: Float, rays: Float) -> tuple[Float, Float]:
    """Depths (3, M) of rays (3, M) in spheres and side of cones; below 0: beside.

    Cones of terms (12, M). Also the feet (M,) of hits of the side, as in `common.geometry.tapered_capsules`.
    """
    d2, k0, lean, shift, c1, c2 = known[6:]
    m2, m3 = (rays * known[:3]).sum(axis=0), (rays * known[3:6]).sum(axis=0)
    k1, k2 = d2 * m3 + m2 * lean, d2 - m2 * m2
    side = k1 * k1 - k0 * k2
    with np.errstate(invalid="ignore", divide="ignore"):
        foot = shift - (np.sqrt(np.maximum(side, 0.0)) + k1) / k2 * m2
    return np.stack([m3 * m3 - c1, (m3 - m2) ** 2 - c2, side]), foot
