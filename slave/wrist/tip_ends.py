"""Where a finger ends along its spine: edges of light at full resolution, and what the finger's bend makes of them.

How sure a place is has three parts: how far flesh is off any model of it, in shares of the fingertip's radius; what is
believed of the bend; and how much the edges contradict each other.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image
from slave.wrist.led_depth import DARK, SHRINK
from slave.wrist.strips import ROW_PX, THUMB, Strips
from slave.wrist.tip_bends import Bend

# Standard deviations, of a fingertip's radius: how far skin is off its cones, by radii that differ by 5 % from person
# to person and by folds; and by the pulp, which shifts the middle of a tip that points at the camera, is folded, or
# turns about its own axis as the thumb's does.
FLESH, PULP = 0.07, 0.12
# Of the same: the templates are so far apart that where beliefs spread less, ends of simulated hands stray less still.
BELIEF = 0.2
PIXEL = 0.7  # px: edges in the noise
# Of the brightness within: where a contour is drawn, the skin there being seen almost edge on.
EDGE_SHARE = 0.2
# Of the radius: by Lambert's cosine a sphere is that dark so far inside its contour.
RIM = 0.5 * EDGE_SHARE**2
CONTOUR_PX = 24.0  # how far from where it is expected a contour is sought
BOTTOM_SHARE = 0.5  # of the steepest step of light: where it ends
LEAST_FACING = 0.7  # from here on the end of a finger is seen whole, and the step below it too
BEFORE_END = (0.7, 2.5)  # of a fingertip's radius before its end: where a spine runs along the bone
MOST_LEAN = 0.8  # of a fingertip in the image, columns per row
_FIVE = np.arange(-2, 3, dtype=np.int64)


def edges(finger: int, along: Float, column: Float, bend: Bend) -> list["End"]:
    """The end of a finger by the edges that are seen of it; none where none is.

    Args:
        finger: 0 thumb ... 4 little.
        along: (rows,) grey levels along its spine.
        column: (rows,) of the spine [px].
        bend: Of the finger.
    """
    found: list[tuple[float, float]] = []
    radius = bend.radius_px
    top = top_edge(along, bend.top_v, radius)
    if top is not None:
        found.append((top - RIM * radius + bend.below_top, bend.below_top_sigma))
    if bend.facing > LEAST_FACING or bend.down:
        bottom = bottom_edge(along, bend.bottom_v, radius)
        if bottom is not None:
            found.append((bottom - bend.above_bottom, bend.above_bottom_sigma))
    return [End(finger, bend, column, tuple(found))] if found else []


@dataclass(frozen=True, slots=True, eq=False)
class End:
    """The end of a finger as its edges tell it, in its strip.

    Attributes:
        finger: 0 thumb ... 4 little.
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

    def place(self, middle: Float | None) -> tuple[tuple[float, float], float]:
        """Where it is and its standard deviation [px], with the middle (2,) of its half sphere where that is known."""
        bend, found, last = self.bend, list(self.found), len(self.column) - 1
        aside = bend.down or self.finger == THUMB
        pulp = PULP * (1.0 if aside else max(bend.facing, 0.0))
        flesh = bend.radius_px * (FLESH**2 + pulp**2) ** 0.5
        if middle is not None:
            found.append((float(middle[1]) + bend.radius_px - bend.above_bottom, bend.above_bottom_sigma))
        wide = BELIEF * bend.radius_px
        weights = [1.0 / (flesh**2 + (sigma * min(1.0, sigma / wide)) ** 2) for _, sigma in found]
        v = sum(w * x for w, (x, _) in zip(weights, found, strict=True)) / sum(weights)
        apart = sum(w * (x - v) ** 2 for w, (x, _) in zip(weights, found, strict=True))
        k = int(min(max(v, 0.0), last - 1.0))
        low, high = max(k - ROW_PX, 0), min(k + ROW_PX, last)
        slope = float(self.column[high] - self.column[low]) / (high - low)
        u, row = (float(self.column[k]), k) if middle is None else (float(middle[0]), float(middle[1]))
        u += slope * (v - row)
        # What the edges differ by more than they may, all of them may be off by.
        spread = (max(1.0, apart) / sum(weights) + (pulp * bend.radius_px) ** 2 + PIXEL**2) ** 0.5
        return (u, v), spread


def through_end(line: Float, bend: Bend) -> Float:
    """A spine of columns (R,) that leaves the finger's end the way it comes there, not straight up.

    Near the end the middle of what is lit follows its round contour, no longer the bone.
    """
    down = bend.down
    at = [
        (bend.bottom_v - share * bend.radius_px if down else bend.top_v + share * bend.radius_px)
        for share in BEFORE_END
    ]
    first, last = max(int(min(at) / ROW_PX), 1), min(int(max(at) / ROW_PX), len(line) - 1)
    if last - first < 2:
        return line
    about = np.arange(last - first + 1, dtype=np.float64) - 0.5 * (last - first)
    slope = float(about @ line[first : last + 1] / (about @ about))
    slope = min(max(slope, -MOST_LEAN * ROW_PX / SHRINK), MOST_LEAN * ROW_PX / SHRINK)
    out = line.copy()
    beyond = slice(last + 1, None) if down else slice(0, first)
    station = np.arange(len(line), dtype=np.float64)[beyond]
    out[beyond] = line[first : last + 1].mean() + slope * (station - 0.5 * (first + last))
    return out


def full_profile(led: Image, line: Float, finger: int, strips: Strips) -> tuple[Float, Float]:
    """Grey levels (rows,) along a spine of columns (R,), the mean of five pixels, in rows of the full image; and its
    columns (rows,) [px]. Where they leave the image they are NaN."""
    count, (height, width) = len(line) * ROW_PX, led.shape
    at = np.arange(count, dtype=np.float64)
    column = np.interp(at, strips.v[: len(line)], line * SHRINK + 0.5 * (SHRINK - 1))
    if finger != THUMB:
        first = np.rint(column).astype(np.int64).clip(2, width - 3) + np.arange(count, dtype=np.int64) * width
        across: Float = led.ravel()[first[:, None] + _FIVE].mean(axis=1, dtype=np.float64)
        return across, column
    pixel = strips.to_image(THUMB, np.stack([column, at], axis=-1))
    inside = (pixel >= 2.0).all(axis=1) & (pixel[:, 0] < width - 2.5) & (pixel[:, 1] < height - 2.5)
    cell = np.rint(np.where(inside[:, None], pixel, 2.0)).astype(np.int64)
    return np.where(inside, led[cell[:, 1, None], cell[:, :1] + _FIVE].mean(axis=1), np.nan), column


def top_edge(along: Float, near_v: float, radius: float) -> float | None:
    """Row of the contour above a fingertip, where it is expected at `near_v`; None: it is not there, or not shown."""
    low, high = (int(min(max(near_v + x, 1), len(along) - 2)) for x in (-CONTOUR_PX, CONTOUR_PX))
    inside = along[min(int(near_v + 0.5 * radius), high) : max(int(near_v + 1.5 * radius), low) + 1]
    level = max(DARK, EDGE_SHARE * float(np.median(inside))) if inside.size else DARK
    lit = (along[low:high] > level).nonzero()[0]
    if not lit.size or lit[0] == 0:
        return None
    k = low + int(lit[0])
    rise = along[k] - along[k - 1]
    if not np.isfinite(rise):
        return None
    return k - (along[k] - level) / rise if rise > 0.0 else float(k)


def bottom_edge(along: Float, near_v: float, radius: float) -> float | None:
    """Row where the light steps down below a fingertip that is before the palm, expected at `near_v`."""
    low, high = (int(min(max(near_v + x, 5), len(along) - 6)) for x in (-radius, radius))
    if high - low < 4:
        return None
    sums = np.concatenate([[0.0], np.cumsum(along)])
    rows = np.arange(low, high)
    step = (sums[rows] - sums[rows - 4]) - (sums[rows + 5] - sums[rows + 1])
    steepest = int(step.argmax())
    less = (step[steepest:] < BOTTOM_SHARE * step[steepest]).nonzero()[0]
    return float(rows[steepest + (int(less[0]) if less.size else 0)])
