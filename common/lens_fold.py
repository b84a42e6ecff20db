"""Whether a lens folds its picture: OpenCV's distortion is a polynomial, and beyond some radius it turns back.

Where it turns back two directions have one pixel, and no pixel has a direction any more. The map (x, y) -> (x', y') of
normalised points to distorted ones can be inverted as far from the axis as its Jacobian, which is symmetric, stays
positive definite; along each direction from the axis that must be so until the picture is left. Its least eigenvalue is
how much a small thing is shrunk against one on the axis.

How far that is: a radial map r (1 + k1 r^2 + k2 r^4 + k3 r^6) that rises has a slope that is a nonnegative even
polynomial of degree 6 with the value 1 on the axis, and the least integral of such a polynomial over [-R, R] is
1 / (K(0, 0)) R with the Christoffel-Darboux kernel of the Legendre polynomials up to degree 3, K(0, 0) = 9 / 8. So it
has reached at least 4/9 R at R, and beyond 9/4 of the picture's distorted radius nothing of the picture is left.
"""

import math
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float

_DIRECTIONS, _RADII = 64, 256
_LEAST = 0.01  # eigenvalue: a pixel there covers a hundred times the angle of one on the axis
_REACH = 9.0 / 4.0 * 1.1  # a tenth more for the tangential terms


class Lens(NamedTuple):
    """Size of the picture [px], fx, fy, cx, cy [px], and k1, k2, p1, p2, k3."""

    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float]


class Fold(NamedTuple):
    """Where a lens turns back: the pixel, and its distance from the principal point [px]."""

    u: float
    v: float
    radius_px: float


def fold_of(lens: Lens) -> Fold | None:
    """The fold nearest to the axis inside the picture; None: there is none.

    Where the principal point lies outside the picture, what is between them counts as well.
    """
    low, high = _borders(lens)
    corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
    reach = _REACH * float(np.hypot(*corners.T).max())
    angles = np.concatenate(
        [np.linspace(0.0, math.tau, _DIRECTIONS, endpoint=False), np.arctan2(corners[:, 1], corners[:, 0])]
    )
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    radii = np.linspace(0.0, reach, _RADII)
    shrunk = _least_eigenvalue(lens, radii[:, None, None] * ways)
    bad = shrunk <= _LEAST
    first = np.where(bad.any(axis=0), bad.argmax(axis=0), 0)
    turns = np.flatnonzero(first)
    if len(turns) == 0:
        return None
    before, at = shrunk[first[turns] - 1, turns], shrunk[first[turns], turns]
    share = (before - _LEAST) / (before - at)
    r = radii[first[turns] - 1] + share * (radii[1] - radii[0])
    seen = _distorted(lens, r[:, None] * ways[turns])
    inside = _within(seen, low, high)
    if not inside.any():
        return None
    pixels = seen[inside] * lens.focal_px
    nearest = pixels[np.hypot(*pixels.T).argmin()]
    u, v = (nearest + lens.centre_px).tolist()
    return Fold(u, v, float(np.hypot(*nearest)))


def _borders(lens: Lens) -> tuple[Float, Float]:
    """Corners (2,), (2,) of the picture as normalised distorted points."""
    focal, centre = np.array(lens.focal_px), np.array(lens.centre_px)
    return (-0.5 - centre) / focal, (np.array(lens.size_px) - 0.5 - centre) / focal


def _within(points: Float, low: Float, high: Float) -> Bool:
    """Whether points (N, 2) lie in the picture or between it and the axis: further out on their ray is the picture."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = low / points, high / points
    near, far = np.fmin(a, b), np.fmax(a, b)
    beside = (points == 0.0) & ((low > 0.0) | (high < 0.0))
    enters = np.where(points == 0.0, -np.inf, near).max(axis=-1)
    leaves = np.where(points == 0.0, np.inf, far).min(axis=-1)
    return (leaves >= np.maximum(enters, 1.0)) & ~beside.any(axis=-1)


def _distorted(lens: Lens, xy: Float) -> Float:
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


def _least_eigenvalue(lens: Lens, xy: Float) -> Float:
    """Smaller eigenvalue of the Jacobian (...) of `_distorted` at points (..., 2)."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = xy[..., 0], xy[..., 1]
    s = x * x + y * y
    g = 1.0 + s * (k1 + s * (k2 + s * k3))
    rise = 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))  # of g by s, twice
    xx = g + rise * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    yy = g + rise * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    xy_ = rise * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    return 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy_)
