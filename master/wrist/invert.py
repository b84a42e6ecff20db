"""From laser points to closing and abduction: the table of `master.wrist.forward` turned round, all fingers at once.

Two unknowns, two numbers: the nearest node of the table, then Newton's steps in its cells, in which it is bilinear.
Past the end of the branch a point tells only that the finger is closed at least so far.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand_limits import ABDUCTION, FLEXION
from master.wrist.forward import DIP, PIP, ForwardTable

_STEPS = 4
_LONGEST = np.array([8.0, 2.0])  # rows and columns that one step may go
_OUTSIDE = np.array([30.0, 2.0])  # rows and columns beyond the table that are still told apart
_FINGER = np.arange(5)
_PAST_M = 2e-3  # nearer to the device than the end of its branch by more than this, a point is past it


@dataclass(frozen=True, slots=True, eq=False)
class Closed:
    """How far fingers are closed, by their laser points.

    Attributes:
        closing_rad: (5,) within the branch. NaN: not seen.
        abduction_rad: (5,).
        by_angles: (5, 2, 4) how the point (across, along) moves with each angle by itself [m/rad].
        length_px: (5,) of the line that such a finger shows, undistorted.
        past: (5,) the point is past the end of the branch: the finger is closed as far as `closing_rad` or more.
    """

    closing_rad: Float
    abduction_rad: Float
    by_angles: Float
    length_px: Float
    past: Bool


class Inverse:
    """The table turned round. What it holds was prepared by the constructor."""

    def __init__(self, table: ForwardTable) -> None:
        self.table = table
        rows, columns = table.closing_rad.shape[1], table.abduction_rad.shape[1]
        values = (table.point_m, table.by_mcp, table.by_dip, table.length_px[..., None])
        self._values = np.concatenate(values, axis=-1).reshape(5 * rows * columns, 7)
        nodes = table.point_m.copy()
        for f, a in np.ndindex(table.last.shape):
            nodes[f, table.last[f, a] + 1 :, a] = 1.0  # a metre off
        self._nodes = nodes.reshape(5, rows * columns, 2)
        self._shape = np.array([rows, columns])
        self._first = _FINGER * rows * columns
        self._corner = np.array([0, 1, columns, columns + 1])
        self._origin = np.stack([table.closing_rad[:, 0], table.abduction_rad[:, 0]], axis=1)
        ends = np.empty((5, columns, 3))
        ends[:, :, 0], ends[:, :, 1] = table.last, np.arange(columns)
        ends[:, :, 2] = table.point_m[_FINGER[:, None], table.last, np.arange(columns), 1]
        across = table.point_m[_FINGER[:, None], table.last, np.arange(columns), 0]
        order = np.argsort(across, axis=1)
        self._end_across, self._end_column = (
            np.take_along_axis(across, order, axis=1),
            order.astype(np.float64),
        )
        self._end_values, self._ends = ends, table.last.max(axis=1) < rows - 1
        self._step = np.stack([table.closing_rad[:, 1], table.abduction_rad[:, 1]], axis=1) - self._origin

    def __call__(self, point_m: Float) -> Closed:
        """Closing and abduction of points (5, 2) on the plane [m]; NaN: not seen."""
        seen = np.isfinite(point_m[:, 0])
        point = np.where(seen[:, None], point_m, self._nodes[:, 0])
        end = self._end(point[:, 0])
        beyond = end[:, 2] - point[:, 1]  # nearer to the device than the end of the branch
        past = seen & (beyond > _PAST_M) & self._ends
        at = self._search(point)
        at[past] = end[past, :2]
        at[:, 0] = np.clip(at[:, 0], 0.0, end[:, 0])
        return self._closed(point, at, seen, past)

    def _search(self, point: Float) -> Float:
        """Places (5, 2) in the table of points (5, 2)."""
        away = self._nodes - point[:, None]
        nearest = np.vecdot(away, away).argmin(axis=1)
        at = np.stack(np.divmod(nearest, self._shape[1]), axis=1).astype(np.float64)
        for _ in range(_STEPS):
            value, by_row, by_column = self._at(at)
            off = point - value[:, :2]
            det = _cross(by_row, by_column)
            det = np.where(np.abs(det) > 1e-12, det, 1e-12)
            step = np.stack([_cross(off, by_column), _cross(by_row, off)], axis=1) / det[:, None]
            at = np.clip(at + np.clip(step, -_LONGEST, _LONGEST), -_OUTSIDE, self._shape - 1.0 + _OUTSIDE)
        return at

    def _end(self, across_m: Float) -> Float:
        """Row, column and place along the plane (5, 3) at which the branches end, at these places across (5,)."""
        column = np.array(
            [np.interp(across_m[f], self._end_across[f], self._end_column[f]) for f in range(5)]
        )
        before = np.minimum(column.astype(np.int64), self._shape[1] - 2)
        here, there = self._end_values[_FINGER, before], self._end_values[_FINGER, before + 1]
        return here + (column - before)[:, None] * (there - here)

    def _closed(self, point: Float, at: Float, seen: Bool, past: Bool) -> Closed:
        """What places (5, 2) in the table say."""
        table = self.table
        # Where the closing was cut, the abduction is that which explains the place across.
        value, by_row, by_column = self._at(at)
        steep = np.where(np.abs(by_column[:, 0]) > 1e-6, by_column[:, 0], np.inf)
        column = at[:, 1] + np.where(past, 0.0, (point[:, 0] - value[:, 0]) / steep)
        at[:, 1] = np.clip(column, -_OUTSIDE[1], self._shape[1] - 1.0 + _OUTSIDE[1])
        slope = table.curve.slope
        by_angles = np.empty((5, 2, 4))
        by_angles[:, :, ABDUCTION] = by_column[:, :2] / self._step[:, 1:]
        by_angles[:, :, FLEXION], by_angles[:, :, DIP] = value[:, 2:4], value[:, 4:6]
        by_angles[:, :, PIP] = (
            by_row[:, :2] / self._step[:, :1]
            - slope[:, FLEXION, None] * value[:, 2:4]
            - slope[:, DIP, None] * value[:, 4:6]
        )
        angles = np.where(seen[:, None], self._origin + at * self._step, np.nan)
        return Closed(angles[:, 0], angles[:, 1], by_angles, value[:, 6], past)

    def _at(self, at: Float) -> tuple[Float, Float, Float]:
        """Values (5, 7) at places (5, 2) of rows and columns, and their derivatives by row and by column (5, 7)."""
        cell: Int = np.clip(at, 0.0, self._shape - 2.0).astype(np.int64)
        s, t = (at - cell).T[..., None]
        v00, v01, v10, v11 = np.moveaxis(
            self._values[(self._first + cell[:, 0] * self._shape[1] + cell[:, 1])[:, None] + self._corner],
            1,
            0,
        )
        near, far = v00 + t * (v01 - v00), v10 + t * (v11 - v10)
        return near + s * (far - near), far - near, v01 - v00 + s * (v11 - v10 - v01 + v00)


def _cross(a: Float, b: Float) -> Float:
    """Cross product of the first two columns, (5,)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
