"""Do the rays of one marker meet? How far they miss each other, against how well they are known.

Rays of one point meet but for noise, so the squared miss in units of its standard deviation is chi square
distributed: 2 C numbers of C cameras less the 3 of the point. For two cameras it is the distance from the epipolar
line. What exceeds the quantile that noise exceeds once in a million is not one point (`LIMIT`: 4.9 standard
deviations for two cameras).
"""

from math import erfc, exp, gamma, sqrt

import numpy as np

from common.arrays import Float

RIG_PX = 0.85
"""Standard deviation per axis of what lens, mount and calibration leave at one marker: two sure cameras may miss each
other by 6 px before a marker is dropped. Cheap lenses fit to about half a pixel, and a mount gives way when touched."""
_ONE_IN = 1e-6


def chi_square_survival(x: float, degrees: int) -> float:
    """Probability that chi square exceeds `x` (Abramowitz & Stegun, 26.4.4 and 26.4.5)."""
    if degrees % 2:
        tail, first = erfc(sqrt(x / 2)), 1.5
        count = (degrees - 1) // 2
    else:
        tail, first = 0.0, 1.0
        count = degrees // 2
    terms = ((x / 2) ** (first - 1 + i) / gamma(first + i) for i in range(count))
    return tail + exp(-x / 2) * sum(terms)


def chi_square_quantile(exceeded: float, degrees: int) -> float:
    """The value that chi square exceeds with probability `exceeded`, to 1e-9."""
    low, high = 0.0, 1.0
    while chi_square_survival(high, degrees) > exceeded:
        high *= 2.0
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if chi_square_survival(middle, degrees) > exceeded else (low, middle)
    return high


def limits(cameras: int) -> Float:
    """Largest misfit of one point by the number of cameras that see it, (cameras + 1,) ; inf below two."""
    return np.array([np.inf] * 2 + [chi_square_quantile(_ONE_IN, 2 * n - 3) for n in range(2, cameras + 1)])


def misfit_of_rays(error_px2: Float, sigma_px: Float) -> Float:
    """Chi square (M,) of reprojection errors; NaN where there is no point.

    Args:
        error_px2: (M, C) squared distance of each observation from the projected point [px^2]; 0: not seen.
        sigma_px: (C, M) standard deviations per axis; NaN where not seen.
    """
    return (error_px2 / (np.nan_to_num(sigma_px.T, nan=1.0) ** 2 + RIG_PX**2)).sum(axis=1)
