"""The CSV reader takes tables of programs and of optical systems.

A plain table has one line of names and one line a frame. Columns are `NAME_x`, `NAME_y`, `NAME_z`, in any order, with
a unit behind them or not (`wrist_x_mm`), and a time: `t_ns`, `t_ms`, `t_s`, `time`, `seconds`, ... Our own tables
(`phalanx export --to csv`) are of that form. Empty or not a number is: not seen.

    Motive    `Format Version`, its key and value pairs in the first line; rows Name, (Rotation, Position), X
    Y Z
    Vicon     `Trajectories`, the frames a second, a row of names over `Frame, Sub Frame, X, Y, Z`, a row of
    units
    Qualisys  (.tsv) rows of key and values (`FREQUENCY`, `MARKER_NAMES`) before the frames

Positions of rigid bodies, bones and markers are taken, turns are not. Qualisys writes 0 0 0 for a marker that is not
seen; the others leave it empty.
"""

import csv
import math
import re
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import cast

import numpy as np

from common.arrays import Float
from common.errors import RecordingError
from master.mocap.bvh_file import PointTable, Unit


def read_rows(path: Path) -> list[list[str]]:
    """Return the cells of a table, separated by commas, semicolons or tabs.

    Raises:
        RecordingError: It cannot be read, is too large or no text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        head = text[:20_000]
        separator = max("\t;,", key=head.count)
        return [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), delimiter=separator)]
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path}: not a text table: {error}") from error


def numbers(rows: list[list[str]], first_line: int, columns: list[int], path: Path) -> Float:
    """Return columns of cells as numbers (T, C); empty and lacking cells are NaN.

    Raises:
        RecordingError: A cell is no number; with its line and column.
    """
    out = np.full((len(rows), len(columns)), np.nan)
    for k, row in enumerate(rows):
        cells = [row[at] if at < len(row) else "" for at in columns]
        try:
            out[k] = [float(cell) if cell else math.nan for cell in cells]
        except ValueError:
            out[k] = [
                _number(cell, path, first_line + k, at) for cell, at in zip(cells, columns, strict=True)
            ]
    return np.where(np.isfinite(out), out, np.nan)


def _number(cell: str, path: Path, line: int, column: int) -> float:
    if cell.lower() in ("", "nan", "null", "none", "na", "true", "false", "-"):
        return math.nan
    try:
        return float(cell)
    except ValueError as error:
        raise RecordingError(
            f"{path}: line {line}, column {column + 1}: {cell[:40]!r} is no number (decimals have a point)"
        ) from error


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
    """Return the points of an export; None: the table is none of an optical system.

    `rate_hz` is that of the frames, where the table does not state it.

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
    body = list(takewhile(any, rows[head + 1 :]))  # behind an empty row other tables begin
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
    body = list(takewhile(any, rows[head + 2 :]))
    table = _table(body, head + 3, path, columns, unit, time_column=0)
    return replace(table, t_s=table.t_s / rate)


def _qualisys(rows: list[list[str]], path: Path, rate_hz: float | None) -> PointTable:
    keys = {row[0]: (k, row[1:]) for k, row in enumerate(rows[:_HEAD_ROWS]) if row and row[0].isupper()}
    names = [name for name in keys["MARKER_NAMES"][1] if name]
    rate = rate_hz if rate_hz is not None else _rate((keys.get("FREQUENCY", (0, [""]))[1] or [""])[0], path)
    last = max(k for k, _ in keys.values())
    start = next((k for k in range(last + 1, len(rows)) if rows[k] and _is_number(rows[k][0])), len(rows))
    body = list(takewhile(any, rows[start:]))
    ahead = max(len(row) for row in body) - 3 * len(names) if body else 0
    ahead = 2 if ahead >= 2 else 0  # frame and time, where they were exported
    columns = {name: [ahead + 3 * k + axis for axis in range(3)] for k, name in enumerate(names)}
    table = _table(body, start + 1, path, columns, "mm", time_column=None)
    unseen = (table.position == 0.0).all(axis=2, keepdims=True)
    return replace(table, t_s=table.t_s / rate, position=np.where(unseen, np.nan, table.position))


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


def _table(
    body: list[list[str]],
    first_line: int,
    path: Path,
    columns: dict[str, list[int]],
    unit: Unit | None,
    time_column: int | None,
) -> PointTable:
    """Points by their columns; `t_s` is the column of time, or the row's number."""
    if not columns:
        raise RecordingError(f"{path}: has no positions of anything")
    times = [] if time_column is None else [time_column]
    values = numbers(body, first_line, times + [at for own in columns.values() for at in own], path)
    t_s = values[:, 0] if times else np.arange(len(body), dtype=np.float64)
    return PointTable(tuple(columns), t_s, values[:, len(times) :].reshape(len(body), len(columns), 3), unit)


_PLACE = re.compile(r"(?P<name>.+?)(?:[ _.:\-](?P<low>[xyzXYZ])|(?<=[a-z0-9])(?P<high>[XYZ]))(?P<unit>.*)")
_UNIT = re.compile(r"[ _]*[(\[]?(m|cm|mm)?[)\]]?")
_TIME = re.compile(r"(?:t|time|timestamp|seconds|sec)(?: *_?[(\[]? *(s|sec|seconds|ms|us|ns)[)\]]?)?")
_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def read_csv(path: Path, rate_hz: float | None) -> PointTable:
    """Read a table; `rate_hz` is that of its frames, where it has no times.

    Raises:
        RecordingError: It cannot be read, or is of no form that is known; with file and line.
    """
    rows = read_rows(path)
    return read_optical(rows, path, rate_hz) or _plain(rows, path, rate_hz)


@dataclass(frozen=True, slots=True)
class _Columns:
    """Point -> its three columns, column of time and its unit, unit of length."""

    points: dict[str, list[int]]
    time: int | None
    seconds: float
    unit: Unit | None


def _plain(rows: list[list[str]], path: Path, rate_hz: float | None) -> PointTable:
    start = next((k for k, row in enumerate(rows) if any(row)), None)
    if start is None:
        raise RecordingError(f"{path}: is empty")
    columns = _columns(rows[start], path)
    body = [row for row in rows[start + 1 :] if any(row)]
    if columns.time is None and rate_hz is None:
        raise RecordingError(
            f"{path}: has no column of time (t_ns, t_ms, time, seconds): add one, or give its frames a second:"
            " --rate"
        )
    table = _table(body, start + 2, path, columns.points, columns.unit, columns.time)
    t_s = table.t_s * columns.seconds if columns.time is not None else table.t_s / (rate_hz or 1.0)
    return replace(table, t_s=t_s)


def _columns(header: list[str], path: Path) -> _Columns:
    axes: dict[str, dict[str, int]] = {}
    units: set[str] = set()
    time: tuple[int, float] | None = None
    for at, title in enumerate(header):
        if (found := _TIME.fullmatch(title.strip().lower())) is not None:
            scale = _SECONDS[found[1] or "s"]
            if time is None or scale < time[1]:  # the finest
                time = (at, scale)
        elif (place := _PLACE.fullmatch(title)) and (unit := _UNIT.fullmatch(place["unit"].lower())):
            units |= {unit[1]} if unit[1] else set()
            axis = cast(str, place["low"] or place["high"]).lower()
            if axes.setdefault(place["name"], {}).setdefault(axis, at) != at:
                raise RecordingError(f"{path}: line 1: two columns of {place['name']} {axis}")
    points = {name: [own[axis] for axis in "xyz"] for name, own in axes.items() if len(own) == 3}
    if not points:
        raise RecordingError(
            f"{path}: line 1: no columns NAME_x, NAME_y, NAME_z, and no export of Motive, Vicon or Qualisys; it has:"
            f" {', '.join(header[:20])[:300]}"
        )
    if len(units) > 1:
        raise RecordingError(f"{path}: line 1: columns in {' and in '.join(sorted(units))}: use one unit")
    unit_of = cast(Unit | None, units.pop() if units else None)
    return _Columns(points, None if time is None else time[0], 1.0 if time is None else time[1], unit_of)
