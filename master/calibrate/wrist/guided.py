"""Segmentation of a subject's guided motion.

Flat hand, knuckles flexed with straight fingers, flat hand, fist.

How far the laser points lie shows how open the hand is, whatever else is still unknown: they are farthest on a flat
hand and come nearer with every joint that bends. So a motion falls into its openings and what lies between them, and
a few strobe cycles of each are all that a fit needs. Which bends are of the knuckles, and which are fists, is decided
later, by the tips.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import FitError

MOTION = (
    "open the hand flat; bend the straight fingers at their knuckles as far as they go, and back; open it flat;"
    " close it to a fist, and open it again; each bend in three seconds or more"
)
FLAT = -1
_FEWEST = 5  # strobe cycles of a bend


@dataclass(frozen=True, slots=True, eq=False)
class Guided:
    """Strobe cycles that count (T), in order.

    Attributes:
        row: (T,) their numbers.
        bend: (T,) number of the bend that each is of; FLAT: the hand is open.
    """

    row: Int
    bend: Int


def guided(along_m: Float) -> Guided:
    """Choose strobe cycles by how far the laser points lie [m].

    Laser points (T, 4) of index ... little; NaN: not seen.

    Raises:
        FitError: Fewer than three fingers bent, or the hand bent fewer than two times between openings.
    """
    open_share = openness(along_m)
    # shares of a finger's way: 4 degrees of a straight finger are a tenth of it
    flat = open_share > 0.85
    bends = _bends(open_share, flat)
    if len(bends) < 2 or not flat.any():
        raise FitError(
            f"the hand bent {len(bends)} times between being flat, at least twice is needed: {MOTION}"
        )
    chosen = [_flattest(np.flatnonzero(flat), open_share)]
    number = [np.full(len(chosen[0]), FLAT)]
    for k, rows in enumerate(bends):
        per_bend = 16
        rows = _evenly(rows, open_share, max(per_bend * 2 // len(bends), _FEWEST))
        chosen.append(rows)
        number.append(np.full(len(rows), k))
    return Guided(np.concatenate(chosen), np.concatenate(number))


def openness(along_m: Float) -> Float:
    """Return the openness (T,) of the hand as a share of the laser points' ways.

    The share that the points have gone from the nearest to the farthest.

    Raises:
        FitError: Fewer than three fingers are seen to bend.
    """
    low, high = np.full(4, np.nan), np.full(4, np.nan)
    for f in range(4):
        seen = along_m[np.isfinite(along_m[:, f]), f]
        if len(seen) >= 2 * _FEWEST:
            edge = 0.02  # share of outliers beyond the ends of a way
            low[f], high[f] = np.quantile(seen, [edge, 1.0 - edge])
    moved_m = 0.015  # of the laser point of a finger that bent
    moved = high - low > moved_m
    fingers = 3  # that must be seen
    if moved.sum() < fingers:
        raise FitError(
            f"{moved.sum()} fingers bend before the laser, at least {fingers} are needed: {MOTION}"
        )
    share = (along_m[:, moved] - low[moved]) / (high - low)[moved]
    share[np.isfinite(share).sum(axis=1) < fingers - 1] = np.nan
    out = np.full(len(share), np.nan)
    seen = np.isfinite(share).any(axis=1)
    out[seen] = np.nanmedian(share[seen], axis=1)
    return out


def _bends(open_share: Float, flat: Bool) -> list[Int]:
    """Return the strobe cycles of each flexion.

    What lies between openings and goes at least half of the way.
    """
    bends: list[Int] = []
    known = np.flatnonzero(np.isfinite(open_share))
    edges = np.flatnonzero(np.diff(np.r_[True, flat[known], True]))
    for first, stop in edges.reshape(-1, 2):
        rows = known[first:stop]
        bent = 0.5  # shares of a finger's way: 4 degrees of a straight finger are a tenth of it
        if len(rows) >= _FEWEST and open_share[rows].min() < bent:
            bends.append(rows)
    return bends


def _flattest(rows: Int, open_share: Float) -> Int:
    """Pick some of the more open half of the rows.

    A hand stays flat for longer than it passes by.
    """
    half = rows[np.argsort(open_share[rows])][len(rows) // 2 :]
    per_flat = 6
    return np.unique(half[np.linspace(0.0, len(half) - 1.0, per_flat).astype(np.int64)])


def _evenly(rows: Int, open_share: Float, count: int) -> Int:
    """At most `count` of the rows, spread evenly over how open the hand is."""
    known = rows[np.isfinite(open_share[rows])]
    share = open_share[known]
    wanted: Float = np.linspace(float(share.min()), float(share.max()), count)
    return known[np.unique(np.abs(share[:, None] - wanted).argmin(axis=0))]
