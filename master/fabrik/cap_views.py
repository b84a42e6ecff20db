"""Kernels over the tables of `master.stereo.caps`: what a camera sees of a cap."""

from math import acos, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Float, Int
from common.kernels import kernel
from master.stereo.caps import ALIKE, FLAT_SHARE, LEAST_SHARE, REACH, CapModel


class CapTables(NamedTuple):
    """How the painted caps of M markers look from all sides.

    Attributes:
        row: (M,) row of `looks`; -1: flat, its centroid is what is seen.
        looks: (K, A + 1, 3) over the angle between finger and sight, 0 to pi: shift of the seen centroid along the
            finger and towards the eye [m], and the area seen [m^2].
        radius_m: (K,).
    """

    row: Int
    looks: Float
    radius_m: Float

    @classmethod
    def of(cls, caps: CapModel) -> "CapTables":
        """The tables of a rig's caps."""
        row = np.full(len(caps.on_finger), -1, np.int64)
        row[caps.on_finger] = np.arange(int(caps.on_finger.sum()))
        return cls(row, caps.looks, caps.radius_m)


@kernel
def seen_shift(caps: CapTables, row: int, ahead: Float, back: Float, out: Float) -> float:
    """Write a cap's seen centroid less its own (3,) [m]; return the area seen [m^2].

    Args:
        caps, row: The cap.
        ahead, back: Unit vectors (3,) along the finger and to the eye; NaN: so is what is seen.
        out: Written.
    """
    cosine = ahead[0] * back[0] + ahead[1] * back[1] + ahead[2] * back[2]
    if not np.isfinite(cosine):  # no row of the table
        out[:] = np.nan
        return np.nan
    cosine = min(max(cosine, -1.0), 1.0)
    last = caps.looks.shape[1] - 1
    place = acos(cosine) * (last / np.pi)
    low = min(max(int(place), 0), last - 1) if place >= 0.0 else 0  # NaN is not
    part = place - low
    along = (1.0 - part) * caps.looks[row, low, 0] + part * caps.looks[row, low + 1, 0]
    towards = (1.0 - part) * caps.looks[row, low, 1] + part * caps.looks[row, low + 1, 1]
    towards /= max(sqrt(1.0 - cosine * cosine), 1e-9)
    for i in range(3):
        out[i] = along * ahead[i] + towards * (back[i] - cosine * ahead[i])
    return (1.0 - part) * caps.looks[row, low, 2] + part * caps.looks[row, low + 1, 2]


@kernel
def hidden_part(area_px2: Float, scale_m: Float, whole_m2: Float, radius_m: float, out: Float) -> None:
    """Write the variance (2,) [px^2] of centroids of a partly hidden marker.

    It is one that shows less than it must (`CapModel.doubt_px`).

    Args:
        area_px2: (2,) seen areas; NaN: not measured.
        scale_m: (2,) [m/px] at the marker.
        whole_m2: (2,) area that the whole cap shows, square to the sight; not used of a flat marker.
        radius_m: Of the cap; 0: it is flat.
        out: Written.
    """
    first, second = area_px2[0] * scale_m[0] ** 2, area_px2[1] * scale_m[1] ** 2
    out[0] = out[1] = 0.0
    if not np.isfinite(first + second):
        return
    if radius_m == 0.0:
        best = max(first, second)
        for c in range(2):
            share = (first if c == 0 else second) / best
            if share < FLAT_SHARE:
                out[c] = best * ((1.0 - share) * 0.5 / scale_m[c]) ** 2
        return
    first, second = first / max(whole_m2[0], 1e-9), second / max(whole_m2[1], 1e-9)
    most = max(first, second)
    for c in range(2):
        shows = first if c == 0 else second
        out[c] = max(1.0 - shows / LEAST_SHARE, 0.0)
        if shows < ALIKE * most:
            out[c] = max(out[c], 1.0 - shows / most)
    reach = REACH * max(out[0], out[1])
    for c in range(2):
        out[c] = (max(out[c], reach) * radius_m / scale_m[c]) ** 2
