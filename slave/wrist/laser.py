"""Where the laser meets each finger: the line in the laser image, cut between fingers, its centroid by length (D5).

The line runs from side to side, so each column of the image holds it as short bright runs (`slave.wrist.runs`), one
per surface. The seams say whose a line is; where they cut one, the cut is moved to the crease. What is left to each
finger is measured (`slave.wrist.pieces`).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Image, Int
from slave.wrist.engine import NUMPY, Engine
from slave.wrist.fingers import Fingers
from slave.wrist.pieces import NONE, Pieces
from slave.wrist.reach import reach_of
from slave.wrist.runs import FLOOR, SHORT, Runs
from slave.wrist.view import WristView

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
    pieces = engine.measure(runs, finger, share, view.optics.width_px)
    seen = pieces.line * reach.metres_per_px(pieces.uv) >= _LEAST_M
    sigma = _sigma_px(pieces, shown=fingers.shown)
    uv, length = pieces.uv, pieces.length
    uv[~seen], sigma[~seen], length[~seen] = np.nan, np.nan, np.nan
    return LaserLines(uv, sigma, length)


def _sigma_px(pieces: Pieces, *, shown: bool) -> Float:
    """Standard deviations (5,) of centroids: of lines whole, in parts, faint, doubtful, and where no seam was seen.

    Of a line in parts all but the longest may be another finger's, or what hides the middle of its own.
    """
    apart = pieces.apart
    in_parts = np.where(
        np.isnan(apart), np.where(pieces.cut, _IN_PARTS_PX, 0.0), np.fmax(apart, _IN_PARTS_PX)
    )
    in_parts = np.where(pieces.brightest < _FAINT, np.maximum(_FAINT_PX, in_parts), in_parts)
    unshown = 0.0 if shown else _UNSHOWN_PX
    return np.sqrt(_LINE_PX**2 + in_parts**2 + (_BALL_OF_THUMB * pieces.doubt) ** 2 + unshown**2)


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
