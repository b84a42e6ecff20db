"""Fit the outline of a marker whose colour fills only a part of it.

A lit ball is no flat colour: its top turns pale, its dark side loses the hue, a finger lies in front of it. Its
outline is still an edge of the picture. A circle is sought with edges in as many directions as possible:

1. About the convex hull of the mask the picture is sampled in polar coordinates. The radial gradient of its three
   channels is the strength of an edge, limited, so that one strong edge does not outvote a faint outline.
2. Circles near the hull are rated by the mean strength along them, coarse to fine (a Hough transform, Duda and Hart
   1972, read along each circle).
3. The strongest edge near the circle on each ray, with Cauchy weights, gives it by iterated least squares.

A circle that holds too little of the mask, or has edges in too few directions, is no answer. An outline costs as much
as a frame of clear markers, so it is sought where the contrast is low, and of large clear markers when they are
found, from time to time, and as long as the outline holds more than the colour.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from common.arrays import Bool, Float, Float32, Image, Int
from slave.markers.centroid import Measured
from slave.markers.quality import CLEAR_CONTRAST

RAYS, RADII = 64, 56  # samples of the picture: directions, and on each
NEAREST, FARTHEST = 0.45, 1.85  # where they begin and end, in radii of the hull
STRONG = 80  # percentile of the gradients that counts as one edge
SHIFTS = np.linspace(-0.45, 0.45, 10)  # of the centre, in radii of the hull
SIZES = np.linspace(0.85, 1.5, 14)
FINER = 0.06, 0.024  # half widths of the finer searches
_STEP = (FARTHEST - NEAREST) / (RADII - 1)
_AT: Float = np.linspace(NEAREST, FARTHEST, RADII)
_RAY = np.arange(RAYS)
_COS, _SIN = np.cos(_RAY * (2.0 * math.pi / RAYS)), np.sin(_RAY * (2.0 * math.pi / RAYS))


class Outline(NamedTuple):
    """A circle about a marker."""

    u: float  # centre u, v [px], distorted image
    v: float
    radius: float  # [px]
    support: float  # share of the directions in which the picture has an edge there, 0..1
    sigma: float  # standard deviation of the centre per axis [px]

    def measured(self, seen: Measured) -> Measured:
        """What was measured, with the place and the moments of the whole disc."""
        square = self.radius * self.radius
        area, moment = math.pi * square, square / 4.0
        return seen._replace(u=self.u, v=self.v, area=area, xx=moment, xy=0.0, yy=moment)


def outline_of(image: Image, seen: Measured) -> Outline | None:
    """Circle about what was measured in (H, W, 3) BGR; None: the picture has none."""
    mask = (seen.window >= 0.5).astype(np.uint8)
    borders, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not borders:
        return None
    moments = cv2.moments(cv2.convexHull(np.concatenate([border.reshape(-1, 2) for border in borders])))
    if moments["m00"] < 1.0:
        return None
    x, y = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    size = math.sqrt(moments["m00"] / math.pi) + 0.5  # the hull ends in the middle of pixels
    strength = _edges(image, seen.left + x, seen.top + y, size)
    du, dv, radius, support, sigma = _fitted(strength, _best(strength))
    x, y, radius = x + size * du, y + size * dv, size * radius
    v, u = np.nonzero(mask)
    inside = np.count_nonzero(np.hypot(u - x, v - y) <= radius + 1.0)
    held = 0.88  # share of the mask that lies inside the circle
    filled = 0.4  # share of the circle that the mask fills
    supported = 0.6  # share of the directions that have an edge of the circle's own
    if support < supported or inside < held * len(u) or inside < filled * math.pi * radius * radius:
        return None
    unseen = 0.1  # of the radius: standard deviation of the centre where no direction had one
    sigma = math.hypot(size * sigma, unseen * (1.0 - support) * radius)
    return Outline(seen.left + x, seen.top + y, radius, support, sigma)


def _edges(image: Image, u: float, v: float, size: float) -> Float32:
    """Strength (RAYS, RADII) of the edges about (u, v) at `_AT` radii of `size` [px]."""
    reach = math.ceil(FARTHEST * size) + 2
    left, top = max(math.floor(u) - reach, 0), max(math.floor(v) - reach, 0)
    part = image[top : math.floor(v) + reach + 1, left : math.floor(u) + reach + 1]
    # of the radius: standard deviation of the blur before the gradient, at least one pixel
    smooth = cv2.GaussianBlur(part, (0, 0), max(1.0, 0.03 * size)).astype(np.float32)
    x, y = u - left + np.outer(_COS, size * _AT), v - top + np.outer(_SIN, size * _AT)
    polar = cv2.remap(
        smooth, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    steep = np.zeros((RAYS, RADII), np.float32)
    steep[:, 1:-1] = np.sqrt(np.square(polar[:, 2:] - polar[:, :-2]).sum(axis=2))
    strong = np.partition(steep.ravel(), steep.size * STRONG // 100)[steep.size * STRONG // 100]
    return steep / np.float32(max(float(strong), 1e-3))


def _grid(*axes: Sequence[float] | Float) -> Float:
    """Return all combinations (N, 3) of the values of three axes."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _distance(circles: Float) -> Float:
    """Return where the rays meet circles (N, 3): distances (N, RAYS) in hull radii."""
    du, dv, radius = circles[:, 0:1], circles[:, 1:2], circles[:, 2:3]
    across = du * _SIN - dv * _COS
    return du * _COS + dv * _SIN + np.sqrt(np.maximum(radius * radius - across * across, 0.0))


def _samples(circles: Float) -> Int:
    """Samples (N, RAYS) on circles (N, 3): indices of the strength, 0 at the ends."""
    place = np.rint((_distance(circles) - NEAREST) / _STEP).astype(np.int64)
    return np.clip(place, 0, RADII - 1) + RADII * _RAY


_COARSE = _grid(SHIFTS, SHIFTS, SIZES)
_COARSE_SAMPLES = _samples(_COARSE)
_FINER = tuple(_grid(*[np.linspace(-half, half, 5)] * 3) for half in FINER)


def _best(strength: Float32) -> Float:
    """Return the circle (du, dv, radius) with the strongest edges, in hull radii."""
    limit = 1.5  # edges: what a stronger one counts
    limited = np.minimum(strength, limit)
    circle: Float = _COARSE[int(np.argmax(limited.take(_COARSE_SAMPLES).sum(axis=1)))]
    for finer in _FINER:
        circles = circle + finer
        circle = circles[int(np.argmax(limited.take(_samples(circles)).sum(axis=1)))]
    return circle


def _fitted(strength: Float32, circle: Float) -> tuple[float, float, float, float, float]:
    """Least squares: centre, radius, support, sigma of the centre, in hull radii."""
    covariance: Float = np.eye(3)
    own: Bool = np.zeros(RAYS, np.bool_)
    rounds = 4
    for iteration in range(rounds):
        x, y, radius = circle.tolist()
        # of the radius: an edge so near to the circle is one of its own
        tolerance = 0.05 * radius * (2.0 if iteration == 0 else 1.0)
        near = np.abs(_AT - _distance(circle[None]).T) <= tolerance + _STEP
        at = np.clip(np.where(near, strength, -1.0).argmax(axis=1), 1, RADII - 2)
        before, here, after = strength[_RAY, at - 1], strength[_RAY, at], strength[_RAY, at + 1]
        curvature = np.minimum(before - 2.0 * here + after, -1e-6)  # a parabola through three samples
        found = _AT[at] + _STEP * np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)
        offset_x, offset_y = found * _COS - x, found * _SIN - y
        distance = np.hypot(offset_x, offset_y)
        residual = distance - radius
        faint = 0.5  # edges: what is weaker is none
        own = (here >= faint) & (np.abs(residual) <= tolerance)
        cauchy = 0.4  # of the tolerance
        weight = np.where(here >= faint, 1.0 / (1.0 + np.square(residual / (cauchy * tolerance))), 0.0)
        jacobian = np.stack([offset_x / distance, offset_y / distance, np.ones(RAYS)], axis=1)
        weighted = jacobian * weight[:, None]
        inverse = np.linalg.inv(weighted.T @ jacobian + 1e-3 * np.eye(3))
        circle = circle + inverse @ (weighted.T @ residual)
        covariance = inverse * np.float64(weight @ np.square(residual) / max(float(weight.sum()) - 3.0, 1.0))
    x, y, radius = circle.tolist()
    sigma = math.sqrt(0.5 * float(covariance[0, 0] + covariance[1, 1]))
    return x, y, radius, float(own.mean()), sigma


def outlines_of(
    image: Image, seen_as: Mapping[int, Measured], due: Collection[int], outlined: set[int], frame: int
) -> dict[int, Outline]:
    """Seek the outlines of one frame, those of the largest first.

    Args:
        image: (H, W, 3) BGR.
        seen_as: Marker row -> its measurement by colour.
        due: Rows of those that were not tracked.
        outlined: Rows of those whose outline held more than their colour of late; kept up to date.
        frame: Number of the frame.

    Returns marker row -> its outline, where that is to be used rather than its colour.
    """
    sought: list[tuple[float, int]] = []
    for m, seen in seen_as.items():
        least_px2 = 60.0  # from which an outline can be distinguished from its pixels
        if seen.area < least_px2 or seen.cut or seen.thin:
            continue
        rarely = 120  # in one frame of so many while its colour fills it,
        large_px2 = 500.0  # from which the outline of one of clear contrast is looked at,
        if seen.contrast < CLEAR_CONTRAST or (
            seen.area >= large_px2 and (m in outlined or m in due or frame % rarely == m % rarely)
        ):
            sought.append((seen.area, m))
    found: dict[int, Outline] = {}
    most = 2  # that are sought in one frame
    for _, m in sorted(sought, reverse=True)[:most]:
        outline = outline_of(image, seen_as[m])
        if outline is not None and _holds_more(outline, seen_as[m]):
            found[m] = outline
            outlined.add(m)
        else:
            outlined.discard(m)
    return found


def _holds_more(outline: Outline, seen: Measured) -> bool:
    """Return whether the outline is used: at clear contrast if sure and larger."""
    if seen.contrast < CLEAR_CONTRAST:
        return True
    sure = 0.8  # and taken with an edge in this share of the directions,
    fuller = 1.08  # and so many times the colour's area
    return outline.support >= sure and math.pi * outline.radius**2 >= fuller * seen.area
