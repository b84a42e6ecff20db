"""Reader of motion capture in text tables.

It takes a plain table with named columns, or what optical systems export.

A plain table has one line of names and one line a frame. Columns are `NAME_x`, `NAME_y`, `NAME_z`, in any order, with a
unit behind them or not (`wrist_x_mm`), and a time: `t_ns`, `t_ms`, `t_s`, `time`, `seconds`, ... Our own tables
(`phalanx export --to csv`) are of that form. Empty or not a number is: not seen.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from common.errors import RecordingError
from master.mocap.joint_motion import PointTable, Unit
from master.mocap.optical_csv import read_optical
from master.mocap.text_rows import numbers, read_rows

_PLACE = re.compile(r"(?P<name>.+?)(?:[ _.:\-](?P<low>[xyzXYZ])|(?<=[a-z0-9])(?P<high>[XYZ]))(?P<unit>.*)")
_UNIT = re.compile(r"[ _]*[(\[]?(m|cm|mm)?[)\]]?")
_TIME = re.compile(r"(?:t|time|timestamp|seconds|sec)(?: *_?[(\[]? *(s|sec|seconds|ms|us|ns)[)\]]?)?")
_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def read_csv(path: Path, rate_hz: float | None) -> PointTable:
    """Read a table.

    Args:
        path: The file.
        rate_hz: Of its frames, where it has no times.

    Raises:
        RecordingError: It cannot be read, or is of no form that is known; with file and line.
    """
    rows = read_rows(path)
    return read_optical(rows, path, rate_hz) or _plain(rows, path, rate_hz)


@dataclass(frozen=True, slots=True)
class _Columns:
    """Columns of a plain table.

    Point -> its three columns, the column of time and its unit, the unit of length.
    """

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
    wanted = [at for three in columns.points.values() for at in three]
    times = [] if columns.time is None else [columns.time]
    values = numbers(body, start + 2, times + wanted, path)
    if times:
        t_s = values[:, 0] * columns.seconds
    elif rate_hz is not None:
        t_s = np.arange(len(values)) / rate_hz
    else:
        raise RecordingError(
            f"{path}: has no column of time (t_ns, t_ms, time, seconds): add one, or give its frames a second:"
            " --rate"
        )
    position = values[:, len(times) :].reshape(len(values), len(columns.points), 3)
    return PointTable(tuple(columns.points), t_s, position, columns.unit)


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
