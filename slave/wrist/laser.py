"""Where the laser meets each finger: the line in the laser image, cut between fingers, its centroid by length (D5).

The line runs from side to side, so each column of the image holds it as short bright runs, one per surface. A run's
row is its centre of mass above a share of its own peak: a line that saturates has a flat top and a glow on either side
of it, and only the flanks of the top tell where it is. Runs of adjacent columns are one line where they overlap; a
jump is the border of another surface. The seams say whose a line is; where they cut one, the cut is moved to the
crease. A finger's centroid weighs its line by length in the image, not by columns: at the sides of a finger the line
falls steeply, the last of it in less than a column.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Bool, Float, Image, Int
from slave.wrist.fingers import NONE, Fingers
from slave.wrist.reach import reach_of
from slave.wrist.view import WristView

_FLOOR = 16.0  # grey levels: less is noise even in the dark
_NOISE = 6.0  # standard deviations above the mean of what no laser reaches
_ENOUGH_ROWS = 40  # above the laser's reach, to know the noise from
_OF_BRIGHTEST = 0.1  # of the brightest of the image: less is glow
_OF_NEIGHBOURHOOD = 0.5  # of the brightest within `_NEIGHBOURHOOD` rows: less is glow beside the line
_NEIGHBOURHOOD = np.ones((33, 1), dtype=np.uint8)
_FIVE = np.arange(5)[:, None]
_DOUBLINGS = 10  # links followed: 2^10 columns, more than an image has
_NEAR_PX = 24  # cells in which lines are compared with what is near by
_NEAR = np.ones((5, 3), dtype=np.uint8)
_SECOND = 0.65  # of the brightest run of the same column
_STEEPEST = 8.0  # px of row per root of a column: how fast a line goes round the side of a finger
_FADED = 0.5  # of the brightest of the line: its edge, through the blur of the camera
_GLOW = 0.4  # of the brightest near by: a darker line is glow
_SHORT, _GLOW_OF_SHORT = 8, 0.7  # of so few columns it must be brighter
_TOP, _FLAT_PX = 0.93, 4  # so many pixels as bright as this share of the peak: a flat, saturated top
_OF_PEAK, _OF_FLAT = 0.5, 0.85  # of its peak: what of a run is weighed
_JUMP_PX = 6.0  # between columns: another surface
_THICKEST_PX = 64  # the line on a thumb right before the camera; what is thicker is no line
_FEWEST = 3  # columns of a line
_CREASE_PX = 20  # columns on either side of a seam in which the crease may be
_LEAST_M = 2e-3  # of line that must be seen
# Standard deviations, by what the centroids of simulated hands of several seeds are off by.
_LINE_PX = 0.5  # one whole line
_IN_PARTS_PX = (
    2.0  # a line of several parts, some of which may be another's or hidden, or one cut by the image
)
_FAINT, _FAINT_PX = 3.0 * _FLOOR, 5.0  # a line no brighter: what is left of one where the sun saturates
_BALL_OF_THUMB = 4.0  # of the mean distance of doubtful pieces from the centroid of the thumb
_UNSHOWN_PX = 10.0  # half a finger: no seam was seen


@dataclass(frozen=True, slots=True, eq=False)
class LaserLines:
    """One laser segment per finger, thumb ... little; NaN where none was seen.

    Attributes:
        uv: (5, 2) centroids by length [px].
        sigma_px: (5,) standard deviation per axis.
        length_px: (5,) length.
    """

    uv: Float
    sigma_px: Float
    length_px: Float


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


def laser_lines(laser: Image, fingers: Fingers, view: WristView) -> LaserLines:
    """Find the segments in the difference of laser and ambient frame."""
    reach = reach_of(view)
    runs = line_runs(laser, reach.first_row)
    points: Float = np.stack([runs.column, runs.row], axis=-1, dtype=np.float64)
    finger = fingers.finger_of(points)
    if len(points):
        finger[~_lines(runs)] = NONE
        finger = _at_creases(finger, runs)
        finger[~reach.holds(finger, points)] = NONE
    share = np.ones(len(points))
    thumb = finger == 0
    share[thumb] = reach.of_thumb(points[thumb])
    return _centroids(points, runs, finger, share, view, shown=fingers.shown)


def _centroids(
    points: Float, runs: Runs, finger: Int, share: Float, view: WristView, *, shown: bool
) -> LaserLines:
    """Centroids by length of the pieces of line, each with its share of the finger."""
    on = finger != NONE
    here = np.arange(len(points))
    linked = on & (runs.following != here) & (finger[runs.following] == finger)
    linked_back = on & (runs.preceding != here) & (finger[runs.preceding] == finger)
    right, left = here[on & ~linked], here[on & ~linked_back]
    last = np.concatenate([right, left])
    # Runs to the left and to the right in one row, so that both kinds of ends are gone back from alike.
    back = np.concatenate([runs.preceding, runs.following + len(here)])
    end, inner = _ends(points, finger, last, len(right), back)
    # The links beyond where a line is drawn straight are replaced by the piece to its end.
    bent = right[inner[: len(right)] != right]
    linked[runs.preceding[bent]] = linked[runs.preceding[runs.preceding[bent]]] = False
    bent = left[inner[len(right) :] != left]
    linked[bent] = linked[runs.following[bent]] = False
    a = here[linked]
    b = runs.following[a]
    start = np.concatenate([points[a], points[inner]])
    stop = np.concatenate([points[b], end])
    sure = np.concatenate([(share[a] + share[b]) / 2.0, share[last]])
    of: Bool = np.concatenate([finger[a], finger[last]]) == _FIVE
    middle, piece = (start + stop) / 2.0, np.hypot(*(stop - start).T)
    weight = piece * sure
    line, length, u, v = (of @ np.stack([piece, weight, weight * middle[:, 0], weight * middle[:, 1]], -1)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack([u, v], axis=-1) / length[:, None]
    seen = line * reach_of(view).metres_per_px(uv) >= _LEAST_M
    away = of * np.abs(middle[:, 0] - uv[:, :1])
    away[:, weight == 0.0] = 0.0
    doubt = away @ (weight * (1.0 - sure)) / np.maximum(length, 1e-9)
    ends = finger[right] == _FIVE
    column = points[:, 0]
    cut = finger[(column < 1.0) | (column > view.optics.width_px - 2.0)] == _FIVE
    brightest = ((finger == _FIVE) * runs.peak).max(axis=1, initial=0.0)
    sigma = _sigma_px(doubt, (ends.sum(axis=1) > 1) | cut.any(axis=1), brightest < _FAINT, shown=shown)
    uv[~seen], sigma[~seen], length[~seen] = np.nan, np.nan, np.nan
    return LaserLines(uv, sigma, length)


def _sigma_px(doubt: Float, parts: Bool, faint: Bool, *, shown: bool) -> Float:
    """Standard deviations (5,) of centroids: of lines whole, in parts, faint, doubtful, and where no seam was seen."""
    in_parts = np.where(faint, _FAINT_PX, np.where(parts, _IN_PARTS_PX, 0.0))
    unshown = 0.0 if shown else _UNSHOWN_PX
    return np.sqrt(_LINE_PX**2 + in_parts**2 + (_BALL_OF_THUMB * doubt) ** 2 + unshown**2)


def _ends(points: Float, finger: Int, last: Int, rights: int, back: Int) -> tuple[Float, Int]:
    """Where lines end (E, 2) beyond their last runs (E,), and from which run (E,) on the line is drawn straight there.

    A line goes round a finger until it is seen no more: near its end it falls away as the root of the distance to the
    end does, most of it in less than a column, and dark. So it is continued from a few columns within.

    Args:
        points: (N, 2) of runs.
        finger: (N,) of runs.
        last: The runs, those at right ends first.
        rights: How many they are.
        back: (2 N,) run before each one, then N more than the run after each one.
    """
    count = len(points)
    k = last.copy()
    k[rights:] += count
    inner = back[back[k]]
    deep = back[back[back[inner]]] % count
    inner %= count
    smooth = (np.abs(points[last, 0] - points[deep, 0]) == 5.0) & (finger[deep] == finger[last])
    smooth &= (points[inner, 0] != points[last, 0]) & (finger[inner] == finger[last])
    bend = np.clip((points[deep, 1] - points[inner, 1]) / (np.sqrt(5.5) - np.sqrt(2.5)), 0.0, _STEEPEST)
    end = points[last]
    end[:rights, 0] += 0.5
    end[rights:, 0] -= 0.5
    end[:, 1] = np.where(smooth, points[inner, 1] - bend * np.sqrt(2.5), end[:, 1])
    return end, np.where(smooth, inner, last)


def _at_creases(finger: Int, runs: Runs) -> Int:
    """Fingers (N,) of runs, with each change of finger along a line moved to the crease near by.

    A line bends away at the sides of every finger, so that between two that touch its farthest, in the image its
    uppermost, point is the crease; where no crease is near, the line ends and is one finger's.
    """
    out = finger.copy()
    following = runs.following
    changes = np.flatnonzero((finger != finger[following]) & (finger >= 0) & (finger[following] >= 0))
    for i in changes.tolist():
        back = _climb(i, runs.preceding, runs.row, out == out[i])
        ahead = _climb(int(following[i]), following, runs.row, finger == finger[following[i]])
        line = back[::-1] + ahead
        top = int(runs.row[line].argmin())
        if len(line) - top < _SHORT:
            top = len(line)
        elif top < _SHORT:
            top = 0
        out[line[:top]], out[line[top:]] = out[i], finger[ahead[0]]
    return out


def line_runs(laser: Image, first_row: int) -> Runs:
    """The runs of the rows from `first_row` on."""
    band = laser[first_row:]
    mean, deviation = cv2.meanStdDev(laser[:first_row] if first_row >= _ENOUGH_ROWS else laser)
    noise = float(mean[0, 0]) + _NOISE * float(deviation[0, 0])
    threshold = min(max(_FLOOR, noise, _OF_BRIGHTEST * cv2.minMaxLoc(band)[1]), 255.0)
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


def _lines(runs: Runs) -> Bool:
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
    share = np.where(columns < _SHORT, _GLOW_OF_SHORT, _GLOW)
    bright = (
        (brightest >= share * beside)[line]
        & (runs.peak >= _FADED * brightest[line])
        & (runs.peak >= _SECOND * column[runs.column])
    )
    return bright & (columns >= _FEWEST)[line]


def _climb(start: int, step: Int, row: Float, same: Bool) -> list[int]:
    """Runs from one on along a line, of the same finger: some columns, and farther while it rises in the image."""
    out, k = [start], int(step[start])
    while k != out[-1] and same[k] and (len(out) < _CREASE_PX or row[k] < row[out[-1]]):
        out.append(k)
        k = int(step[k])
    return out


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
