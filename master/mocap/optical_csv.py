"""Reader of the tables that optical systems export.

OptiTrack Motive (.csv), Vicon Nexus (.csv) and Qualisys (.tsv).

    Motive    `Format Version`, its key and value pairs in the first line; rows Name, (Rotation, Position), X Y Z
    Vicon     `Trajectories`, the frames a second, a row of names over `Frame, Sub Frame, X, Y, Z`, a row of units
    Qualisys  rows of key and values (`FREQUENCY`, `MARKER_NAMES`) before the frames

Positions of rigid bodies, bones and markers are taken, turns are not. Qualisys writes 0 0 0 for a marker that is not
seen; the others leave it empty.
"""

from pathlib import Path

import numpy as np

from common.errors import RecordingError
from master.mocap.joint_motion import PointTable, Unit
from master.mocap.text_rows import numbers

_UNITS: dict[str, Unit] = {
    "meters": "m",
    "meter": "m",
    "m": "m",
    "centimeters": "cm",
    "cm": "cm",
    "millimeters": "mm",
    "mm": "mm",
}
_HEAD_ROWS = 40


def read_optical(rows: list[list[str]], path: Path, rate_hz: float | None) -> PointTable | None:
    """The points of an export; None where the table is none of an optical system.

    Args:
        rows: Cells.
        path: The file, for errors.
        rate_hz: Of the frames, where the table does not state it.

    Raises:
        RecordingError: It breaks off, or a cell is no number.
    """
    first = next((row[0] for row in rows if row and row[0]), "")
    if first == "Format Version":
        return _motive(rows, path)
    if first == "Trajectories":
        return _vicon(rows, path)
    if any(row and row[0] == "MARKER_NAMES" for row in rows[:_HEAD_ROWS]):
        return _qualisys(rows, path, rate_hz)
    return None


def _motive(rows: list[list[str]], path: Path) -> PointTable:
    pairs = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    head = next((k for k, row in enumerate(rows[:_HEAD_ROWS]) if row[:1] == ["Frame"]), None)
    names = next((row for row in rows[:_HEAD_ROWS] if "Name" in row[:2]), None)
    if head is None or names is None or head < 1:
        raise RecordingError(f"{path}: an export of Motive without its rows 'Name' and 'Frame'")
    kinds, axes = rows[head - 1], rows[head]
    points: dict[str, dict[str, int]] = {}
    for at in range(2, len(axes)):
        if at < len(names) and at < len(kinds) and kinds[at] == "Position" and axes[at] in ("X", "Y", "Z"):
            points.setdefault(names[at], {})[axes[at]] = at
    columns = {name: [own[axis] for axis in "XYZ"] for name, own in points.items() if len(own) == 3}
    unit = _UNITS.get(pairs.get("Length Units", "").lower())
    body = _until_empty(rows[head + 1 :])
    return _table(body, head + 2, path, columns, unit, time_column=1)


def _vicon(rows: list[list[str]], path: Path) -> PointTable:
    head = next((k for k, row in enumerate(rows[:_HEAD_ROWS]) if row[:1] == ["Frame"]), None)
    if head is None or head < 2 or head + 1 >= len(rows):
        raise RecordingError(f"{path}: an export of Vicon without its row 'Frame, Sub Frame, X, Y, Z'")
    rate = _rate(rows[1][0] if rows[1] else "", path)
    names = rows[head - 1]
    columns = {
        name: [at, at + 1, at + 2]
        for at, name in enumerate(names)
        if name and [axis[:1].upper() for axis in rows[head][at : at + 3]] == ["X", "Y", "Z"]
    }
    cells = rows[head + 1]
    unit = _UNITS.get(next((cell.lower() for cell in cells if cell), ""))
    body = _until_empty(rows[head + 2 :])
    table = _table(body, head + 3, path, columns, unit, time_column=0)
    return PointTable(table.names, table.t_s / rate, table.position, unit)


def _qualisys(rows: list[list[str]], path: Path, rate_hz: float | None) -> PointTable:
    keys = {row[0]: (k, row[1:]) for k, row in enumerate(rows[:_HEAD_ROWS]) if row and row[0].isupper()}
    names = [name for name in keys["MARKER_NAMES"][1] if name]
    rate = rate_hz if rate_hz is not None else _rate((keys.get("FREQUENCY", (0, [""]))[1] or [""])[0], path)
    last = max(k for k, _ in keys.values())
    start = next((k for k in range(last + 1, len(rows)) if rows[k] and _is_number(rows[k][0])), len(rows))
    body = _until_empty(rows[start:])
    ahead = max(len(row) for row in body) - 3 * len(names) if body else 0
    ahead = 2 if ahead >= 2 else 0  # frame and time, where they were exported
    columns = {name: [ahead + 3 * k + axis for axis in range(3)] for k, name in enumerate(names)}
    table = _table(body, start + 1, path, columns, "mm", time_column=None)
    unseen = (table.position == 0.0).all(axis=2, keepdims=True)
    t_s = np.arange(len(body)) / rate
    return PointTable(table.names, t_s, np.where(unseen, np.nan, table.position), "mm")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _rate(cell: str, path: Path) -> float:
    if not _is_number(cell) or not 0.0 < float(cell) < 1e6:
        raise RecordingError(f"{path}: the frames a second are {cell[:40]!r}: no rate; give --rate")
    return float(cell)


def _until_empty(rows: list[list[str]]) -> list[list[str]]:
    """The rows up to an empty one, behind which other tables of the file begin."""
    return rows[: next((k for k, row in enumerate(rows) if not any(row)), len(rows))]


def _table(
    body: list[list[str]],
    first_line: int,
    path: Path,
    columns: dict[str, list[int]],
    unit: Unit | None,
    time_column: int | None,
) -> PointTable:
    """Return the points by their columns.

    `t_s` is the column of time as it stands, or the row's number.
    """
    if not columns:
        raise RecordingError(f"{path}: has no positions of anything")
    times = [] if time_column is None else [time_column]
    values = numbers(body, first_line, times + [at for own in columns.values() for at in own], path)
    t_s = values[:, 0] if times else np.arange(len(body), dtype=np.float64)
    return PointTable(tuple(columns), t_s, values[:, len(times) :].reshape(len(body), len(columns), 3), unit)
