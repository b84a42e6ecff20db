"""Finger labels of the parts of the laser line.

By where each part lies on the laser's plane, where the seams cannot be right.

A pixel of the plane is a known place before the palm. Fingers lean little to the side, so that it lies nearest to the
axis of its own (`LaserWorkspace.place`), even where seams lie in another minimum. A wrist that deviates by 5 degrees
moves all of them by half a finger, and a palm that holds something does not show it; but where four lines lie side by
side their middle is between the second and the third. The thumb crosses the plane near its MCP or beside the palm:
what lies as near to its root is its own, and what lies before the knuckles and farther away than that never is.
"""

import numpy as np

from common.arrays import Bool, Float, Int
from slave.wrist.finger_lines import NONE
from slave.wrist.runs import SETTINGS, Runs
from slave.wrist.workspace import LaserWorkspace

# Where `LaserWorkspace.place` is a finger's, thumb ... little: half a spacing, and the palm's error. Folded
# fingers point to the root of the thumb, the little one a quarter of a spacing towards it.
_FROM: Float = np.array([-np.inf, -np.inf, 1.35, 2.3, 3.1])
_TO: Float = np.array([np.inf, 1.65, 2.65, 3.65, np.inf])
_ALL = (3.2, 4.4)  # place: from the outside of the index to that of the little finger
_ASIDE = (0.3, 0.7)  # place: by less it is folded fingers; farther the palm has not turned unseen


def finger_labels(finger: Int, runs: Runs, points: Float, workspace: LaserWorkspace) -> Int:
    """Return the fingers (N,) of runs at pixels (N, 2).

    From the labels (N,) that the seams give, `NONE` where there is no line.
    """
    beyond, place = workspace.on_plane(points)
    on = finger != NONE
    near = on & workspace.only_thumb(beyond, place)
    thumb, index = 0, 1
    out = np.where(near, thumb, finger)
    place = place - _shift(place[out > thumb])
    out = _at_creases(out, runs)
    ends = out[1:] != out[:-1]
    ends[runs.first[1:] - 1] = True
    first = np.concatenate([[0], np.flatnonzero(ends) + 1])
    count = np.diff(np.append(first, len(out)))
    middle = np.add.reduceat(place, first) / count
    of = out[first]
    nearest = np.clip(np.rint(middle), 1, 4).astype(np.int64)
    no_thumb = (of == thumb) & workspace.no_thumb(np.add.reduceat(beyond, first) / count, middle)
    aside = (of > thumb) & ((middle < _FROM[of]) | (middle > _TO[of]))
    aside &= _room(of, nearest, aside | no_thumb)
    of = np.where(no_thumb | aside, nearest, of)
    if workspace.flexed:
        outside_index = 0.5  # place: there is the thumb of a bent wrist where the index is in its own
        beyond_index = (of == index) & (middle < outside_index)
        if ((of == index) & ~beyond_index).any():
            of = np.where(beyond_index, thumb, of)
    return np.repeat(of, count)


def _shift(place: Float) -> float:
    """Measure by how much all fingers lie beside their axes.

    Args:
        place: (N,) of their runs.

    Returns:
        As a place; 0 where they lie about there, or not all four are there.
    """
    if not len(place):
        return 0.0
    across = np.sort(place)
    steps, wide = np.diff(across), float(across[-1] - across[0])
    off = 0.5 * float(across[0] + across[-1]) - 2.5
    gap = 0.08  # place: a larger step is no line
    # share of that way that the lines of four fingers side by side fill, at least
    full = float(steps[steps < gap].sum()) > 0.72 * wide
    return off if full and _ALL[0] < wide < _ALL[1] and _ASIDE[0] < abs(off) < _ASIDE[1] else 0.0


def _room(of: Int, nearest: Int, moving: Bool) -> Bool:
    """Return which parts (N,) of fingers `of` may go to the `nearest` finger.

    Not all of a finger's line may go to a finger that has its own line.

    Then the finger is spread, or the palm is not quite where it should be.
    """
    unmoved = np.zeros(6, np.bool_)
    unmoved[of[~moving]] = True  # those of no finger come last
    return unmoved[of] | ~unmoved[nearest]


def _at_creases(finger: Int, runs: Runs) -> Int:
    """Move each change of finger along a line to the crease near by.

    Returns the fingers (N,) of runs.

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
        if stop - top < SETTINGS.short:
            top = stop
        elif top - begin < SETTINGS.short:
            top = begin
        out[begin:top], out[top:stop] = out[i], finger[i + 1]
    return out


def _climb(start: int, along: range, row: Float, same: Bool) -> int:
    """Return the last run of the same finger from one run on along a line.

    It covers some columns, and goes farther while the line rises.
    """
    last = start
    for count, k in enumerate(along, 1):
        crease_px = 20  # columns on either side of a seam in which the crease may be
        if not (same[k] and (count < crease_px or row[k] < row[last])):
            break
        last = k
    return last
