"""Times at which foreign frames were taken.

They come from a table of times, the video's own times, or a constant rate.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.errors import RecordingError
from common.messages.parts import MAX_TIME_NS
from common.recording.recorded_files import read_table

Times = Mapping[int, int]
"""Number of a frame, from 0 -> when it was taken [ns]."""


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """The frames that have a time.

    Attributes:
        number: (T,) their numbers.
        t_ns: (T,) [ns], rising.
        note: Where the times are from, for people.
    """

    number: Int
    t_ns: Int
    note: str


def read_times(path: Path, camera: str) -> Times:
    """The times of one camera in a table with a header.

    The columns are `frame`, `time` in seconds or `t_ns`, and `camera` where it is of several; others do not matter.

    Raises:
        RecordingError: It cannot be read, lacks a column, or a value is no number; the text names file and line.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_table(path.parent, path.name), newline=""))
        columns = reader.fieldnames or ()
        unit = next((name for name in ("t_ns", "time") if name in columns), None)
        if unit is None or "frame" not in columns:
            raise RecordingError(
                f"{path}: the header must have frame and time (seconds) or t_ns, and camera where it is of several"
                f" cameras; it has {', '.join(columns) or 'nothing'}"
            )
        scale = 1 if unit == "t_ns" else 1_000_000_000
        times: dict[int, int] = {}
        for row in reader:
            if row.get("camera", camera) == camera:
                frame = _integer(path, reader.line_num, "frame", row["frame"], 1)
                if frame in times:
                    raise RecordingError(
                        f"{path}: line {reader.line_num}: frame {frame} of {camera!r} is there twice"
                    )
                times[frame] = _integer(path, reader.line_num, unit, row[unit], scale)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    except csv.Error as error:
        raise RecordingError(f"{path}: not a table of text: {error}") from error
    if not times:
        raise RecordingError(f"{path}: no time of camera {camera!r}")
    return times


def by_table(path: Path, times: Times, number: Int) -> Timed:
    """The frames (T,) that a table has a time of.

    Raises:
        RecordingError: The table has none of them, counts from 1, or times that do not rise.
    """
    if 0 not in times and len(number) and max(times) == number[-1] + 1:
        raise RecordingError(
            f"{path}: frames are counted from 0; this one begins at {min(times)} and ends one late"
        )
    kept = np.array([n for n in number if int(n) in times], np.int64)
    if not len(kept):
        raise RecordingError(f"{path}: no time of any of the {len(number)} frames 0 to {number[-1]}")
    t_ns = np.array([times[int(n)] for n in kept], np.int64)
    if (late := np.flatnonzero(np.diff(t_ns) <= 0)).size:
        raise RecordingError(
            f"{path}: frame {kept[late[0] + 1]}: its time is not after that of the frame before"
        )
    without, absent = len(number) - len(kept), len(times) - len(kept)
    note = f"times of {path.name}"
    note += f", {without} frames without one left out" if without else ""
    note += f", {absent} times of frames that are not there" if absent else ""
    return Timed(kept, t_ns, note)


def by_rate(number: Int, rate_hz: float, whose: str) -> Timed:
    """Frames at a constant rate, the first of them at 0."""
    since: Float = (number - number[0]) * (1e9 / rate_hz)
    t_ns = np.round(since).astype(np.int64)
    return Timed(number, t_ns, f"{rate_hz:g} frames per second, {whose}")


def _integer(path: Path, line: int, column: str, text: str | None, scale: int) -> int:
    """A number times `scale`, rounded; exactly, as seconds since 1970 need."""
    try:
        value = Decimal((text or "").strip()) * scale
        if (
            value.is_finite()
            and abs(value) <= MAX_TIME_NS
            and (column != "frame" or value == int(value) >= 0)
        ):
            return round(value)
    except InvalidOperation:
        pass
    raise RecordingError(
        f"{path}: line {line}: {column}: {text!r} is no {'number from 0' if column == 'frame' else 'time'}"
    )
