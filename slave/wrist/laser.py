"""Where the laser meets each finger: the line in the laser image, cut between fingers, its centroid by length (D5).

The line runs from side to side, so each column of the image holds it as short bright runs (`slave.wrist.runs`), one
per surface. The seams say whose a line is; where they cut one, the cut is moved to the crease. A finger's centroid
weighs its line by length in the image, not by columns: at the sides of a finger the line falls steeply, the last of it
in less than a column.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Image, Int
from slave.wrist.engine import NUMPY, Engine
from slave.wrist.fingers import NONE, Fingers
from slave.wrist.reach import reach_of
from slave.wrist.runs import FLOOR, SHORT, Runs
from slave.wrist.view import WristView

_FIVE = np.arange(5)[:, None]
_STEEPEST = 8.0  # px of row per root of a column: how fast a line goes round the side of a finger
_CREASE_PX = 20  # columns on either side of a seam in which the crease may be
_LEAST_M = 2e-3  # of line that must be seen
# Standard deviations, by what the centroids of simulated hands of several seeds are off by.
_LINE_PX = 0.5  # one whole line
_IN_PARTS_PX = 2.0  # at least, of a line in parts, some of which may be another's, or of one cut by the image
_FAINT, _FAINT_PX = 3.0 * FLOOR, 5.0  # a line no brighter: what is left of one where the sun saturates
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


def laser_lines(laser: Image, fingers: Fingers, view: WristView, engine: Engine = NUMPY) -> LaserLines:
    """Find the segments in the difference of laser and ambient frame."""
    reach = reach_of(view)
    runs, on_line = engine.lines(laser, reach.first_row)
    if not len(runs.row):
        return LaserLines(np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan))
    points: Float = np.stack([runs.column, runs.row], axis=-1, dtype=np.float64)
    finger = fingers.finger_of(points)
    finger[~on_line] = NONE
    finger = _at_creases(finger, runs)
    finger[~reach.holds(finger, points)] = NONE
    share = None
    if len(thumb := np.flatnonzero(finger == 0)):
        share = np.ones(len(points))
        share[thumb] = reach.of_thumb(points[thumb])
    return _centroids(points, runs, finger, share, view, shown=fingers.shown)


def _centroids(
    points: Float, runs: Runs, finger: Int, share: Float | None, view: WristView, *, shown: bool
) -> LaserLines:
    """Centroids by length of the pieces of line, each with its share (N,) of the finger; None: wholly the finger's."""
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
    piece = np.sqrt(down * down + 1.0) * goes_on
    bent = np.flatnonzero(inner[: len(left)] != left)
    for k in (left[bent], left[bent] + 1, right[bent] - 1, right[bent] - 2):
        piece[k] = 0.0
    last = np.concatenate([left, right])
    to_end = outer - points[inner]
    piece = np.concatenate([piece, np.hypot(to_end[:, 0], to_end[:, 1])])
    middle_u = np.concatenate([u[:-1] + 0.5, (outer[:, 0] + u[inner]) / 2.0])
    middle_v = np.concatenate([(v[1:] + v[:-1]) / 2.0, (outer[:, 1] + v[inner]) / 2.0])
    of = np.concatenate([finger[:-1], finger[last]]) + 1
    line, doubt = _of_fingers(of, piece), np.zeros(5)
    sure = (
        np.ones(len(of)) if share is None else np.concatenate([(share[1:] + share[:-1]) / 2.0, share[last]])
    )
    weight = piece * sure
    length = _of_fingers(of, weight)
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack([_of_fingers(of, weight * m) / length for m in (middle_u, middle_v)], axis=-1)
    if share is not None:  # of the thumb alone
        away = np.abs(middle_u - uv[0, 0]) * (weight * (1.0 - sure)) * (of == 1)
        doubt[0] = away.sum() / max(length[0], 1e-9)
    seen = line * reach_of(view).metres_per_px(uv) >= _LEAST_M
    cut = np.zeros(5, dtype=np.bool_)
    cut[finger[on & ((u < 1.0) | (u > view.optics.width_px - 2.0))]] = True
    brightest = np.zeros(6)
    np.maximum.at(brightest, finger, runs.peak)  # those of no finger come last
    apart = _apart(points, finger, left, right)
    sigma = _sigma_px(doubt, apart, cut, brightest[:5] < _FAINT, shown=shown)
    uv[~seen], sigma[~seen], length[~seen] = np.nan, np.nan, np.nan
    return LaserLines(uv, sigma, length)


def _of_fingers(of: Int, weight: Float) -> Float:
    """Sums (5,) of weights (M,) by finger, which `of` (M,) counts from 1; 0: no finger."""
    return np.asarray(np.bincount(of, weight, 6)[1:], np.float64)


def _apart(points: Float, finger: Int, left: Int, right: Int) -> Float:
    """Half of how far (5,) [px] the middle of a finger's line in parts lies from that of its longest part alone.

    NaN where the line is whole.

    Args:
        points: (N, 2) of runs.
        finger: (N,) of runs.
        left: (P,) the first run of each part.
        right: (P,) the last one.
    """
    out = np.full(5, np.nan)
    part = finger[left]
    for of in np.flatnonzero(np.bincount(part, minlength=5) > 1).tolist():
        parts = np.flatnonzero(part == of)
        middles = np.array(
            [points[a : b + 1].mean(axis=0) for a, b in zip(left[parts], right[parts], strict=True)]
        )
        columns = right[parts] - left[parts] + 1
        whole = columns @ middles / columns.sum()
        out[of] = 0.5 * float(np.hypot(*(whole - middles[int(columns.argmax())])))
    return out


def _sigma_px(doubt: Float, apart: Float, cut: Bool, faint: Bool, *, shown: bool) -> Float:
    """Standard deviations (5,) of centroids: of lines whole, in parts, faint, doubtful, and where no seam was seen.

    Of a line in parts all but the longest may be another finger's, or what hides the middle of its own.
    """
    in_parts = np.where(np.isnan(apart), np.where(cut, _IN_PARTS_PX, 0.0), np.fmax(apart, _IN_PARTS_PX))
    in_parts = np.where(faint, np.maximum(_FAINT_PX, in_parts), in_parts)
    unshown = 0.0 if shown else _UNSHOWN_PX
    return np.sqrt(_LINE_PX**2 + in_parts**2 + (_BALL_OF_THUMB * doubt) ** 2 + unshown**2)


def _ends(points: Float, left: Int, right: Int) -> tuple[Float, Int]:
    """Where lines end (2 P, 2) beyond their first and last runs (P,), and from which runs (2 P,) on straight; left
    ends first.

    A line goes round a finger until it is seen no more: near its end it falls away as the root of the distance to the
    end does, most of it in less than a column, and dark. So a long one is continued from a few columns within.
    """
    long = np.where(right - left >= 5, 1, 0)
    inner = np.concatenate([left + 2 * long, right - 2 * long])
    deep = np.concatenate([left + 5 * long, right - 5 * long])
    outer = points[np.concatenate([left, right])]
    outer[: len(left), 0] -= 0.5
    outer[len(left) :, 0] += 0.5
    bend = np.clip((points[deep, 1] - points[inner, 1]) / (np.sqrt(5.5) - np.sqrt(2.5)), 0.0, _STEEPEST)
    outer[:, 1] = points[inner, 1] - bend * np.sqrt(2.5)
    return outer, inner


def _at_creases(finger: Int, runs: Runs) -> Int:
    """Fingers (N,) of runs, with each change of finger along a line moved to the crease near by.

    A line bends away at the sides of every finger, so that between two that touch its farthest, in the image its
    uppermost, point is the crease; where no crease is near, the line ends and is one finger's.
    """
    out = finger.copy()
    change = finger[1:] != finger[:-1]
    change &= (finger[1:] >= 0) & (finger[:-1] >= 0)
    change[runs.first[1:] - 1] = False
    for i in np.flatnonzero(change).tolist():
        of_line = int(np.searchsorted(runs.first, i, side="right"))
        end = int(runs.first[of_line]) if of_line < len(runs.first) else len(finger)
        begin = _climb(i, range(i - 1, int(runs.first[of_line - 1]) - 1, -1), runs.row, out == out[i])
        stop = _climb(i + 1, range(i + 2, end), runs.row, finger == finger[i + 1]) + 1
        top = begin + int(runs.row[begin:stop].argmin())
        if stop - top < SHORT:
            top = stop
        elif top - begin < SHORT:
            top = begin
        out[begin:top], out[top:stop] = out[i], finger[i + 1]
    return out


def _climb(start: int, along: range, row: Float, same: Bool) -> int:
    """The last run from one on along a line, of the same finger: some columns, and farther while it rises."""
    last = start
    for count, k in enumerate(along, 1):
        if not (same[k] and (count < _CREASE_PX or row[k] < row[last])):
            break
        last = k
    return last
