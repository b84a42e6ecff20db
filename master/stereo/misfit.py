"""Do the rays of one marker meet? How far they miss each other, against how well they are known.

Rays of one point meet but for noise, so the squared miss in units of its standard deviation is chi square
distributed: 2 C numbers of C cameras less the 3 of the point. For two cameras it is the distance from the epipolar
line. What exceeds the quantile that noise exceeds once in a million is not one point (`LIMIT`: 4.9 standard
deviations for two cameras).
"""

import numpy as np

from common.arrays import Float
from master.fabrik.intersection import RAYS

RIG_PX = RAYS.rig_px


def misfit_of_rays(error_px2: Float, sigma_px: Float) -> Float:
    """Chi square (M,) of reprojection errors; NaN where there is no point.

    Args:
        error_px2: (M, C) squared distance of each observation from the projected point [px^2]; 0: not seen.
        sigma_px: (C, M) standard deviations per axis; NaN where not seen.
    """
    return (error_px2 / (np.nan_to_num(sigma_px.T, nan=1.0) ** 2 + RIG_PX**2)).sum(axis=1)
