"""From evidence to the offset between two cameras, and how well it is known.

Time is cut into blocks, and each item of each block (a *unit*: one marker's residual, or one distance, for a
second) keeps its own constant: its sums are taken about its own means, so whatever changes slowly, lens errors across
the image or another posture of the fingers, is no evidence. A unit then gives `s_ze = d s_zg` with the covariances of
instrument z, value e and rate g, and all together

    d = sum w s_ze / sum w s_zg

Weights are 1 / (the unit's residual variance), refitted some times from the median: a unit in which a camera took
another thing for the marker, or in which fingers moved, has a large residual and counts for little (Huber, "Robust
Statistics", 1981, 7.8).

Errors of neighbouring frames are anything but independent, so the uncertainty is how much batches of frames disagree:
from tenths of a block to two blocks, and the length that disagrees most counts (Flyvbjerg & Petersen, "Error estimates
on averages of correlated data", 1989), with the jackknife's correction for leverage (Bell & McCaffrey, "Bias reduction
in standard errors", 2002). It is widened by Student's distribution for how many batches carry the evidence: outside
"3 sigma" lies as much as of a normal distribution. Added is what a calibration that is off by what it may be would
imitate where depth changes in step with velocity.
"""

from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from scipy.special import ndtr, stdtrit

from common.arrays import Bool, Float, Int
from master.fabrik.intersection import RAYS
from master.monitor.timing_evidence import Evidence

TENTHS = 10  # of a block, the shortest batches
"""Residual below which a unit is not taken to be better: centroids of a tenth of a pixel, at half a metre."""
_LENGTHS = (1, 2, 5, 10, 20)  # of batches [tenths of a block]
_THREE_SIGMA = float(ndtr(3.0))


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """Time offset of a camera against the reference camera.

    It is how much later the camera's frames really are than their stamps state.

    Attributes:
        offset_ns: [ns].
        sigma_ns: Standard deviation [ns].
        batches: How many stretches of time carry it, as an effective number.
    """

    offset_ns: float
    sigma_ns: float
    batches: float


def unit_sums(evidence: Evidence, markers: int, tenth: Int) -> Float:
    """Return the sums (10, I, 8) of one block.

    n, s_zg, s_ze, s_zc, s_gg, s_ge, s_ee, and the unit's floor variance.

    Sums are of what is left of each quantity when a constant and a plane over the image are taken out of the block.

    Args:
        evidence: Of the block's frames (K, I).
        markers: How many of the items are residuals.
        tenth: In which tenth of the block each frame lies (K,).
    """
    residual_floor_px, distance_floor_m = 0.2, 1e-3
    floor = np.full(evidence.value.shape[1], distance_floor_m**2)
    floor[:markers] = residual_floor_px**2
    good = _plausible(evidence, floor)
    at_least = 8  # equations of a unit
    good &= good.sum(axis=0) >= at_least
    n = good.sum(axis=0)
    x, y = np.moveaxis(evidence.place, -1, 0)
    parts = (x, y, evidence.instrument, evidence.value, evidence.rate, evidence.pixel_effect)
    x, y, z, e, g, c = (_about_mean(part, good, n) for part in parts)
    y = _without(y, x)
    z, e, g, c = (_without(_without(part, x), y) for part in (z, e, g, c))
    products = np.stack([good.astype(np.float64), z * g, z * e, z * c, g * g, g * e, e * e], axis=-1)
    sums = np.zeros((TENTHS, len(floor), 8))
    np.add.at(sums[..., :7], tenth, products)
    sums[..., 7] = floor
    return sums


def _plausible(evidence: Evidence, floor: Float) -> Bool:
    """Return the mask (T, I) of plausible evidence.

    Nothing jumps there and both cameras see the marker move alike; NaN is not plausible.

    Values are compared with the median of five in a row, which follows any smooth course; velocities of the two
    cameras with each other. Both by the median of their differences, which outliers do not move (Hampel, 1974).
    """
    good = np.isfinite(evidence.value + evidence.rate + evidence.instrument + evidence.place.sum(axis=-1))
    value = np.where(good, evidence.value, np.nan)
    padded = np.pad(value, ((2, 2), (0, 0)), constant_values=np.nan)
    smoothed = _median(np.stack([padded[i : i + len(value)] for i in range(5)]))
    jump = np.abs(value - smoothed)
    unlike = np.abs(np.where(good, evidence.rate - evidence.instrument, np.nan))
    far = 6.0  # medians of a normal distribution: 4 sigma
    return (jump <= far * _median(jump) + np.sqrt(floor)) & (unlike <= far * _median(unlike))


def _median(x: Float) -> Float:
    """Return medians along the first axis, ignoring NaN.

    Of two middle values it is the lower one. numpy's own is slow on small arrays.
    """
    ordered = np.sort(x, axis=0)  # NaN last
    middle = np.maximum(np.isfinite(x).sum(axis=0) - 1, 0) // 2
    return np.take_along_axis(ordered, middle[None], axis=0)[0]


def _about_mean(x: Float, good: Bool, n: Int) -> Float:
    x = np.where(good, x, 0.0)
    return np.where(good, x - x.sum(axis=0) / np.maximum(n, 1), 0.0)


def _without(x: Float, column: Float) -> Float:
    """Return x (T, I) without its component along `column` (T, I).

    Nothing is removed where that is only noise.
    """
    length = (column * column).sum(axis=0)
    still = 1e-3  # [1, normalised image]: half a pixel
    return x - column * ((column * x).sum(axis=0) / (length + still**2 * len(x)))


def fit_offset(blocks: Float) -> TimeOffset | None:
    """Fit the offset from the sums (B, 10, I, 8) of blocks.

    None where there is too little motion to estimate it.
    """
    n, zg, ze, _, gg, ge, ee, _ = np.moveaxis(blocks.sum(axis=1), -1, 0)
    floor = blocks[:, 0, :, 7]
    moved = zg > 0.0
    if not moved.any():
        return None

    def variance(offset: float | Float) -> Float:
        """Residual variance (B, I) of each unit, never below its floor."""
        fitted = 4  # constant, plane, offset
        return floor + np.maximum(ee - 2.0 * offset * ge + offset * offset * gg, 0.0) / np.maximum(
            n - fitted, 1
        )

    slope = np.where(moved, ze / np.where(moved, zg, 1.0), 0.0)
    offset = _weighted_median(slope[moved], (zg / variance(slope))[moved])
    weight, total = np.zeros_like(zg), 0.0
    times = 8
    for _ in range(times):
        weight = 1.0 / variance(offset)
        total = float((weight * zg).sum())
        if total <= 0.0:
            return None
        offset = float((weight * ze).sum()) / total
    information, lagged, weight_of_rays = (
        (weight[:, None] * blocks[..., part]).sum(axis=2).ravel() for part in (1, 2, 3)
    )
    scatter = [_scatter(information, lagged - offset * information, length) for length in _LENGTHS]
    batches_at_least = 3.0
    if scatter[0][1] < batches_at_least:
        return None
    long_batches_at_least = 5.0  # fewer add little that shorter ones do not
    sigma, count = max([scatter[0], *(of for of in scatter[1:] if of[1] >= long_batches_at_least)])
    sigma *= float(stdtrit(count - 1.0, _THREE_SIGMA)) / 3.0
    sigma = hypot(sigma, sqrt(2.0) * RAYS.rig_px * float(weight_of_rays.sum()) / total)
    return TimeOffset(offset * 1e9, sigma * 1e9, count)


def _scatter(information: Float, residual: Float, length: int) -> tuple[float, float]:
    """Return the standard deviation of the offset [s] and the effective batch count.

    It is estimated from batches of so many tenths (`length`).
    """
    starts = np.arange(0, len(information), length)
    information, residual = np.add.reduceat(information, starts), np.add.reduceat(residual, starts)
    total = information.sum()
    leverage_at_most = 0.95
    share = np.clip(information / total, 0.0, leverage_at_most)
    residual = residual / (1.0 - share)
    return float(np.sqrt((residual * residual).sum()) / total), 1.0 / max(float((share * share).sum()), 1e-12)


def _weighted_median(values: Float, weights: Float) -> float:
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, 0.5 * sums[-1])])
