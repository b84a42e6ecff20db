"""Find bright runs in a laser image, join them to lines, and measure the lines.

Lines are the laser segments of Kim et al. 2012; rows are known to parts of a pixel. A run's row is its centre of mass
above a share of its own peak: a saturated line has a flat top and a glow on either side, and only the flanks of the
top measure where it is. Runs of adjacent columns are one line where they overlap; a jump is the border of another
surface. A finger's centroid weighs its line by length in the image, not by columns: at the sides of a finger the line
falls steeply, the last of it in less than a column.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from common.arrays import Bool, Float, Image, Int


class RunSettings(NamedTuple):
    """Numbers of the search for the laser line in image columns."""

    floor: float = 16.0  # grey levels: less is noise even in the dark
    short: int = 8  # of so few columns it must be brighter
    # so many pixels as bright as this share of the peak: a flat, saturated top
    top: float = 0.93
    flat_px: int = 4
    # of its peak: what of a run is weighed
    of_peak: float = 0.5
    of_flat: float = 0.85
    column: float = 1024.0  # rows of a column when all are counted through: more than an image has
    jump_px: float = 6.0  # between columns: another surface
    thickest_px: int = 64  # the line on a thumb right before the camera; what is thicker is no line
    steepest: float = 8.0  # px of row per root of a column: how fast a line goes round the side of a finger
    long: int = 5  # columns from one end of a line to the other, from which on its ends are drawn straight


SETTINGS = RunSettings()
_NEIGHBOURHOOD = np.ones((33, 1), dtype=np.uint8)
_NEAR = np.ones((5, 3), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """N bright runs of columns, line after line, and in each column by column.

    Attributes:
        row: (N,) sub-pixel.
        start, end: (N,) first row, and the one after the last.
        peak: (N,) grey levels.
        first: (L,) the first run of each line.
        joins: (L,) the line that each line runs into at its right end, or that one does, and so on; or the line itself.
    """

    column: Int
    row: Float
    start: Int
    end: Int
    peak: Float
    first: Int
    joins: Int


_NONE_INT: Int = np.empty(0, dtype=np.int64)
NO_LINES: tuple[Runs, Bool] = (
    Runs(_NONE_INT, np.empty(0), _NONE_INT, _NONE_INT, np.empty(0), _NONE_INT, _NONE_INT),
    np.empty(0, np.bool_),
)


def bright(laser: Image, first_row: int) -> tuple[Image, Image, tuple[int, int]]:
    """Part (w, h) of an image that may be lines, levels (w, h) to exceed, its corner."""
    band = laser[first_row:]
    enough_rows = 40  # above the laser's reach, to know the noise from
    mean, deviation = cv2.meanStdDev(laser[:first_row] if first_row >= enough_rows else laser)
    # standard deviations above the mean of what no laser reaches
    noise = float(mean[0, 0]) + 6.0 * float(deviation[0, 0])
    of_brightest = 0.1  # of the brightest of the image: less is glow
    threshold = min(max(SETTINGS.floor, noise, of_brightest * cv2.minMaxLoc(band)[1]), 255.0)
    band = cv2.threshold(band, np.ceil(threshold) - 1.0, 0.0, cv2.THRESH_TOZERO)[1]
    left, top, width, height = cv2.boundingRect(band)
    corner = (left, top + first_row)
    band = band[top : top + height, left : left + width]
    if not band.size:
        return np.empty((0, 0), np.uint8), np.empty((0, 0), np.uint8), corner
    of_neighbourhood = 0.5  # of the brightest within `_NEIGHBOURHOOD` rows: less is glow beside the line
    # Above a half less 3/4: half or more, and not 0.
    least = cv2.convertScaleAbs(cv2.dilate(band, _NEIGHBOURHOOD), alpha=of_neighbourhood, beta=-0.75)
    return np.asarray(cv2.transpose(band), np.uint8), np.asarray(cv2.transpose(least), np.uint8), corner


def lines(laser: Image, first_row: int) -> tuple[Runs, Bool]:
    """Runs of the rows from `first_row` on, and which (N,) lie on a line."""
    band, least, (left, top) = bright(laser, first_row)
    if not band.size:
        return NO_LINES
    width, height = band.shape
    over = np.zeros((width, height + 2), np.uint8)
    over[:, 1:-1] = cv2.compare(band, least, cv2.CMP_GT)
    levels = band[over[:, 1:-1].view(np.bool_)]
    flat = over.ravel()
    edges = np.flatnonzero(flat[1:] != flat[:-1])
    column, begin = np.divmod(edges[::2], height + 2)
    size = edges[1::2] - edges[::2]
    good = size <= SETTINGS.thickest_px
    if not good.all():
        levels = levels[np.repeat(good, size)]
        column, begin, size = column[good], begin[good], size[good]
    if not len(size):
        return NO_LINES
    centre, peak = _across(levels, size)
    column += left
    begin += top
    runs = _linked(column, begin + centre, begin, begin + size, peak)
    return runs, in_lines(runs)


def _across(levels: Image, size: Int) -> tuple[Float, Float]:
    """Centres (N,) beyond first rows [px] and peaks of runs `size` (N,), in a row."""
    first = np.cumsum(size)
    first -= size
    peak = np.maximum.reduceat(levels, first).astype(np.float32)
    level = levels.astype(np.float32)
    flat = (
        np.add.reduceat(level > np.repeat(SETTINGS.top * peak, size), first, dtype=np.int64)
        >= SETTINGS.flat_px
    )
    level -= np.repeat(np.where(flat, SETTINGS.of_flat, SETTINGS.of_peak) * peak, size)
    np.maximum(level, 0.0, out=level)
    whole = np.add.reduceat(level, first)
    level *= np.arange(len(levels)) - np.repeat(first, size)
    return np.add.reduceat(level, first, dtype=np.float64) / whole, peak.astype(np.float64)


def in_lines(runs: Runs) -> Bool:
    """Return which runs belong to a line: long enough, and no glow of what is near."""
    peak, joins = runs.peak, runs.joins
    columns = np.diff(np.append(runs.first, len(peak)))
    brightest = np.zeros(len(joins))
    np.maximum.at(brightest, joins, np.maximum.reduceat(peak, runs.first))
    near_px = 24  # cells in which lines are compared with what is near by
    row, column = runs.start // near_px, runs.column // near_px
    across = int(column.max()) + 1
    cell = row * across + column
    around = np.zeros((int(row.max()) + 1) * across)
    np.maximum.at(around, cell, peak)
    near = np.asarray(cv2.dilate(around.reshape(-1, across), _NEAR), np.float64).ravel()[cell]
    nearby = np.zeros(len(joins))
    np.maximum.at(nearby, joins, np.maximum.reduceat(near, runs.first))
    of_column = np.zeros(int(runs.column.max()) + 1)
    np.maximum.at(of_column, runs.column, peak)
    joined = np.bincount(joins, columns, len(joins))
    glow = 0.4  # of the brightest near by: a darker line is glow
    glow_of_short = 0.7  # of so few columns it must be brighter
    share = np.where(joined < SETTINGS.short, glow_of_short, glow)
    fewest = 3  # columns of a line
    line = (brightest >= share * nearby) & (joined >= fewest)
    faded = 0.5  # of the brightest of the line: its edge, through the blur of the camera
    least = np.repeat(np.where(line, faded * brightest, np.inf)[joins], columns)
    second = 0.65  # of the brightest run of the same column
    np.maximum(least, second * of_column[runs.column], out=least)
    return peak >= least


def _linked(column: Int, row: Float, start: Int, end: Int, peak: Float) -> Runs:
    """Link sorted runs (N,) to the nearest that they overlap; farther ones join."""
    there = (column + 1) * SETTINGS.column + row  # the same row of the next column
    after = np.searchsorted(there - SETTINGS.column, there)
    off_above = there - (there - SETTINGS.column)[after - 1]
    off_below = np.append(there - SETTINGS.column, np.inf)[after] - there
    off = np.minimum(off_above, off_below)
    near = after - (off_above <= off_below)
    here = np.flatnonzero(
        (off < SETTINGS.jump_px) & (start[near % len(near)] <= end) & (end[near % len(near)] >= start)
    )
    to = near[here]  # rising, as lines do not cross
    lost: list[tuple[Int, Int]] = []
    while (twice := to[1:] == to[:-1]).any():
        k = np.flatnonzero(twice)
        farther = np.unique(k + (off[here[k + 1]] >= off[here[k]]))
        lost.append((here[farther], to[farther]))
        here, to = np.delete(here, farther), np.delete(to, farther)
    line = np.arange(len(column))
    line[here] = to
    for _ in range(int(column[-1] - column[0]).bit_length()):  # twice as far each time
        line = line[line]
    order = np.argsort(line, kind="stable")
    ends = line[order]
    first = np.concatenate([[0], np.flatnonzero(ends[1:] != ends[:-1]) + 1])
    joins = np.arange(len(first))
    for source, target in lost:
        joins[np.searchsorted(ends[first], line[source])] = np.searchsorted(ends[first], line[target])
    for _ in lost:
        joins = joins[joins]
    return Runs(column[order], row[order], start[order], end[order], peak[order], first, joins)


NONE = -1  # no finger


class FingerLines(NamedTuple):
    """The line of each finger, thumb ... little.

    Attributes:
        line: (5,) its length [px].
        uv: (5, 2) its centroid [px]; NaN: none.
        split_px: (5,) half the way from the middle of a line in parts to that of its longest part; NaN: whole.
        cut: (5,) whether the image ends on it.
        brightest: (5,) its highest level.
    """

    line: Float
    uv: Float
    split_px: Float
    cut: Bool
    brightest: Float


def measure(runs: Runs, finger: Int, width_px: int) -> FingerLines:
    """Measure the lines of runs (N,) by finger, `NONE`: nobody's."""
    points: Float = np.stack([runs.column, runs.row], axis=-1, dtype=np.float64)
    on = finger != NONE
    goes_on = finger[1:] == finger[:-1]
    goes_on &= on[1:]
    goes_on[runs.first[1:] - 1] = False
    linked = np.zeros(len(on) + 1, dtype=np.bool_)  # whether a run goes on from the one before
    linked[1:-1] = goes_on
    left, right = np.flatnonzero(on & ~linked[:-1]), np.flatnonzero(on & ~linked[1:])
    outer, inner = _ends(points, left, right)
    # Pieces from run to run, of which those beyond `inner` are none: from there a line is drawn straight to its end.
    u, v = runs.column.astype(np.float64), runs.row
    down = v[1:] - v[:-1]
    segment = np.sqrt(down * down + 1.0) * goes_on
    long_lines = np.flatnonzero(inner[: len(left)] != left)
    for k in (left[long_lines], left[long_lines] + 1, right[long_lines] - 1, right[long_lines] - 2):
        segment[k] = 0.0
    last = np.concatenate([left, right])
    to_end = outer - points[inner]
    # No hypot, no products of matrices: this way the bits are the same on every processor.
    segment = np.concatenate([segment, np.sqrt((to_end * to_end).sum(axis=1))])
    middle_u = np.concatenate([u[:-1] + 0.5, (outer[:, 0] + u[inner]) / 2.0])
    middle_v = np.concatenate([(v[1:] + v[:-1]) / 2.0, (outer[:, 1] + v[inner]) / 2.0])
    of = np.concatenate([finger[:-1], finger[last]]) + 1
    line = _of_fingers(of, segment)
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack([_of_fingers(of, segment * m) / line for m in (middle_u, middle_v)], axis=-1)
    cut = np.zeros(5, dtype=np.bool_)
    cut[finger[on & ((u < 1.0) | (u > width_px - 2.0))]] = True
    brightest = np.zeros(6)
    np.maximum.at(brightest, finger, runs.peak)  # those of no finger come last
    return FingerLines(line, uv, _split_px(points, finger, left, right), cut, brightest[:5])


def _of_fingers(of: Int, weight: Float) -> Float:
    """Return the sums (5,) of weights (M,) by finger, from 1; 0: no finger."""
    return np.asarray(np.bincount(of, weight, 6)[1:], np.float64)


def _split_px(points: Float, finger: Int, left: Int, right: Int) -> Float:
    """`FingerLines.split_px` (5,), by the first and last run of each part."""
    out = np.full(5, np.nan)
    part = finger[left]
    for of in np.flatnonzero(np.bincount(part, minlength=5) > 1).tolist():
        parts = np.flatnonzero(part == of)
        middles = np.array(
            [points[a : b + 1].mean(axis=0) for a, b in zip(left[parts], right[parts], strict=True)]
        )
        columns = right[parts] - left[parts] + 1
        whole = (columns[:, None] * middles).sum(axis=0) / columns.sum()
        out[of] = 0.5 * float(np.hypot(*(whole - middles[int(columns.argmax())])))
    return out


def _ends(points: Float, left: Int, right: Int) -> tuple[Float, Int]:
    """Ends (2 P, 2) of lines, and the runs (2 P,) from which they go on straight.

    Left ends first. A line goes round a finger until it is seen no more: near its end it falls away as the root of the
    distance to the end does, most of it in less than a column, and dark. So a long one is continued from within.
    """
    long = np.where(right - left >= SETTINGS.long, 1, 0)
    inner = np.concatenate([left + 2 * long, right - 2 * long])
    deep = np.concatenate([left + 5 * long, right - 5 * long])
    outer = points[np.concatenate([left, right])]
    outer[: len(left), 0] -= 0.5
    outer[len(left) :, 0] += 0.5
    steepness = (points[deep, 1] - points[inner, 1]) / (np.sqrt(5.5) - np.sqrt(2.5))
    steepness = np.clip(steepness, 0.0, SETTINGS.steepest)
    outer[:, 1] = points[inner, 1] - steepness * np.sqrt(2.5)
    return outer, inner
