"""How each finger is bent, by its profile of nearness against those of all its postures (`tip_templates`).

Likeness, brightness beside the palm's and a shift of a few rows (a bone that is longer than its profile says) make a
probability for each; what is believed is the mean over all.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from slave.wrist.led_depth import DARK, SATURATED, Float32
from slave.wrist.strips import ROW_PX
from slave.wrist.tip_templates import GAIN_SIGMA, PROFILE_VARIANCE, TipTemplates

SHIFTS = np.arange(-1, 2)  # stations
SHIFT_SIGMA_PX = 8.0
KEEP = 96  # templates that are compared at every shift
SATURATED_NEAR = float(np.sqrt(SATURATED))
_SHIFT_PRIOR = (0.5 * (SHIFTS * ROW_PX / SHIFT_SIGMA_PX) ** 2).astype(np.float32)
_GAIN_WEIGHT = np.float32(0.5 / GAIN_SIGMA**2)
_NOISE = np.float32(np.sqrt(DARK))
_FINGER = np.arange(5, dtype=np.int64)[:, None]
_TABLE = np.arange(7, dtype=np.int64)[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """What is believed of one finger's bend: means over all templates and shifts, standard deviations.

    Attributes:
        below_top, below_top_sigma: How far its end is below the finger's highest row [px].
        above_bottom, above_bottom_sigma: How far it is above the lowest row of the fingertip.
        top_v, bottom_v: Where these rows are expected [px].
        radius_px, facing: Of the fingertip.
        seen: Probability that its end is seen.
        likeness: Of the best template, 1 at most.
    """

    below_top: float
    below_top_sigma: float
    above_bottom: float
    above_bottom_sigma: float
    top_v: float
    bottom_v: float
    radius_px: float
    facing: float
    seen: float
    likeness: float

    @property
    def down(self) -> bool:
        """Whether the end is nearer to the lowest row of the fingertip: the finger is folded."""
        return self.above_bottom < self.below_top


def palm_gain(near: Float32, bank: TipTemplates) -> float | None:
    """Logarithm of nearness [grey levels^0.5] by nearness [1/m] of the palm below the knuckles; None: it is dark."""
    palm = near.ravel()[bank.palm_at].mean(axis=1)
    lit = palm * palm > DARK
    return float(np.median(np.log(palm[lit] / bank.palm[lit]))) if lit.any() else None


def profiles(near: Float32, lines: Float, border: Float32, bank: TipTemplates) -> Float32:
    """Nearness (5, R) along the spines, the mean of three columns; 0 where they leave the finger's region."""
    width = near.shape[1]
    row: Int = np.arange(lines.shape[1], dtype=np.int64)
    at = np.rint(lines).astype(np.int64).clip(1, width - 2) + row * width
    flat = near.ravel()
    seen = (flat[at - 1] + flat[at] + flat[at + 1]) / np.float32(3.0)
    low, high = border[:, 0, : len(row)], border[:, 1, : len(row)]
    inside = (lines >= low - 0.5) & (lines <= high + 0.5) & (row < bank.rows[:, None])
    return seen * (inside & (seen > _NOISE))


def bends_of(seen: Float32, bank: TipTemplates, gain: float) -> list[Bend | None]:
    """Weigh all postures of each finger by its profile (5, R); None: there is no finger in it."""
    there = np.count_nonzero(seen > _NOISE, axis=1) >= 3
    _, score = _score(bank.screen, bank.log_length, seen.reshape(5, -1, 2).mean(axis=2)[..., None], gain)
    few = np.argpartition(score[..., 0], -KEEP, axis=1)[:, -KEEP:]
    unit, log_length = bank.unit[_FINGER, few], bank.log_length[_FINGER, few]
    cap = seen.max(axis=1)
    if cap.max() > SATURATED_NEAR:
        cap = np.where(cap > SATURATED_NEAR, cap / np.exp(gain), np.inf)
        unit, log_length = _capped(unit, log_length, cap.astype(np.float32))
    reach = len(SHIFTS) // 2
    padded = np.zeros((5, seen.shape[1] + 2 * reach), dtype=np.float32)
    padded[:, reach:-reach] = seen
    # Copied, not a view of windows: products of matrices want their numbers side by side.
    shifted = np.stack([padded[:, k : k + seen.shape[1]] for k in range(len(SHIFTS))], axis=2)
    likeness, score = _score(unit, log_length, shifted, gain)
    score -= _SHIFT_PRIOR
    weight = np.exp(score - score.max(axis=(1, 2), keepdims=True))
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    table = bank.table[_FINGER[..., None], _TABLE, few[:, None]]
    of_bend = weight.sum(axis=2)[..., None]
    mean = (table @ of_bend)[..., 0]
    spread = np.sqrt(np.maximum(((table[:, :2] ** 2) @ of_bend)[..., 0] - mean[:, :2] ** 2, 0.0))
    # Distances from a contour are one-sided: the middle of what is believed, not the mean.
    order = table[:, :2].argsort(axis=2)
    sums = np.take_along_axis(
        np.broadcast_to(weight.sum(axis=2)[:, None], order.shape), order, axis=2
    ).cumsum(axis=2)
    half = (sums < 0.5).sum(axis=2, keepdims=True).clip(max=KEEP - 1)
    mean[:, :2] = np.take_along_axis(table[:, :2], np.take_along_axis(order, half, axis=2), axis=2)[..., 0]
    mean[:, 2:4] += ROW_PX * (weight.sum(axis=1) @ SHIFTS)[:, None]
    best = likeness.reshape(5, -1)[_FINGER[:, 0], score.reshape(5, -1).argmax(axis=1)]
    return [
        Bend(below, below_sigma, above, above_sigma, top, bottom, radius, facing, end_seen, like)
        if shown
        else None
        for (below, above, top, bottom, radius, facing, end_seen), (
            below_sigma,
            above_sigma,
        ), like, shown in zip(mean.tolist(), spread.tolist(), best.tolist(), there.tolist(), strict=True)
    ]


def _score(unit: Float32, log_length: Float32, seen: Float32, gain: float) -> tuple[Float32, Float32]:
    """Likeness and log probability (5, T, S) of templates (5, T, R) for profiles (5, R, S)."""
    product = np.maximum(unit @ seen, np.float32(1e-6))
    likeness = product / (np.sqrt((seen * seen).sum(axis=1, keepdims=True)) + np.float32(1e-6))
    away = np.log(product) - (log_length[..., None] + np.float32(gain))
    score = (likeness - np.float32(1.0)) * np.float32(1.0 / PROFILE_VARIANCE)
    return likeness, score - away * away * _GAIN_WEIGHT


def _capped(unit: Float32, log_length: Float32, cap: Float32) -> tuple[Float32, Float32]:
    """Templates (5, T, R) as a saturated image shows them: nowhere nearer than `cap` (5,) [1/m]."""
    near = np.minimum(unit * np.exp(log_length)[..., None], cap[:, None, None])
    length = np.sqrt((near * near).sum(axis=2))
    length = np.maximum(length, np.float32(1e-6))
    return near / length[..., None], np.log(length)
