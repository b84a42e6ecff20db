"""Measure length and centroid of each finger's laser line.

A line is made of the pieces between runs of adjacent columns (laser segments of Kim et al. 2012).

A finger's centroid weighs its line by length in the image, not by columns: at the sides of a finger the line falls
steeply, the last of it in less than a column.
"""

from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from slave.wrist.runs import Runs

NONE = -1  # no finger
STEEPEST = 8.0  # px of row per root of a column: how fast a line goes round the side of a finger
LONG = 5  # columns from one end of a line to the other, from which on its ends are drawn straight


class FingerLines(NamedTuple):
    """The line of each finger, thumb ... little.

    Attributes:
        line: (5,) its length [px].
        uv: (5, 2) its centroid [px]; NaN: none.
        apart: (5,) half of how far the middle of a line in parts lies from that of its longest part [px]; NaN: whole.
        cut: (5,) whether the image ends on it.
        brightest: (5,) its highest level.
    """

    line: Float
    uv: Float
    apart: Float
    cut: Bool
    brightest: Float


def measure(runs: Runs, finger: Int, width_px: int) -> FingerLines:
    """Of the pieces of line of each finger.

    Args:
        runs: The runs.
        finger: (N,) whose each of them is; `NONE`: nobody's.
        width_px: Of the image.
    """
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
    return FingerLines(line, uv, _apart(points, finger, left, right), cut, brightest[:5])


def _of_fingers(of: Int, weight: Float) -> Float:
    """Return the sums (5,) of weights (M,) by finger.

    `of` (M,) counts the finger from 1; 0: no finger.
    """
    return np.asarray(np.bincount(of, weight, 6)[1:], np.float64)


def _apart(points: Float, finger: Int, left: Int, right: Int) -> Float:
    """Return the centroid spread (5,) [px] of fingers whose line is in parts.

    It is half of the distance of the middle of the line in parts from that of its longest part alone.

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
        whole = (columns[:, None] * middles).sum(axis=0) / columns.sum()
        out[of] = 0.5 * float(np.hypot(*(whole - middles[int(columns.argmax())])))
    return out


def _ends(points: Float, left: Int, right: Int) -> tuple[Float, Int]:
    """Return where lines end (2 P, 2), and the runs from which they are straight.

    The ends lie beyond the first and last runs (P,) of the lines; they go on straight from runs (2 P,). Left ends
    first.

    A line goes round a finger until it is seen no more: near its end it falls away as the root of the distance to the
    end does, most of it in less than a column, and dark. So a long one is continued from a few columns within.
    """
    long = np.where(right - left >= LONG, 1, 0)
    inner = np.concatenate([left + 2 * long, right - 2 * long])
    deep = np.concatenate([left + 5 * long, right - 5 * long])
    outer = points[np.concatenate([left, right])]
    outer[: len(left), 0] -= 0.5
    outer[len(left) :, 0] += 0.5
    steepness = np.clip((points[deep, 1] - points[inner, 1]) / (np.sqrt(5.5) - np.sqrt(2.5)), 0.0, STEEPEST)
    outer[:, 1] = points[inner, 1] - steepness * np.sqrt(2.5)
    return outer, inner
