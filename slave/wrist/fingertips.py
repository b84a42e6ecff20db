"""Fingertips in the LED image: templates of bent fingers against what is seen along each finger (D15).

For each finger its profile of nearness (`spines`) is compared with those of all its bends (`tip_templates`); likeness,
brightness beside the palm's and a shift of a few rows (a bone that is longer than its profile says) make a
probability for each. From it comes where the end of the finger lies between the edges that are seen, the contour
above and the step below, whose places are then measured at full resolution; and how likely that end is seen at all.
A finger that points away ends behind its own horizon, one that is folded shows its back: no tip is reported.

The thumb shows its side to the wrist and its end seldom, only where it is laid across the palm; it is not sought.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image
from slave.wrist.fingers import Fingers
from slave.wrist.led_depth import DARK, SATURATED, SHRINK, Float32, LedOptics, led_optics, nearness, shrink
from slave.wrist.normals import normals_of
from slave.wrist.spines import borders, spines
from slave.wrist.tip_templates import FOUR, GAIN_SIGMA, LIKENESS, PALM_ROWS, FingerTemplates, templates_of
from slave.wrist.view import WristView

SHIFTS = np.arange(-3, 4)
SHIFT_SIGMA_PX = 8.0
KEEP = 96  # templates that are compared at every shift
SATURATED_NEAR = float(np.sqrt(SATURATED))
_SHIFT_PRIOR = (0.5 * (SHIFTS * SHRINK / SHIFT_SIGMA_PX) ** 2).astype(np.float32)
_GAIN_WEIGHT = np.float32(0.5 / GAIN_SIGMA**2)
CAP_SHARE = 0.8  # of a fingertip's radius: how much of it is compared with a half sphere
_NOISE = np.float32(np.sqrt(DARK))
MODEL_PX = 3.0  # a pad is no half sphere
LEAST_SEEN = 0.5  # probability that the end of the finger is seen
MOST_SIGMA_PX = 6.0
LEAST_LIKENESS = 0.985  # a finger behind another or behind the thumb looks like none of the templates
EDGE_SHARE = (
    0.2  # of the brightness within: where a contour is drawn, the skin there being seen almost edge on
)
MOST_LEAN = 0.6  # of a fingertip in the image, columns per row
LEAST_FACING = 0.7  # from here on the end of a finger is seen whole, and the step below it too


@dataclass(frozen=True, slots=True, eq=False)
class Fingertips:
    """Of one LED image; NaN where no end of a finger is seen for sure.

    Attributes:
        uv: (5, 2) [px] where the ends of thumb, index ... little are in the (distorted) image.
        sigma_px: (5,) standard deviation.
        depth: (5,) relative depth along the optical axis, in units of one constant for all five.
    """

    uv: Float
    sigma_px: Float
    depth: Float


@dataclass(frozen=True, slots=True, eq=False)
class Bend:
    """What is believed of one finger's bend: means over all templates and shifts, standard deviations.

    Attributes:
        below_top, below_top_sigma: How far its end is below the finger's highest row [px].
        above_bottom, above_bottom_sigma: How far it is above the lowest row of the fingertip.
        top_v, bottom_v: Where these rows are expected [px].
        radius_px, depth_m, facing: Of the fingertip.
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
    depth_m: float
    facing: float
    seen: float
    likeness: float


def fingertips(led: Image, fingers: Fingers, view: WristView) -> Fingertips:
    """Find them in the difference of LED and ambient frame (H, W)."""
    optics = led_optics(view)
    near = nearness(shrink(led), optics)
    uv, sigma, depth = np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan)
    bank = templates_of(view)
    gain = palm_gain(near, bank)
    if gain is None:
        return Fingertips(uv, sigma, depth)
    sides = borders(fingers, bank, len(near))
    lines = spines(near, sides)
    for finger, templates, border, whole in zip(FOUR, bank, sides, lines, strict=True):
        line = whole[: templates.rows]
        bend = bend_of(profile(near, line, border), templates, gain)
        if bend is None or bend.seen < LEAST_SEEN or bend.likeness < LEAST_LIKENESS:
            continue
        tip, spread = place(led, near, optics, line, bend)
        if spread <= MOST_SIGMA_PX:
            uv[finger], sigma[finger], depth[finger] = tip, spread, bend.depth_m
    strays = fingers.finger_of(uv) != np.arange(5)
    uv[strays], sigma[strays], depth[strays] = np.nan, np.nan, np.nan
    return Fingertips(uv, sigma, depth)


def palm_gain(near: Float32, bank: tuple[FingerTemplates, ...]) -> float | None:
    """Logarithm of nearness [grey levels^0.5] by nearness [1/m] of the palm below the knuckles; None: it is dark."""
    gains: list[float] = []
    for templates in bank:
        u, v = (int(x) // SHRINK for x in templates.root_uv)
        patch = near[v + PALM_ROWS[0] : v + PALM_ROWS[1], max(u, 0) : u + 1]
        if patch.size and float(patch.mean()) ** 2 > DARK:
            gains.append(float(np.log(patch.mean() / templates.palm)))
    return float(np.median(gains)) if gains else None


def profile(near: Float32, line: Float, border: Float) -> Float32:
    """Nearness (rows,) along a spine, the mean of three pixels; 0 where it leaves the finger's region."""
    columns = np.clip(np.rint(line).astype(np.int64), 1, near.shape[1] - 2)
    rows = np.arange(len(line))
    seen = (near[rows, columns - 1] + near[rows, columns] + near[rows, columns + 1]) / np.float32(3.0)
    low, high = border[:, : len(line)]
    return np.where((line >= low - 0.5) & (line <= high + 0.5), seen, np.float32(0.0))


def bend_of(seen: Float32, templates: FingerTemplates, gain: float) -> Bend | None:
    """Weigh all bends of a finger by its profile (rows,); None: there is no finger in it."""
    if np.count_nonzero(seen > np.sqrt(DARK)) < 4:
        return None
    unit, log_length = templates.unit, templates.log_length
    cap = float(seen.max())
    if cap > SATURATED_NEAR:
        unit, log_length = _capped(templates, cap / np.exp(gain))
    few = np.argpartition(_score(unit, log_length, seen[:, None], gain)[1][:, 0], -KEEP)[-KEEP:]
    shifted = np.zeros((len(seen), len(SHIFTS)), dtype=np.float32)
    for k, s in enumerate(SHIFTS):
        shifted[max(-s, 0) : len(seen) - max(s, 0), k] = seen[max(s, 0) : len(seen) + min(s, 0)]
    likeness, score = _score(unit[few], log_length[few], shifted, gain)
    score -= _SHIFT_PRIOR
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    of_bend = weight.sum(axis=1)
    table = templates.table[:, few]
    mean = table @ of_bend
    spread = np.sqrt(np.maximum((table * table) @ of_bend - mean * mean, 0.0))
    shift = SHRINK * float(weight.sum(axis=0) @ SHIFTS)
    below, above, top, bottom, radius, depth, facing, end_seen = mean.tolist()
    return Bend(
        below,
        float(spread[0]),
        above,
        float(spread[1]),
        top + shift,
        bottom + shift,
        radius,
        depth,
        facing,
        end_seen,
        float(likeness.flat[int(score.argmax())]),
    )


def _score(unit: Float32, log_length: Float32, seen: Float32, gain: float) -> tuple[Float32, Float32]:
    """Likeness and log probability (T, S) of templates (T, rows) for profiles (rows, S)."""
    product = np.maximum(unit @ seen, np.float32(1e-6))
    likeness = product / (np.sqrt(np.einsum("rs,rs->s", seen, seen)) + np.float32(1e-6))
    away = np.log(product) - (log_length[:, None] + np.float32(gain))
    return likeness, (likeness - np.float32(1.0)) * np.float32(1.0 / LIKENESS) - away * away * _GAIN_WEIGHT


def _capped(templates: FingerTemplates, cap: float) -> tuple[Float32, Float32]:
    """The templates as a saturated image shows them: nowhere nearer than `cap` [1/m]."""
    near = np.minimum(templates.unit * np.exp(templates.log_length)[:, None], np.float32(cap))
    length = np.sqrt(np.einsum("tr,tr->t", near, near))
    return near / length[:, None], np.log(length)


def place(led: Image, near: Float32, optics: LedOptics, line: Float, bend: Bend) -> tuple[Float, float]:
    """Where the end of a finger is (2,) [px], and its standard deviation."""
    along, column = full_profile(led, line)
    found: list[tuple[float, float]] = []
    radius = bend.radius_px
    top = top_edge(along, bend.top_v, radius)
    if top is not None:
        found.append((top + bend.below_top, bend.below_top_sigma))
    if bend.facing > LEAST_FACING or bend.above_bottom < bend.below_top:
        bottom = bottom_edge(along, bend.bottom_v, radius)
        if bottom is not None:
            found.append((bottom - bend.above_bottom, bend.above_bottom_sigma))
    middle: Float | None = None
    if found and bend.facing > LEAST_FACING:
        guess = sum(v for v, _ in found) / len(found) + bend.above_bottom - radius
        at = float(column[int(np.clip(guess, 0, len(column) - 1))])
        middle = half_sphere(near, optics, (at, guess), radius)
        if middle is not None:
            found.append((middle[1] + radius - bend.above_bottom, bend.above_bottom_sigma))
    if not found:
        return np.full(2, np.nan), np.inf
    weights = [1.0 / (MODEL_PX**2 + sigma**2) for _, sigma in found]
    v = sum(w * x for w, (x, _) in zip(weights, found, strict=True)) / sum(weights)
    away = -radius if bend.above_bottom < bend.below_top else radius
    rows = np.linspace(v + 0.3 * away, v + 2.0 * away, 9).clip(0, len(column) - 1)
    columns = column[rows.astype(np.int64)]
    slope = np.clip((columns[6:].mean() - columns[:3].mean()) / (1.275 * away), -MOST_LEAN, MOST_LEAN)
    u = columns.mean() + slope * (v - rows.mean())
    if middle is not None:
        u = middle[0] + slope * (v - middle[1])
    return np.array([u, v]), float(np.sqrt(1.0 / sum(weights)))


def half_sphere(near: Float32, optics: LedOptics, guess: tuple[float, float], radius: float) -> Float | None:
    """Centre (2,) [px] of the half sphere whose normals are nearest to those of the image, by squared distance.

    At p the half sphere of centre c leans by (p - c) / radius aside from the way to the camera, the image by t; the
    sum of squares of the difference is least where c is the mean of p - radius t.
    """
    reach = int(radius / SHRINK) + 3
    u, v = (round(x / SHRINK) for x in guess)
    rows, columns = slice(max(v - reach, 0), v + reach + 1), slice(max(u - reach, 0), u + reach + 1)
    part = near[rows, columns]
    if part.size == 0:
        return None
    ray, cosine = optics.ray[rows, columns], optics.cosine[rows, columns]
    view = -ray * cosine[..., None]
    lit = np.where(part > _NOISE, part, np.float32(np.nan)).astype(np.float32)
    full = normals_of(cosine / lit, ray, cosine)
    lean = full[..., :2] - (full * view).sum(axis=-1, keepdims=True) * view[..., :2]
    down, across = np.indices(part.shape, dtype=np.float64)
    at: Float = np.stack([across + columns.start, down + rows.start], axis=-1) * SHRINK + 0.5 * (SHRINK - 1)
    centre: Float = np.array(guess)
    for _ in range(2):
        inside = (((at - centre) ** 2).sum(axis=-1) < (CAP_SHARE * radius) ** 2) & np.isfinite(lean[..., 0])
        if np.count_nonzero(inside) < 6:
            return None
        centre = (at[inside] - radius * lean[inside]).mean(axis=0)
    return centre if np.hypot(*(centre - np.array(guess))) < radius else None


def full_profile(led: Image, line: Float) -> tuple[Float, Float]:
    """Grey levels along a spine in the rows of the full image, the mean of five pixels; and its columns [px]."""
    rows = np.arange(len(line) * SHRINK)
    offset = 0.5 * (SHRINK - 1)
    column = np.interp(rows, np.arange(len(line)) * SHRINK + offset, line * SHRINK + offset)
    middle = np.clip(np.rint(column).astype(np.int64), 2, led.shape[1] - 3)
    across = led[rows[:, None], middle[:, None] + np.arange(-2, 3)]
    return across.mean(axis=1), column


def top_edge(along: Float, near_v: float, radius: float) -> float | None:
    """Row of the contour above a fingertip, where it is expected at `near_v`."""
    low, high = (int(np.clip(near_v + x, 1, len(along) - 2)) for x in (-24.0, 24.0))
    inside = along[min(int(near_v + 0.5 * radius), high) : max(int(near_v + 1.5 * radius), low) + 1]
    level = max(DARK, EDGE_SHARE * float(np.median(inside))) if inside.size else DARK
    lit = np.flatnonzero(along[low:high] > level)
    if not lit.size or lit[0] == 0:
        return None
    k = low + int(lit[0])
    rise = along[k] - along[k - 1]
    return k - (along[k] - level) / rise if rise > 0.0 else float(k)


def bottom_edge(along: Float, near_v: float, radius: float) -> float | None:
    """Row where the light steps down below a fingertip that is before the palm, expected at `near_v`."""
    low, high = (int(np.clip(near_v + x, 5, len(along) - 6)) for x in (-radius, radius))
    if high - low < 4:
        return None
    sums = np.concatenate([[0.0], np.cumsum(along)])
    rows = np.arange(low, high)
    step = (sums[rows] - sums[rows - 4]) - (sums[rows + 5] - sums[rows + 1])
    return float(rows[step.argmax()]) + 3.0
