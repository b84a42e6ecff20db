"""OpenCV's distortion as a map of normalised points: its fold and its inverse.

It is a polynomial, and beyond some radius it may turn back: there two directions have one pixel, and no pixel beyond
has a direction at all. The map (x, y) -> (x', y') can be inverted as far from the axis as its Jacobian, a symmetric
matrix, stays positive definite; along each direction from the axis that must be so until the picture is left. Its
least eigenvalue is how much a small thing is shrunk against one on the axis.

How far that is: a radial map r (1 + k1 r^2 + k2 r^4 + k3 r^6) that rises has a slope that is a nonnegative even
polynomial of degree 6 with the value 1 on the axis, and the least integral of such a polynomial over [-R, R] is
1 / (K(0, 0)) R with the Christoffel-Darboux kernel of the Legendre polynomials up to degree 3, K(0, 0) = 9 / 8. So it
has reached at least 4/9 R at R, and beyond 9/4 of the picture's distorted radius nothing of the picture is left.
"""

import math
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float

_RADII = 256
_REACH = 9.0 / 4.0 * 1.1  # a tenth more for the tangential terms


class Lens(NamedTuple):
    """Size of the picture [px], fx, fy, cx, cy [px], and k1, k2, p1, p2, k3."""

    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]


class Fold(NamedTuple):
    """Pixel where a lens turns back, and its distance from the principal point [px]."""

    u: float
    v: float
    radius_px: float


def fold_of(lens: Lens) -> Fold | None:
    """The fold nearest to the axis inside the picture; None: there is none.

    Where the principal point lies outside the picture, what is between them counts as well.
    """
    low, high = _borders(lens)
    corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
    directions = 360
    angles = np.concatenate(
        [np.linspace(0.0, math.tau, directions, endpoint=False), np.arctan2(corners[:, 1], corners[:, 0])]
    )
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    radii = np.linspace(0.0, _reach(lens), _RADII)
    shrunk = _least_eigenvalue(lens, radii[:, None, None] * ways)
    least = 0.01  # eigenvalue: a pixel there covers a hundred times the angle of one on the axis
    bad = shrunk <= least
    first = np.where(bad.any(axis=0), bad.argmax(axis=0), 0)
    folds = np.flatnonzero(first)
    if len(folds) == 0:
        return None  # nowhere around the picture
    before, at = shrunk[first[folds] - 1, folds], shrunk[first[folds], folds]
    share = (before - least) / (before - at)
    r = radii[first[folds] - 1] + share * (radii[1] - radii[0])
    seen = distorted(lens, r[:, None] * ways[folds])
    inside = seen[_within(seen, low, high)]
    if not len(inside):  # between two of the directions a fold may still cut off the tip of a corner
        inside = corners[np.isnan(undistorted(lens, corners)).any(axis=1)]
    if not len(inside):
        return None
    pixels = inside * lens.focal_px
    nearest = pixels[np.hypot(*pixels.T).argmin()]
    u, v = (nearest + lens.centre_px).tolist()
    return Fold(u, v, float(np.hypot(*nearest)))


def _borders(lens: Lens) -> tuple[Float, Float]:
    """Corners (2,), (2,) of the picture as normalised distorted points."""
    focal, centre = np.array(lens.focal_px), np.array(lens.centre_px)
    return (-0.5 - centre) / focal, (np.array(lens.size_px) - 0.5 - centre) / focal


def undistorted(lens: Lens, seen: Float) -> Float:
    """Normalised points (N, 2) of distorted ones (N, 2), by Newton's method.

    Where it does not arrive at once, and the point is in the picture, it goes there from the axis in small steps. NaN:
    no point that the lens shows before it folds.
    """
    r, shown = _radial(lens)
    rising = int(np.argmax(np.append(np.diff(shown) <= 0.0, True))) + 1
    length = np.hypot(seen[:, 0], seen[:, 1])
    tolerance_px = 1e-10 * _reach(lens)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ratio = np.interp(length, shown[:rising], r[:rising]) / length  # but for tangential terms
        start = seen * np.where(length > 0.0, ratio, 1.0)[:, None]
        # of Newton: quadratic from a start within a thousandth, slower where the picture is shrunk
        steps = 12
        xy, settled = _newton(lens, seen, start, steps, tolerance_px)
        if not settled.all():
            low, high = _borders(lens)
            rest = np.flatnonzero(~settled & ((seen >= low) & (seen <= high)).all(axis=1))
            way = np.zeros((len(rest), 2))
            parts, part_steps = 32, 2  # of the way from the axis, and of Newton in each
            for part in np.linspace(0.0, 1.0, parts + 1)[1:] if len(rest) else ():
                way, _ = _newton(lens, part * seen[rest], way, part_steps, tolerance_px)
            xy[rest], settled[rest] = _newton(lens, seen[rest], way, steps, tolerance_px)
    return np.where(settled[:, None], xy, np.nan)


def _newton(lens: Lens, seen: Float, start: Float, steps: int, tolerance_px: float) -> tuple[Float, Bool]:
    """Go from `start` (N, 2) to the points whose distorted ones are `seen`.

    Returns them (N, 2), and which have arrived (N,): nearer than `tolerance_px`, before the lens folds.
    """
    xy = start.copy()
    for _ in range(steps):
        off_x, off_y = off = (seen - distorted(lens, xy)).T
        if not (np.abs(off) > tolerance_px).any():
            break
        xx, yy, mixed = _jacobian(lens, xy)
        det = xx * yy - mixed * mixed
        xy += np.stack([yy * off_x - mixed * off_y, xx * off_y - mixed * off_x], axis=-1) / det[:, None]
    near = (np.abs(seen - distorted(lens, xy)) <= tolerance_px).all(axis=1)
    return xy, near & (_least_eigenvalue(lens, xy) > 0.0)


def contraction(lens: Lens) -> float:
    """Largest share of an error in the picture that an iteration step leaves.

    With x' = g(r) x + t(x), the iteration x <- (x' - t(x)) / g(r) of `cv2.undistortPoints` multiplies an error by
    1 - J / g, where J is the Jacobian of the distortion, tangential terms t among it. From 1 on it diverges.
    """
    coarse = 48  # directions and radii where what is looked for has a wide margin
    angles = np.linspace(0.0, math.tau, coarse, endpoint=False)
    xy = np.linspace(0.0, _reach(lens), coarse)[:, None, None] * np.stack(
        [np.cos(angles), np.sin(angles)], axis=-1
    )
    k1, k2, _, _, k3 = lens.distortion
    s = (xy * xy).sum(axis=-1)
    g = np.maximum(1.0 + s * (k1 + s * (k2 + s * k3)), 1e-9)
    xx, yy, mixed = _jacobian(lens, xy)
    left = np.abs(1.0 - 0.5 * (xx + yy) / g) + np.hypot(0.5 * (xx - yy), mixed) / g
    inside = np.linalg.norm(distorted(lens, xy), axis=-1) <= _reach(lens) / _REACH
    return float(left[inside].max())


def _radial(lens: Lens) -> tuple[Float, Float]:
    """Radii (R,), and radii as the lens distorts them without tangential terms (R,)."""
    k1, k2, _, _, k3 = lens.distortion
    r = np.linspace(0.0, _reach(lens), _RADII)
    s = r * r
    return r, r * (1.0 + s * (k1 + s * (k2 + s * k3)))


def _reach(lens: Lens) -> float:
    """Normalised radius beyond which nothing of the picture is left."""
    low, high = _borders(lens)
    return _REACH * float(np.hypot(*np.maximum(np.abs(low), np.abs(high))))


def _within(points: Float, low: Float, high: Float) -> Bool:
    """Whether points (N, 2) lie in the picture, or between it and the axis."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = low / points, high / points
    near, far = np.fmin(a, b), np.fmax(a, b)
    outside = (points == 0.0) & ((low > 0.0) | (high < 0.0))
    enters = np.where(points == 0.0, -np.inf, near).max(axis=-1)
    leaves = np.where(points == 0.0, np.inf, far).min(axis=-1)
    return (leaves >= np.maximum(enters, 1.0)) & ~outside.any(axis=-1)


def distorted(lens: Lens, xy: Float) -> Float:
    """Distorted points (..., 2) of normalised points (..., 2)."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = xy[..., 0], xy[..., 1]
    s = x * x + y * y
    g = 1.0 + s * (k1 + s * (k2 + s * k3))
    return np.stack(
        [
            x * g + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
            y * g + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _jacobian(lens: Lens, xy: Float) -> tuple[Float, Float, Float]:
    """Derivatives (...) of `distorted` at (..., 2): x' by x, y' by y, x' by y."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = xy[..., 0], xy[..., 1]
    s = x * x + y * y
    g = 1.0 + s * (k1 + s * (k2 + s * k3))
    rise = 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))  # of g by s, twice
    xx = g + rise * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    yy = g + rise * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, yy, rise * x * y + 2.0 * p1 * x + 2.0 * p2 * y


def _least_eigenvalue(lens: Lens, xy: Float) -> Float:
    """Smaller eigenvalue (...) of the Jacobian at points (..., 2)."""
    xx, yy, mixed = _jacobian(lens, xy)
    return 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), mixed)
