"""Fingertips in the LED image: templates of bent fingers against what is seen along each finger (D15).

The profile of nearness of each finger (`spines`) is compared with those of all its bends (`tip_bends`). From that comes
where the end of the finger lies between the edges that are seen, the contour above and the step below, whose places
are then measured at full resolution; and how likely that end is seen at all.
A finger that points away ends behind its own horizon, one that is folded shows its back: no tip is reported.

The thumb shows its side to the wrist and its end seldom, only where it is laid across the palm; it is not sought.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Image, Int
from slave.wrist.fingers import Fingers
from slave.wrist.led_depth import (
    DARK,
    SHRINK,
    Float32,
    LedOptics,
    depth_about,
    led_optics,
    nearness,
    shrink,
)
from slave.wrist.normals import BREADTH, normals_of
from slave.wrist.spines import borders, spines
from slave.wrist.tip_bends import Bend, bends_of, palm_gain, profiles
from slave.wrist.tip_templates import templates_of
from slave.wrist.view import WristView

CAP_SHARE = 0.8  # of a fingertip's radius: how much of it is compared with a half sphere
_BEYOND_STEP = 0.2125
_BEYOND = [0.3 + _BEYOND_STEP * k for k in range(9)]  # radii beyond the end where a spine is read
_NOISE = np.float32(np.sqrt(DARK))
LEAST_PIXELS = 6  # of the shrunken image, that show a half sphere
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


def fingertips(led: Image, fingers: Fingers, view: WristView) -> Fingertips:
    """Find them in the difference of LED and ambient frame (H, W)."""
    optics, bank = led_optics(view), templates_of(view)
    near = nearness(shrink(led[: bank.all_rows * SHRINK]), optics)
    uv, sigma, depth = np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan)
    gain = palm_gain(near, bank)
    if gain is None:
        return Fingertips(uv, sigma, depth)
    border = borders(fingers, view)
    lines = spines(near, border, bank.unit.shape[2])
    bends = bends_of(profiles(near, lines, border, bank), bank, gain)
    along, columns = full_profiles(led, lines)
    ends: list[End] = []
    for k, bend in enumerate(bends):
        if bend is not None and bend.seen >= LEAST_SEEN and bend.likeness >= LEAST_LIKENESS:
            rows = int(bank.rows[k]) * SHRINK
            ends += edges(k + 1, along[k, :rows], columns[k, :rows], bend)
    facing = [end for end in ends if end.bend.facing > LEAST_FACING]
    middles: dict[int, Float] = {}
    if facing:
        guess = np.array([end.middle for end in facing])
        centres = half_spheres(near, optics, guess, np.array([end.bend.radius_px for end in facing]))
        known: list[bool] = np.isfinite(centres[:, 0]).tolist()
        middles = {end.finger: at for end, at, ok in zip(facing, centres, known, strict=True) if ok}
    for end in ends:
        u, v, spread = end.place(middles.get(end.finger))
        low, high = border[end.finger - 1, :, min(max(int(v) // SHRINK, 0), border.shape[2] - 1)].tolist()
        if spread <= MOST_SIGMA_PX and low <= (u - 0.5 * (SHRINK - 1)) / SHRINK <= high:
            uv[end.finger], sigma[end.finger] = (u, v), spread
            depth[end.finger] = depth_about(near, optics, u, v, end.bend.radius_px)
    return Fingertips(uv, sigma, depth)


def edges(finger: int, along: Float, column: Float, bend: Bend) -> list["End"]:
    """The end of a finger by the edges that are seen of it; none where none is.

    Args:
        finger: 1 index ... 4 little.
        along: (rows,) grey levels along its spine.
        column: (rows,) of the spine [px].
        bend: Of the finger.
    """
    found: list[tuple[float, float]] = []
    radius = bend.radius_px
    top = top_edge(along, bend.top_v, radius)
    if top is not None:
        found.append((top + bend.below_top, bend.below_top_sigma))
    if bend.facing > LEAST_FACING or bend.above_bottom < bend.below_top:
        bottom = bottom_edge(along, bend.bottom_v, radius)
        if bottom is not None:
            found.append((bottom - bend.above_bottom, bend.above_bottom_sigma))
    return [End(finger, bend, column, tuple(found))] if found else []


@dataclass(frozen=True, slots=True, eq=False)
class End:
    """The end of a finger as its edges tell it.

    Attributes:
        finger: 1 index ... 4 little.
        bend: What is believed of its bend.
        column: (rows,) of its spine [px].
        found: At which row each edge puts the end, and the standard deviation of that by the bend [px].
    """

    finger: int
    bend: Bend
    column: Float
    found: tuple[tuple[float, float], ...]

    @property
    def middle(self) -> tuple[float, float]:
        """Where the middle of the fingertip is by its edges alone [px]."""
        bend, last = self.bend, len(self.column) - 1
        v = sum(v for v, _ in self.found) / len(self.found) + bend.above_bottom - bend.radius_px
        return float(self.column[min(max(int(v), 0), last)]), v

    def place(self, middle: Float | None) -> tuple[float, float, float]:
        """Where it is and its standard deviation [px], with the middle (2,) of its half sphere where that is known."""
        bend, found, last = self.bend, list(self.found), len(self.column) - 1
        if middle is not None:
            found.append((float(middle[1]) + bend.radius_px - bend.above_bottom, bend.above_bottom_sigma))
        weights = [1.0 / (MODEL_PX**2 + sigma**2) for _, sigma in found]
        v = sum(w * x for w, (x, _) in zip(weights, found, strict=True)) / sum(weights)
        away = -bend.radius_px if bend.above_bottom < bend.below_top else bend.radius_px
        rows = [min(max(v + x * away, 0.0), last) for x in _BEYOND]
        columns = [float(self.column[int(row)]) for row in rows]
        slope = (sum(columns[6:]) - sum(columns[:3])) / 3.0 / (6.0 * _BEYOND_STEP * away)
        slope = min(max(slope, -MOST_LEAN), MOST_LEAN)
        if middle is None:
            u = (sum(columns) + slope * (len(rows) * v - sum(rows))) / len(rows)
        else:
            u = float(middle[0]) + slope * (v - float(middle[1]))
        return u, v, (1.0 / sum(weights)) ** 0.5


def half_spheres(near: Float32, optics: LedOptics, guess: Float, radius: Float) -> Float:
    """Centres (N, 2) [px] of the half spheres whose normals are nearest to those of the image, by squared distance.

    At p the half sphere of centre c leans by (p - c) / radius aside from the way to the camera, the image by t; the
    sum of squares of the difference is least where c is the mean of p - radius t. NaN: too little is lit, or c is
    nowhere near.

    Args:
        near: (h, w) nearness [grey levels^0.5].
        optics: Of the same.
        guess: (N, 2) where they are sought [px].
        radius: (N,) [px].
    """
    height, width = near.shape
    reach = int(radius.max() / SHRINK) + 3
    around: Int = np.arange(-reach, reach + 1, dtype=np.int64)
    beside: Int = np.arange(
        -reach, reach + 1 + BREADTH // 2, dtype=np.int64
    )  # a gap between one window and the next
    cell = np.rint(guess / SHRINK).astype(np.int64)
    row, column = cell[:, 1] + around[:, None], cell[:, :1] + beside
    at = row.clip(0, height - 1)[..., None] * width + column.clip(0, width - 1)
    part = near.ravel()[at]
    outside = (column < 0) | (column >= width)
    outside[:, 2 * reach + 1 :] = True
    part[(part <= _NOISE) | outside | ((row < 0) | (row >= height))[..., None]] = np.nan
    ray, cosine = optics.ray.reshape(-1, 3)[at], optics.cosine.ravel()[at]
    size = len(around), at.shape[1] * at.shape[2]
    full = normals_of((cosine / part).reshape(size), ray.reshape(*size, 3), cosine.reshape(size)).reshape(
        ray.shape
    )
    view = -ray * cosine[..., None]
    lean = full[..., :2] - np.einsum("...k,...k->...", full, view)[..., None] * view[..., :2]
    scale = radius.astype(np.float32)[:, None]
    u, v = (
        (column * SHRINK + 0.5 * (SHRINK - 1)).astype(np.float32),
        (row * SHRINK + 0.5 * (SHRINK - 1)).astype(np.float32),
    )
    finite = np.isfinite(lean[..., 0])
    lean = np.where(finite[..., None], lean, np.float32(0.0))
    toward_u, toward_v = u - scale * lean[..., 0], v[..., None] - scale * lean[..., 1]
    centre: Float = guess.copy()
    for _ in range(2):
        apart = (u - centre[:, :1]) ** 2 + ((v - centre[:, 1]) ** 2)[..., None]
        inside = (apart < (CAP_SHARE * scale) ** 2) & finite
        count = np.count_nonzero(inside, axis=(0, 2))
        some = np.where(count < LEAST_PIXELS, np.nan, count)
        centre = (
            np.stack([(toward_u * inside).sum(axis=(0, 2)), (toward_v * inside).sum(axis=(0, 2))], axis=1)
            / some[:, None]
        )
    centre[np.hypot(*(centre - guess).T) >= radius] = np.nan
    return centre


def full_profiles(led: Image, lines: Float) -> tuple[Float, Float]:
    """Grey levels (4, rows) along spines in the rows of the full image, the mean of five pixels; their columns [px]."""
    count = lines.shape[1] * SHRINK
    column = cv2.resize(
        lines * SHRINK + 0.5 * (SHRINK - 1), (count, len(lines)), interpolation=cv2.INTER_LINEAR
    )
    width = led.shape[1]
    at = np.rint(column).astype(np.int64).clip(2, width - 3) + np.arange(count, dtype=np.int64) * width
    flat = led.ravel()
    across = sum(flat[at + aside].astype(np.float32) for aside in range(-2, 3))
    along: Float = np.asarray(across, dtype=np.float64) / 5.0
    return along, np.asarray(column, dtype=np.float64)


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
