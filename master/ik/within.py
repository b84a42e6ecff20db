"""The mean of a hand within its limits, where the likeliest one leans on them.

The fit ends at the likeliest pose, and of a finger that is poorly told this is often the limit itself: everything
beyond is forbidden, so what lies before it is piled up there. The mean of what is possible lies inside. Near its
solution the posterior is a normal distribution cut by a box, whose moments are found by expectation propagation (Minka
2001; for boxes: Cunningham, Hennig, Lacoste-Julien 2011, "Gaussian probabilities and expectation propagation"): each
limit is stood for by a normal factor that leaves its own angle the mean and variance of the cut distribution.

For hands that are free of habits only: natural ones rest at their limits, as flat ones do.
"""

import numpy as np
from scipy.special import ndtr

from common.arrays import Bool, Float

_SWEEPS, _DAMPING = 6, 0.8
_FIXED_RAD, _FIXED_WEIGHT = 1e-6, 1e10  # limits that leave no room, and how that is weighed
_FAR = 30.0  # standard deviations, beyond which the normal distribution underflows
_ON_LIMIT_RAD = 1e-9


def mean_within(normal: Float, gradient: Float, x: Float, low: Float, high: Float) -> Float:
    """From the likeliest hand to the mean of those within the limits.

    Args:
        normal: (6 + n, 6 + n) normal matrix of the cost at the likeliest hand.
        gradient: (6 + n,) of the cost there; counts where the angles stand at a limit, elsewhere it is 0.
        x: (n,) its angles.
        low, high: (n,) bounds; -inf or inf: none.

    Returns:
        (6 + n,) step of turn [rad], shift [m] and angles [rad]; the angles stay within the bounds.
    """
    palm = len(normal) - len(x)
    below, above = low - x, high - x
    fixed = above - below < _FIXED_RAD
    pull = np.zeros(len(normal))
    pull[palm:] = np.where((below > -_ON_LIMIT_RAD) | (above < _ON_LIMIT_RAD), -gradient[palm:], 0.0)
    weight, push = np.where(fixed, _FIXED_WEIGHT, 0.0), np.zeros(len(x))
    cov, mean = _gaussian(normal, pull, weight, push)
    for _ in range(_SWEEPS):
        variance = np.diagonal(cov)[palm:]
        # the distribution of each angle without the factor of its own limits
        alone = 1.0 / np.maximum(1.0 / variance - weight, 1e-9)
        middle = alone * (mean[palm:] / variance - push)
        cut, narrow = _cut(middle, alone, below, above)
        better = np.maximum(1.0 / narrow - 1.0 / alone, 0.0)
        weight = _eased(fixed, weight, better)
        push = _eased(fixed, push, cut / narrow - middle / alone)
        cov, mean = _gaussian(normal, pull, weight, push)
    mean[palm:] = np.minimum(np.maximum(mean[palm:], below), above)
    return mean


def _gaussian(normal: Float, pull: Float, weight: Float, push: Float) -> tuple[Float, Float]:
    """Covariance and mean with one factor (n,) for each angle."""
    size, palm = len(normal), len(normal) - len(weight)
    total, pulled = normal.copy(), pull.copy()
    total.flat[palm * (size + 1) :: size + 1] += weight
    pulled[palm:] += push
    cov = np.asarray(np.linalg.inv(total), np.float64)
    return cov, cov @ pulled


def _cut(mean: Float, variance: Float, low: Float, high: Float) -> tuple[Float, Float]:
    """Mean and variance (n,) of normal distributions cut at low and high."""
    sigma: Float = np.sqrt(variance)
    a, b = (low - mean) / sigma, (high - mean) / sigma
    flip = a > 0.0  # mirrored, so that no tail is the difference of two numbers near 1
    a, b = np.where(flip, -b, a), np.where(flip, -a, b)
    a, b = np.minimum(np.maximum(a, -_FAR), _FAR), np.minimum(np.maximum(b, -_FAR), _FAR)
    mass: Float = np.maximum(np.asarray(ndtr(b), np.float64) - np.asarray(ndtr(a), np.float64), 1e-300)
    at_a: Float = np.exp(-0.5 * a * a)
    at_b: Float = np.exp(-0.5 * b * b)
    norm = mass * float(np.sqrt(2.0 * np.pi))
    shift = (at_a - at_b) / norm
    left = 1.0 + (a * at_a - b * at_b) / norm - shift * shift
    cut: Float = mean + sigma * np.where(flip, -shift, shift)
    narrow: Float = np.minimum(np.maximum(variance * left, 1e-12), variance)
    return cut, narrow


def _eased(fixed: Bool, old: Float, new: Float) -> Float:
    return np.where(fixed, old, (1.0 - _DAMPING) * old + _DAMPING * new)
