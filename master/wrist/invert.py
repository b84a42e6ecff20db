"""From laser points to closing and abduction: the table of `master.wrist.forward` turned round.

Two unknowns, two numbers: for each point of a grid on the plane, the nearest node of the table, then Newton's steps in
its cells, in which it is bilinear. That is done once; a message is looked up in the grid, all fingers at once. Past
the end of the branch a point tells only that the finger is closed at least so far.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand_limits import ABDUCTION, FLEXION
from master.wrist.forward import DIP, PIP, ForwardTable

_STEPS = 6
_LONGEST = np.array([8.0, 2.0])  # rows and columns that one step may go
_OUTSIDE = np.array([30.0, 2.0])  # rows and columns beyond the table that are still told apart
_GRID_M = 1.5e-3
_AROUND_M = 0.02  # beyond all points of the branch
PAST_M = 2e-3  # nearer to the device than the end of its branch by more than this, a point is past it
_CORNERS = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])


@dataclass(frozen=True, slots=True, eq=False)
class Closed:
    """How far fingers are closed, by their laser points.

    Attributes:
        closing_rad: (5,) within the branch. NaN: not seen, or a finger that the laser cannot meet.
        abduction_rad: (5,).
        by_angles: (5, 2, 4) how the point (across, along) moves with each angle by itself [m/rad].
        length_px: (5,) of the line that such a finger shows, undistorted.
        end_rad: (5,) closing at which the branch ends there.
        past: (5,) the point is past the end of the branch: the finger is closed as far as `closing_rad` or more.
    """

    closing_rad: Float
    abduction_rad: Float
    by_angles: Float
    length_px: Float
    end_rad: Float
    past: Bool


class Inverse:
    """The table turned round. What it holds was prepared by the constructor."""

    def __init__(self, table: ForwardTable) -> None:
        self.table = table
        found = [_finger(table, f) for f in range(5)]
        self._low = np.array([low for low, _ in found])
        self._shape = np.array([grid.shape[:2] for _, grid in found])
        self._first = np.cumsum([0, *self._shape.prod(axis=1)[:-1]])
        self._values = np.concatenate([grid.reshape(-1, grid.shape[2]) for _, grid in found])
        self._offset: Int = _CORNERS[:, 0] * self._shape[:, 1:] + _CORNERS[:, 1]

    def __call__(self, point_m: Float) -> Closed:
        """Closing and abduction of points (5, 2) on the plane [m]; NaN: not seen."""
        seen = np.isfinite(point_m[:, 0])
        at = np.where(seen[:, None], (point_m - self._low) / _GRID_M, 0.0)
        at = np.clip(at, 0.0, self._shape - 1.0)
        cell: Int = np.minimum(at.astype(np.int64), self._shape - 2)
        s, t = (at - cell).T
        weight = np.stack([(1.0 - s) * (1.0 - t), (1.0 - s) * t, s * (1.0 - t), s * t], axis=1)
        nodes = (self._first + cell[:, 0] * self._shape[:, 1] + cell[:, 1])[:, None] + self._offset
        value = (weight[:, None] @ self._values[nodes])[:, 0]
        value[~seen, :2] = np.nan
        past = value[:, 3] > PAST_M
        past &= np.isfinite(value[:, 0])
        by_angles = value[:, 5:].reshape(5, 2, 4)
        return Closed(value[:, 0], value[:, 1], by_angles, value[:, 2], value[:, 4], past)


def _finger(table: ForwardTable, f: int) -> tuple[Float, Float]:
    """What points of a grid on the plane say of finger `f`.

    Returns:
        Its lowest point (2,) [m], and for its points (X, Y, 13): closing, abduction, length of line, how far past the
        end of the branch [m], closing at that end, and how the point moves with the angles (2, 4). Of a finger that
        the laser never meets closing and abduction are NaN.
    """
    if not table.met[f]:
        grid = np.zeros((2, 2, 13))
        grid[..., :2] = np.nan
        return np.zeros(2), grid
    last = table.last[f]
    rows, columns = table.point_m.shape[1:3]
    places = np.array([(row, column) for column in range(columns) for row in range(last[column] + 1)])
    nodes = table.point_m[f][places[:, 0], places[:, 1]]
    low, high = nodes.min(axis=0) - _AROUND_M, nodes.max(axis=0) + _AROUND_M
    count = np.ceil((high - low) / _GRID_M).astype(np.int64) + 1
    points = np.moveaxis(np.indices((int(count[0]), int(count[1]))), 0, -1).reshape(-1, 2) * _GRID_M + low
    at = _search(table, f, points, nodes, places)
    end = _end(table, f, points[:, 0])
    past = end[:, 2] - points[:, 1] if int(last.max()) < rows - 1 else np.full(len(points), -1.0)
    closed = past > 0.0
    at[closed] = end[closed, :2]
    at[:, 0] = np.clip(at[:, 0], 0.0, end[:, 0])
    # Where the closing was cut, the abduction is that which explains the place across.
    value, by_row, by_column = _cell(table, f, at)
    steep = np.where(np.abs(by_column[:, 0]) > 1e-6, by_column[:, 0], np.inf)
    at[:, 1] += np.where(closed, 0.0, (points[:, 0] - value[:, 0]) / steep)
    at[:, 1] = np.clip(at[:, 1], -_OUTSIDE[1], columns - 1.0 + _OUTSIDE[1])
    step = np.array([np.diff(table.closing_rad[f, :2])[0], np.diff(table.abduction_rad[f, :2])[0]])
    first = np.array([table.closing_rad[f, 0], table.abduction_rad[f, 0]])
    out = np.empty((len(points), 13))
    out[:, :2] = first + at * step
    out[:, 2], out[:, 3], out[:, 4] = value[:, 6], past, first[0] + end[:, 0] * step[0]
    slope, by_angles = table.curve.slope[f], out[:, 5:].reshape(-1, 2, 4)
    by_angles[..., ABDUCTION] = by_column[:, :2] / step[1]
    by_angles[..., FLEXION], by_angles[..., DIP] = value[:, 2:4], value[:, 4:6]
    by_angles[..., PIP] = (
        by_row[:, :2] / step[0] - slope[FLEXION] * value[:, 2:4] - slope[DIP] * value[:, 4:6]
    )
    return low, out.reshape(int(count[0]), int(count[1]), 13)


def _search(table: ForwardTable, f: int, points: Float, nodes: Float, places: Int) -> Float:
    """Places (N, 2) in the table of points (N, 2), from the nearest of the nodes (M, 2) at places (M, 2)."""
    nearest = (nodes @ points.T - 0.5 * np.vecdot(nodes, nodes)[:, None]).argmax(axis=0)
    at = places[nearest].astype(np.float64)
    highest = np.array(table.point_m.shape[1:3]) - 1.0 + _OUTSIDE
    for _ in range(_STEPS):
        value, by_row, by_column = _cell(table, f, at)
        off = points - value[:, :2]
        det = _cross(by_row, by_column)
        det = np.where(np.abs(det) > 1e-12, det, 1e-12)
        step = np.stack([_cross(off, by_column), _cross(by_row, off)], axis=1) / det[:, None]
        at = np.clip(at + np.clip(step, -_LONGEST, _LONGEST), -_OUTSIDE, highest)
    return at


def _end(table: ForwardTable, f: int, across_m: Float) -> Float:
    """Row, column and place along the plane (N, 3) at which the branch ends, at places across (N,)."""
    rows = table.last[f]
    columns = np.linspace(0.0, len(rows) - 1.0, len(rows))
    across, along = table.point_m[f, rows, columns.astype(np.int64)].T
    order = np.argsort(across)
    out = np.empty((len(across_m), 3))
    out[:, 0] = np.interp(across_m, across[order], rows[order].astype(np.float64))
    out[:, 1] = np.interp(across_m, across[order], columns[order])
    out[:, 2] = np.interp(across_m, across[order], along[order])
    return out


def _cell(table: ForwardTable, f: int, at: Float) -> tuple[Float, Float, Float]:
    """Values (N, 7) at places (N, 2) of rows and columns, and their derivatives by row and by column (N, 7)."""
    parts = (table.point_m[f], table.by_mcp[f], table.by_dip[f], table.length_px[f, ..., None])
    values = np.concatenate(parts, axis=-1)
    cell: Int = np.clip(at, 0.0, np.array(values.shape[:2]) - 2.0).astype(np.int64)
    i, j = cell.T
    s, t = (at - cell).T[..., None]
    v00, v01, v10, v11 = values[i, j], values[i, j + 1], values[i + 1, j], values[i + 1, j + 1]
    near, far = v00 + t * (v01 - v00), v10 + t * (v11 - v10)
    return near + s * (far - near), far - near, v01 - v00 + s * (v11 - v10 - v01 + v00)


def _cross(a: Float, b: Float) -> Float:
    """Cross product of the first two columns, (N,)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
