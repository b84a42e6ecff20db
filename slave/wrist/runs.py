"""The bright runs of a laser image's columns, to parts of a pixel, and the lines they make with those beside them (D5).

A run's row is its centre of mass above a share of its own peak: a line that saturates has a flat top and a glow on
either side of it, and only the flanks of the top tell where it is. Runs of adjacent columns are one line where they
overlap; a jump is the border of another surface.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Bool, Float, Image, Int

FLOOR = 16.0  # grey levels: less is noise even in the dark
_NOISE = 6.0  # standard deviations above the mean of what no laser reaches
_ENOUGH_ROWS = 40  # above the laser's reach, to know the noise from
_OF_BRIGHTEST = 0.1  # of the brightest of the image: less is glow
_OF_NEIGHBOURHOOD = 0.5  # of the brightest within `_NEIGHBOURHOOD` rows: less is glow beside the line
_NEIGHBOURHOOD = np.ones((33, 1), dtype=np.uint8)
_DOUBLINGS = 10  # links followed: 2^10 columns, more than an image has
_NEAR_PX = 24  # cells in which lines are compared with what is near by
_NEAR = np.ones((5, 3), dtype=np.uint8)
_SECOND = 0.65  # of the brightest run of the same column
_FADED = 0.5  # of the brightest of the line: its edge, through the blur of the camera
_GLOW = 0.4  # of the brightest near by: a darker line is glow
SHORT, _GLOW_OF_SHORT = 8, 0.7  # of so few columns it must be brighter
_TOP, _FLAT_PX = 0.93, 4  # so many pixels as bright as this share of the peak: a flat, saturated top
_OF_PEAK, _OF_FLAT = 0.5, 0.85  # of its peak: what of a run is weighed
_JUMP_PX = 6.0  # between columns: another surface
_THICKEST_PX = 64  # the line on a thumb right before the camera; what is thicker is no line
_FEWEST = 3  # columns of a line


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Bright runs of columns, by column and then by row; N of them.

    Attributes:
        column: (N,).
        row: (N,) sub-pixel.
        start, end: (N,) first row, and the one after the last.
        peak: (N,) grey levels.
        following: (N,) index of the run of the next column that continues this one, or the run itself.
        preceding: (N,) index of a run that this one continues, or the run itself.
    """

    column: Int
    row: Float
    start: Int
    end: Int
    peak: Float
    following: Int
    preceding: Int


_NONE_INT: Int = np.empty(0, dtype=np.int64)
_NO_RUNS = Runs(_NONE_INT, np.empty(0), _NONE_INT, _NONE_INT, np.empty(0), _NONE_INT, _NONE_INT)


def line_runs(laser: Image, first_row: int) -> Runs:
    """The runs of the rows from `first_row` on."""
    band = laser[first_row:]
    mean, deviation = cv2.meanStdDev(laser[:first_row] if first_row >= _ENOUGH_ROWS else laser)
    noise = float(mean[0, 0]) + _NOISE * float(deviation[0, 0])
    threshold = min(max(FLOOR, noise, _OF_BRIGHTEST * cv2.minMaxLoc(band)[1]), 255.0)
    band = cv2.threshold(band, np.ceil(threshold) - 1.0, 0.0, cv2.THRESH_TOZERO)[1]
    left, top, width, height = cv2.boundingRect(band)
    band = band[top : top + height, left : left + width]
    if not band.size:
        return _NO_RUNS
    least = cv2.convertScaleAbs(cv2.dilate(band, _NEIGHBOURHOOD), alpha=_OF_NEIGHBOURHOOD, beta=-0.75)
    bright = cv2.transpose(
        cv2.compare(band, least, cv2.CMP_GT)
    )  # above a half less 3/4: half or more, and not 0
    bright = cv2.copyMakeBorder(bright, 0, 0, 1, 1, cv2.BORDER_CONSTANT, value=0).ravel()
    edges = np.flatnonzero(bright[1:] != bright[:-1])
    column, begin = np.divmod(edges[::2], height + 2)
    size = edges[1::2] - edges[::2]
    good = size <= _THICKEST_PX
    column, begin, size = column[good], begin[good], size[good]
    if not len(size):
        return _NO_RUNS
    centre, peak = _across(np.asarray(band, np.uint8), column, begin, size)
    column += left
    begin += top + first_row
    return _linked(column, begin + centre, begin, begin + size, peak)


def _across(band: Image, column: Int, begin: Int, size: Int) -> tuple[Float, Float]:
    """Where the centres of runs (N,) are beyond their first rows [px], and their peaks (N,) [grey levels]."""
    stop = np.cumsum(size)
    first = stop - size
    along = np.arange(int(stop[-1]))  # through all runs, one after another
    width = band.shape[1]
    pixels = np.repeat((begin - first) * width + column, size) + along * width
    level = np.ascontiguousarray(band).ravel()[pixels].astype(np.float64)
    peak = np.maximum.reduceat(level, first)
    flat = np.add.reduceat(level > np.repeat(_TOP * peak, size), first, dtype=np.int64) >= _FLAT_PX
    level -= np.repeat(np.where(flat, _OF_FLAT, _OF_PEAK) * peak, size)
    np.maximum(level, 0.0, out=level)
    whole = np.add.reduceat(level, first)
    level *= along
    return np.add.reduceat(level, first) / whole - first, peak


def in_lines(runs: Runs) -> Bool:
    """Which runs belong to a line: long enough, and not much darker than what is near, as a glow is."""
    line = runs.following
    for _ in range(_DOUBLINGS):
        line = line[line]
    brightest = np.zeros(len(line))
    np.maximum.at(brightest, line, runs.peak)
    row, column = runs.start // _NEAR_PX, runs.column // _NEAR_PX
    around = np.zeros((int(row.max()) + 1, int(column.max()) + 1), dtype=np.float32)
    np.maximum.at(around, (row, column), runs.peak.astype(np.float32))
    around = cv2.dilate(around, _NEAR)[row, column]
    beside = np.zeros(len(line))
    np.maximum.at(beside, line, around)
    column = np.zeros(int(runs.column[-1]) + 1)
    np.maximum.at(column, runs.column, runs.peak)
    columns = np.bincount(line, minlength=len(line))
    share = np.where(columns < SHORT, _GLOW_OF_SHORT, _GLOW)
    bright = (
        (brightest >= share * beside)[line]
        & (runs.peak >= _FADED * brightest[line])
        & (runs.peak >= _SECOND * column[runs.column])
    )
    return bright & (columns >= _FEWEST)[line]


def _linked(column: Int, row: Float, start: Int, end: Int, peak: Float) -> Runs:
    """Runs (N,) with the nearest of those of the next column that each overlaps."""
    here = np.arange(len(column))
    key = column * 1024.0 + row
    after = np.searchsorted(key, key + 1024.0)
    near = np.stack(
        [after - 1, np.minimum(after, len(key) - 1)]
    )  # the next above and below in the next column
    off = np.abs(row[near] - row)
    off[(column[near] != column + 1) | (start[near] > end) | (end[near] < start)] = np.inf
    nearest = near[(off[1] < off[0]).astype(np.int64), here]
    following = np.where(off.min(axis=0) < _JUMP_PX, nearest, here)
    preceding = here.copy()
    on = following != here
    preceding[following[on]] = here[on]
    return Runs(column, row, start, end, peak, following, preceding)
