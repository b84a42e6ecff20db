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
_NEIGHBOURHOOD = np.ones((1, 33), dtype=np.uint8)
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
        length_px: (5,) length; 0 where none was seen.
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


def laser_lines(laser: Image, fingers: Fingers, view: WristView) -> LaserLines:
    """Find the segments in the difference of laser and ambient frame."""
    reach = reach_of(view)
    runs = line_runs(laser, reach.first_row)
    points = np.stack([runs.column.astype(np.float64), runs.row], axis=-1)
    finger = fingers.finger_of(points)
    if len(points):
        finger = _at_creases(np.where(_lines(runs), finger, NONE), runs)
        finger = np.where(reach.holds(finger, points), finger, NONE)
    share = np.ones(len(points))
    thumb = finger == 0
    share[thumb] = reach.of_thumb(points[thumb])
    return _centroids(points, runs, finger, share, view, shown=fingers.shown)


def _centroids(
    points: Float, runs: Runs, finger: Int, share: Float, view: WristView, *, shown: bool
) -> LaserLines:
    """Centroids by length of the pieces of line, each with its share of the finger."""
    here = np.arange(len(points))
    kept = (runs.following != here) & (finger[runs.following] == finger)
    starts: list[Float] = []
    stops: list[Float] = []
    owners: list[Int] = []
    for step, back, outwards in (
        (runs.following, runs.preceding, 0.5),
        (runs.preceding, runs.following, -0.5),
    ):
        last = here[(step == here) | (finger[step] != finger)]
        end, inner = _ends(points, finger, last, back, outwards)
        starts.append(points[inner])
        stops.append(end)
        owners.append(last)
        bent = inner != last  # the links beyond `inner` are replaced by the piece to the end
        first, second = (last[bent], back[last[bent]]) if outwards < 0.0 else (inner[bent], back[last[bent]])
        kept[first] = kept[second] = False
    a = here[kept]
    start = np.concatenate([points[a], *starts])
    stop = np.concatenate([points[runs.following[a]], *stops])
    sure = np.concatenate([(share[a] + share[runs.following[a]]) / 2.0, *(share[last] for last in owners)])
    owner = np.concatenate([finger[a], *(finger[last] for last in owners)]) + 1
    middle, whole = (start + stop) / 2.0, np.hypot(*(stop - start).T)
    line = np.bincount(owner, whole, 6)[1:]
    length = np.bincount(owner, whole * sure, 6)[1:].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack(
            [np.bincount(owner, whole * sure * middle[:, k], 6)[1:] / length for k in (0, 1)], axis=-1
        )
    depth = view.on_plane(uv)[:, 2]
    seen = line * depth / view.optics.matrix[0, 0] >= _LEAST_M
    away = whole * sure * (1.0 - sure) * np.abs(middle[:, 0] - uv[owner - 1, 0])
    doubt = np.bincount(owner, away, 6)[1:] / np.maximum(length, 1e-9)
    lines = np.bincount(finger[owners[0]] + 1, minlength=6)[1:]
    column = points[:, 0]
    cut = np.isin(np.arange(5), finger[(column < 1.0) | (column > view.optics.width_px - 2.0)])
    brightest = np.zeros(6)
    np.maximum.at(brightest, finger + 1, runs.peak)
    sigma = _sigma_px(doubt, (lines > 1) | cut, brightest[1:] < _FAINT, shown=shown)
    return LaserLines(
        np.where(seen[:, None], uv, np.nan), np.where(seen, sigma, np.nan), np.where(seen, length, 0.0)
    )


def _sigma_px(doubt: Float, parts: Bool, faint: Bool, *, shown: bool) -> Float:
    """Standard deviations (5,) of centroids: of lines whole, in parts, faint, doubtful, and where no seam was seen."""
    in_parts = np.where(faint, _FAINT_PX, np.where(parts, _IN_PARTS_PX, 0.0))
    unshown = 0.0 if shown else _UNSHOWN_PX
    return np.sqrt(_LINE_PX**2 + in_parts**2 + (_BALL_OF_THUMB * doubt) ** 2 + unshown**2)


def _ends(points: Float, finger: Int, last: Int, back: Int, outwards: float) -> tuple[Float, Int]:
    """Where lines end (E, 2) beyond their last runs (E,), and from which run (E,) on the line is drawn straight there.

    A line goes round a finger until it is seen no more: near its end it falls away as the root of the distance to the
    end does, most of it in less than a column, and dark. So it is continued from a few columns within.
    """
    inner = back[back[last]]
    deep = back[back[back[inner]]]
    smooth = (np.abs(points[last, 0] - points[deep, 0]) == 5.0) & (finger[deep] == finger[last])
    smooth &= (points[inner, 0] != points[last, 0]) & (finger[inner] == finger[last])
    bend = np.clip((points[deep, 1] - points[inner, 1]) / (np.sqrt(5.5) - np.sqrt(2.5)), 0.0, _STEEPEST)
    end = points[last] + [outwards, 0.0]
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
    threshold = max(_FLOOR, noise, _OF_BRIGHTEST * float(band.max()))
    columns = np.flatnonzero(band.max(axis=0) >= threshold)
    rows = np.flatnonzero(band.max(axis=1) >= threshold)
    if not len(columns):
        none = np.empty(0, dtype=np.int64)
        return Runs(none, np.empty(0), none, none, np.empty(0), none, none)
    left, top = int(columns[0]), int(rows[0])
    part = cv2.transpose(band[top : rows[-1] + 1, left : columns[-1] + 1])
    part = cv2.copyMakeBorder(part, 0, 0, 1, 1, cv2.BORDER_CONSTANT, value=0)
    least = cv2.convertScaleAbs(cv2.dilate(part, _NEIGHBOURHOOD), alpha=_OF_NEIGHBOURHOOD)
    on = (part >= np.maximum(least, np.uint8(min(threshold, 255.0)))).ravel()
    edges = np.flatnonzero(on[1:] != on[:-1])
    start, end = edges[::2] + 1, edges[1::2] + 1
    size = end - start
    good = size <= _THICKEST_PX
    start, end, size = start[good], end[good], size[good]
    if not len(start):
        none = np.empty(0, dtype=np.int64)
        return Runs(none, np.empty(0), none, none, np.empty(0), none, none)
    flat = part.ravel()
    first = np.cumsum(size) - size
    of_run = np.repeat(np.arange(len(size)), size)
    inside = np.arange(len(of_run)) - first[of_run]
    level = flat[start[of_run] + inside].astype(np.float64)
    peak = np.maximum.reduceat(level, first)
    flat = np.add.reduceat(level > _TOP * peak[of_run], first, dtype=np.int64) >= _FLAT_PX
    above = np.maximum(level - (np.where(flat, _OF_FLAT, _OF_PEAK) * peak)[of_run], 0.0)
    centre = np.add.reduceat(above * inside, first) / np.add.reduceat(above, first)
    width = part.shape[1]
    column = start // width
    begin = start - column * width - 1 + top + first_row
    runs = Runs(column + left, begin + centre, begin, begin + size, peak, column, column)
    following = _following(runs)
    here = np.arange(len(column))
    preceding = here.copy()
    on = following != here
    preceding[following[on]] = here[on]
    return Runs(runs.column, runs.row, runs.start, runs.end, peak, following, preceding)


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


def _following(runs: Runs) -> Int:
    key = runs.column * 1024.0 + runs.row
    here = np.arange(len(key))
    after = np.searchsorted(key, key + 1024.0)
    best = here.copy()
    gap = np.full(len(key), np.inf)
    for shift in (-1, 0):
        k = np.clip(after + shift, 0, len(key) - 1)
        ok = (runs.column[k] == runs.column + 1) & (runs.start[k] <= runs.end) & (runs.end[k] >= runs.start)
        distance = np.where(ok, np.abs(runs.row[k] - runs.row), np.inf)
        nearer = distance < np.minimum(gap, _JUMP_PX)
        best, gap = np.where(nearer, k, best), np.where(nearer, distance, gap)
    return best
