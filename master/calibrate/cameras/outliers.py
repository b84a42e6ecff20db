"""Which views are wrong, judged by the others."""

import numpy as np
from scipy.special import stdtrit

from common.arrays import Float

FALSE_ALARM = 0.05  # chance that a set of good views loses one; one view less costs little, a wrong one much
GOOD_PX = 0.12  # as well as corners can be found: such a view is right, however good the others are


def limit(errors: Float, dof: Float) -> float:
    """Return the error above which a view is an outlier.

    Infinite below four views.

    The logarithms of good views' rms errors scatter about a common middle, more than chi-square alone would have it
    (light, blur and tilt differ). Middle and spread are the median and the median absolute deviation of all views, so
    up to half of them may be wrong; the quantile is Student's for as many views, at the level of `FALSE_ALARM`
    for the whole set.

    Args:
        errors: Rms error (V,) [px] of each view.
        dof: Degrees of freedom (V,) of each error.
    """
    if len(errors) < 4:
        return float("inf")
    logs = np.log(np.maximum(errors, 1e-6))
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    least_spread = 0.1  # of log rms: below it, views of one camera hardly ever agree
    # The logarithm of an rms of n normal numbers has the standard deviation 1 / sqrt(2 n).
    spread = max(spread, least_spread, 1.0 / np.sqrt(2.0 * max(float(np.median(dof)), 1.0)))
    quantile = float(stdtrit(len(errors) - 1, 1.0 - FALSE_ALARM / len(errors)))
    return max(float(np.exp(middle + quantile * spread)), GOOD_PX)
