"""Where the laser meets each finger: the line in the laser image, cut between fingers, its centroid by length (D5).

The line runs from side to side, so each column of the image holds it as short bright runs (`slave.wrist.runs`), one
per surface. The seams say whose a line is; where they cut one, the cut is moved to the crease. A finger's centroid
weighs its line by length in the image, not by columns: at the sides of a finger the line falls steeply, the last of it
in less than a column.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Image, Int
from slave.wrist.fingers import NONE, Fingers
from slave.wrist.reach import reach_of
from slave.wrist.runs import FLOOR, SHORT, Runs, in_lines, line_runs
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


def laser_lines(laser: Image, fingers: Fingers, view: WristView) -> LaserLines:
    """Find the segments in the difference of laser and ambient frame."""
    reach = reach_of(view)
    runs = line_runs(laser, reach.first_row)
    points: Float = np.stack([runs.column, runs.row], axis=-1, dtype=np.float64)
    finger = fingers.finger_of(points)
    if len(points):
        finger[~in_lines(runs)] = NONE
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
    apart = _apart(points, finger, left, linked_back, runs.following)
    column = points[:, 0]
    cut = finger[(column < 1.0) | (column > view.optics.width_px - 2.0)] == _FIVE
    brightest = ((finger == _FIVE) * runs.peak).max(axis=1, initial=0.0)
    sigma = _sigma_px(doubt, apart, cut.any(axis=1), brightest < _FAINT, shown=shown)
    uv[~seen], sigma[~seen], length[~seen] = np.nan, np.nan, np.nan
    return LaserLines(uv, sigma, length)


def _apart(points: Float, finger: Int, left: Int, goes_on: Bool, following: Int) -> Float:
    """Half of how far (5,) [px] the middle of a finger's line in parts lies from that of its longest part alone.

    NaN where the line is whole.

    Args:
        points: (N, 2) of runs.
        finger: (N,) of runs.
        left: The runs at left ends.
        goes_on: (N,) whether a run continues another of its finger.
        following: (N,) of runs.
    """
    out = np.full(5, np.nan)
    for of in range(5):
        starts = left[finger[left] == of].tolist()
        if len(starts) < 2:
            continue
        middles: list[Float] = []
        columns: list[int] = []
        for k in starts:
            part = [k]
            while (after := int(following[part[-1]])) != part[-1] and goes_on[after] and finger[after] == of:
                part.append(after)
            middles.append(points[part].mean(axis=0))
            columns.append(len(part))
        whole = np.average(middles, axis=0, weights=columns)
        out[of] = 0.5 * float(np.hypot(*(whole - middles[int(np.argmax(columns))])))
    return out


def _sigma_px(doubt: Float, apart: Float, cut: Bool, faint: Bool, *, shown: bool) -> Float:
    """Standard deviations (5,) of centroids: of lines whole, in parts, faint, doubtful, and where no seam was seen.

    Of a line in parts all but the longest may be another finger's, or what hides the middle of its own.
    """
    in_parts = np.where(np.isnan(apart), np.where(cut, _IN_PARTS_PX, 0.0), np.fmax(apart, _IN_PARTS_PX))
    in_parts = np.where(faint, np.maximum(_FAINT_PX, in_parts), in_parts)
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
        if len(line) - top < SHORT:
            top = len(line)
        elif top < SHORT:
            top = 0
        out[line[:top]], out[line[top:]] = out[i], finger[ahead[0]]
    return out


def _climb(start: int, step: Int, row: Float, same: Bool) -> list[int]:
    """Runs from one on along a line, of the same finger: some columns, and farther while it rises in the image."""
    out, k = [start], int(step[start])
    while k != out[-1] and same[k] and (len(out) < _CREASE_PX or row[k] < row[out[-1]]):
        out.append(k)
        k = int(step[k])
    return out
