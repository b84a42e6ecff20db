"""Fits of the laws of raw disparity from a sweep of known distances.

Pure fits, (disparity, distance) -> (law, residual).

What is made small is the *relative* error of depth, every distance alike. Two errors add up in a sweep: that of the
disparity, s_x, costs s_x D / a of the depth and grows with the distance; that of the ruler,
s_D, costs s_D / D and shrinks with it. They are equal at D = sqrt(a s_D / s_x): 0.6 m for the published rig (a = 37
m px), 1 mm and 0.1 px, the middle of 20...100 cm. So the relative error is nearly the same everywhere, and equal
weights are nearly the best ones; least squares in disparity would give the nearest points 25 times the weight of the
farthest, which a ruler never deserves. Simulated, 17 distances, mean error of the fitted affine law over 20...100 cm:

    noise              relative   in disparity
    0.1 px             0.044 %    0.039 %
    0.1 px and 1 mm    0.083 %    0.123 %
    0.1 px and 2 mm    0.140 %    0.237 %

The power law has a third reason: it is not the law of two cameras, and misses a yawed pair by 0.3 % on average; equal
relative weights spread that over all distances (max 0.74 %; in disparity 1.1 %, all of it far away). They are also how
the published constants come out: k = 45.28 m for the pair that the published law describes, against 44.05.
"""

from collections.abc import Callable
from math import atan

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from master.fabrik.depth import AffineDisparity, DepthLaw, PowerLaw, ideal_law

Fit = Callable[[Float, Float], tuple[DepthLaw, Float]]


def fit_power_law(disparity: Float, distance: Float) -> tuple[PowerLaw, Float]:
    """D = k x^z by least squares in ln D (Kalbfleisch, eq. 12).

    Args:
        disparity: u_left - u_right [px], (N,), positive, at least two different ones.
        distance: Along the first camera's axis [m], (N,).

    Returns:
        The law, and its relative errors of depth (N,) at these points.
    """
    slope, offset = _line(np.log(disparity), np.log(distance), np.ones_like(distance))
    law = PowerLaw(float(np.exp(offset)), slope)
    return law, relative_error(law, disparity, distance)


def fit_affine_disparity(disparity: Float, distance: Float) -> tuple[AffineDisparity, Float]:
    """Fit x = a / D + x0 by least squares in relative depth.

    An error dx of x is dx D / a of D.

    Args and returns as `fit_power_law`.
    """
    a, x0 = _line(1.0 / distance, disparity, distance)
    law = AffineDisparity(a, x0)
    return law, relative_error(law, disparity, distance)


FITS: dict[str, Fit] = {"power_law": fit_power_law, "affine_disparity": fit_affine_disparity}
"""The laws that are fitted, by the name of their key in the rig file."""


def relative_error(law: DepthLaw, disparity: Float, distance: Float) -> Float:
    """Return the relative depth error of a law.

    (depth by the law - distance) / distance, (N,); NaN where the law has no depth for the disparity.
    """
    return law.depth(disparity) / distance - 1.0


def leave_one_out(fit: Fit, disparity: Float, distance: Float) -> Float:
    """Return the leave-one-out relative error of each point.

    Shape (N,), by the law of all the other points: how accurate the law is for a new distance.
    """
    out = np.empty_like(distance)
    for i in range(distance.size):
        others = np.arange(distance.size) != i
        law, _ = fit(disparity[others], distance[others])
        out[i] = relative_error(law, disparity[i : i + 1], distance[i : i + 1])[0]
    return out


def outliers(disparity: Float, distance: Float) -> Bool:
    """Which points (N,) contradict the others, whichever of the two laws is taken.

    Of the laws through two points each, the one with the least median of squares is taken (Rousseeuw 1984: half of
    the points may be wrong); a point is out beyond three of its robust standard deviations and 1 % of depth.
    """
    power = _least_median(np.log(disparity), np.log(distance), np.ones_like(distance))
    affine = _least_median(1.0 / distance, disparity, distance)
    by_power = np.abs(np.log(distance) - power[0] * np.log(disparity) - power[1])
    by_affine = np.abs(distance * (disparity - affine[1]) / affine[0] - 1.0)
    return _beyond(by_power) & _beyond(by_affine)


def ideal_of(left: CameraModel, right: CameraModel) -> AffineDisparity:
    """Return the law of two perfectly parallel pinhole cameras.

    Of this focal length and baseline (eq. 13).
    """
    baseline_m = float(np.linalg.norm(right.centre - left.centre))
    return ideal_law(baseline_m, 2.0 * atan(0.5 * left.width_px / left.matrix[0, 0]), left.width_px)


def _line(x: Float, y: Float, weight: Float) -> tuple[float, float]:
    """Slope and offset of y = slope x + offset; `weight` multiplies the residuals."""
    rows = np.stack([x, np.ones_like(x)], axis=1) * weight[:, None]
    slope, offset = np.linalg.lstsq(rows, y * weight, rcond=None)[0]
    return float(slope), float(offset)


def _least_median(x: Float, y: Float, weight: Float) -> tuple[float, float]:
    """Return the line through two points with the least median weighted residual.

    Slope and offset.
    """
    i, j = np.triu_indices(x.size, 1)
    max_pairs = 5000  # of points, from which robust laws are drawn: all of them for up to 100 points
    some = slice(None, None, -(-i.size // max_pairs))
    i, j = i[some], j[some]
    slope = (y[j] - y[i]) / (x[j] - x[i])
    offset = y[i] - slope * x[i]
    residual = np.abs(y - slope[:, None] * x - offset[:, None]) * weight
    best = int(np.argmin(np.median(residual, axis=1)))
    return float(slope[best]), float(offset[best])


def _beyond(error: Float) -> Bool:
    """Return which relative errors are gross.

    Shape (N,); robust scale with the small sample factor of Rousseeuw & Leroy 1987.
    """
    scale = 1.4826 * (1.0 + 5.0 / max(error.size - 2, 1)) * float(np.median(error))
    gross = 0.01  # error of depth below which a point is never called an outlier: a ruler's, a mount's
    scales = 3.0  # robust standard deviations beyond which a point is an outlier
    return error > max(scales * scale, gross)
