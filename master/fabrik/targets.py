"""Kernels of the pipeline's palm: back normal and finger targets.

They give where the back faces, and where fingers are to bring their markers.
"""

from math import sqrt

import numpy as np

from common.arrays import Float
from common.kernels import kernel
from master.estimator.matrices import inverse_3_plus


@kernel
def back_normal_of(points: Float, area_px2: Float, centres: Float, focal_px: Float, out: Float) -> bool:
    """Write the unit vector from a hand to the cameras that see its back.

    A flat marker shows each camera its area times the cosine of its tilt, so the directions to the cameras, weighed by
    what each sees, add up to where it faces, as far as they constrain it.

    Args:
        points: (M, 3) [m] its markers, rig frame; NaN: not placed.
        area_px2: (C, K) of those on its back as each camera sees them; NaN: not seen.
        centres, focal_px: (C, 3) [m] and (C,) of the cameras.
        out: (3,) written.

    Returns:
        Whether a marker is placed; else nothing is written.
    """
    count = 0
    middle, back = np.zeros(3), np.empty(3)
    for m in range(points.shape[0]):
        if np.isfinite(points[m, 0]):
            count += 1
            for i in range(3):
                middle[i] += points[m, i]
    if count == 0:
        return False
    sum_px2, shown_px2 = 0.0, np.zeros(centres.shape[0])
    for c in range(centres.shape[0]):
        for k in range(area_px2.shape[1]):
            if np.isfinite(area_px2[c, k]):
                shown_px2[c] += area_px2[c, k]
        sum_px2 += shown_px2[c]
    for i in range(3):
        out[i] = 0.0
    for c in range(centres.shape[0]):
        squared = 0.0
        for i in range(3):
            back[i] = centres[c, i] - middle[i] / count
            squared += back[i] * back[i]
        weight = 1.0 if sum_px2 == 0.0 else shown_px2[c] * squared / (focal_px[c] * focal_px[c])
        for i in range(3):
            out[i] += weight * back[i] / sqrt(squared)
    length = sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    if length > 0.0:
        for i in range(3):
            out[i] /= length
    else:  # cameras on both sides
        for i in range(3):
            out[i] = 1.0 if i == 2 else 0.0
    return True


@kernel
def targets_of(points: Float, cov: Float, T: Float, fitted: Float, fit_m2: float, out: Float) -> None:
    """Write where fingers are to bring their markers (M, 3) [m], palm frame.

    Where they are measured, as far as that is surer than the fit.

    Args:
        points, cov: (M, 3) [m] and (M, 3, 3) [m^2] measured, rig frame; NaN: not seen.
        T: (4, 4) palm.
        fitted: (M, 3) [m] where the palm's fit has them, rig frame.
        fit_m2: Variance of these.
        out: Written; NaN where not seen.
    """
    gain, off, target = np.empty((3, 3)), np.empty(3), np.empty(3)
    for m in range(points.shape[0]):
        inverse_3_plus(cov[m], fit_m2, gain)
        for i in range(3):
            off[i] = points[m, i] - fitted[m, i]
        for i in range(3):
            moved = fit_m2 * (gain[i, 0] * off[0] + gain[i, 1] * off[1] + gain[i, 2] * off[2])
            target[i] = fitted[m, i] + moved - T[i, 3]
        for i in range(3):
            out[m, i] = T[0, i] * target[0] + T[1, i] * target[1] + T[2, i] * target[2]
