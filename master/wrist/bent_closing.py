"""How far fingers are closed by their laser points while the wrist is bent: as `master.wrist.invert`, without a table.

A finger that bends naturally is followed from straight to closed in closed form (`master.wrist.ridge`); its branch
begins where it first meets the plane and ends where its point no longer comes nearer or jumps to another phalanx. At
each place of it the abduction is that which explains the point across, and where that explains it along, too, is the
answer, refined by Newton's steps about the laser's cut.
"""

import numpy as np

from common.arrays import Float, Int
from common.hand_limits import ABDUCTION
from master.wrist.bent import BentView
from master.wrist.forward import ForwardTable, NaturalCurve
from master.wrist.invert import PAST_M, Closed
from master.wrist.ridge import Crossings

_STEPS = 3
_FARTHEST_RAD = np.radians(10.0)  # of one step
_BACK_M = 1e-3  # a point that goes away from the device by more ends the branch
_JUMPS = 2  # stretches of the chain
_OUTSIDE_RAD = np.radians(10.0)  # beyond the abductions of the table, still told apart
_LEAST_M = 1e-4  # of a step's denominator: points that move by less with an angle do not tell it


def closings(view: BentView, table: ForwardTable, point_m: Float) -> Closed:
    """Closing and abduction of fingers whose points on the plane are (5, 2) [m]; NaN: not seen."""
    curve, fingers = table.curve, np.arange(5)
    most = table.abduction_rad[:, -1] + _OUTSIDE_RAD
    grid, path = view.path()  # (5, C)
    count: int = grid.shape[1]
    first, last = _branch(path, count)
    y, by = path.seen[:, :2].reshape(5, -1, 2), path.by_angles[:, :2, ABDUCTION].reshape(5, -1, 2)
    steep = np.where(np.abs(by[..., 0]) > _LEAST_M, by[..., 0], np.inf)
    aside = np.clip((point_m[:, None, 0] - y[..., 0]) / steep, -most[:, None], most[:, None])
    short = y[..., 1] + aside * by[..., 1] - point_m[:, None, 1]  # falls while the finger closes
    row: Int = np.arange(count)
    reached = (row >= first[:, None]) & (row <= last[:, None]) & (short <= 0.0)
    at = np.where(reached.any(axis=1), reached.argmax(axis=1), last)
    before = np.minimum(np.maximum(at - 1, first), count - 1)
    near, far = short[fingers, before], short[fingers, at]
    share = np.clip(near / np.where(near > far, near - far, 1.0), 0.0, 1.0)
    seen = np.isfinite(point_m[:, 0]) & (last >= first)
    past = seen & (last < count - 1) & ~reached.any(axis=1) & (short[fingers, last] > PAST_M)
    ends = grid[fingers, np.minimum(first, last)], grid[fingers, last]
    closing, abduction = (
        (1.0 - share) * of[fingers, before] + share * of[fingers, at] for of in (grid, aside)
    )
    abduction = np.where(seen, abduction, 0.0)
    found, lacks, length = view.lacking(_angles(curve, closing, abduction, fingers), fingers)
    aim = np.where(seen[:, None], point_m, 0.0) - np.nan_to_num(lacks)
    for _ in range(_STEPS):
        by_closing = (found.by_angles[:, :2] * curve.slope[:, None]).sum(axis=-1)
        to = _solved(by_closing, found.by_angles[:, :2, ABDUCTION], aim - found.seen[:, :2])
        closing = np.clip(closing + to[:, 0], *ends)
        abduction = np.clip(abduction + to[:, 1], -most, most)
        found = _found(view, curve, closing, abduction, fingers)
    closing, abduction = (np.where(seen, of, np.nan) for of in (np.where(past, ends[1], closing), abduction))
    return Closed(closing, abduction, found.by_angles[:, :2], np.nan_to_num(length), ends[1], past)


def _found(view: BentView, curve: NaturalCurve, closing: Float, abduction: Float, finger: Int) -> Crossings:
    """What is seen of closings and abductions (N,) of fingers (N,)."""
    return view.crossings(_angles(curve, closing, abduction, finger), finger)


def _angles(curve: NaturalCurve, closing: Float, abduction: Float, finger: Int) -> Float:
    """Angles (N, 4) of closings and abductions (N,) of fingers (N,)."""
    angles = curve.base_rad[finger] + closing[:, None] * curve.slope[finger]
    angles[:, ABDUCTION] = abduction
    return angles


def _branch(path: Crossings, count: int) -> tuple[Int, Int]:
    """First and last rows (5,) of branches along so many closings of each finger; there is none: the first is behind.

    A thumb's has no end: it never reaches its own tip.
    """
    along, met = path.seen[:, 1].reshape(5, -1), path.met.reshape(5, -1)
    stretch = path.stretch.reshape(5, -1)
    rows = np.arange(count)
    first = np.where(met.any(axis=1), met.argmax(axis=1), count)
    ends = ~met
    back = (np.diff(along, axis=1) > _BACK_M) | (np.diff(stretch, axis=1) > _JUMPS)
    back[0] = False
    ends[:, 1:] |= back & met[:, :-1]
    ends &= rows > first[:, None]
    return first, np.where(ends.any(axis=1), ends.argmax(axis=1) - 1, count - 1)


def _solved(a: Float, b: Float, off: Float) -> Float:
    """Steps (N, 2) that move points by `off` (N, 2), along what their two unknowns do (N, 2) each."""
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    det = np.where(np.abs(det) > _LEAST_M**2, det, np.inf)
    to = np.stack(
        [off[:, 0] * b[:, 1] - off[:, 1] * b[:, 0], a[:, 0] * off[:, 1] - a[:, 1] * off[:, 0]], axis=1
    )
    return np.clip(to / det[:, None], -_FARTHEST_RAD, _FARTHEST_RAD)
