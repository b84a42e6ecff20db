"""Tables that a person writes: a sweep as CSV, and the distances of a sweep."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.calibration.replacing import replacing
from common.errors import CalibrationError
from master.calibrate.depth.sweep import FARTHEST_M, Sweep

_MORE = "\0"  # key of what a row has beyond its columns; no name of a column


def read_table(path: Path) -> Sweep:
    """Read a sweep from a CSV.

    Columns: distance_m and disparity_px, or distance_m, u_left_px and u_right_px.

    With v_left_px and v_right_px beside the u, the full stereo model can be verified on it too; area_left_px2 and
    area_right_px2 let a target be found out that is not wholly in the picture.

    Raises:
        CalibrationError: The file cannot be read, or lacks a column; the text names file, line and column.
    """
    columns, rows = rows_of(path)
    if "distance_m" not in columns:
        raise CalibrationError(
            f"{path}: column distance_m is missing; it has {', '.join(columns)} (separated by commas?)"
        )
    place = [f"line {number}" for number, _ in rows]
    distance = column(path, rows, "distance_m")
    u = [f"u_{side}_px" for side in ("left", "right")]
    if "disparity_px" in columns:
        return Sweep.of_disparity(distance, column(path, rows, "disparity_px"), place)
    if not set(u) <= set(columns):
        raise CalibrationError(
            f"{path}: columns disparity_px, or u_left_px and u_right_px, are missing; it has {', '.join(columns)}"
        )

    def of(kind: str) -> Float:
        names = [kind.format(side) for side in ("left", "right")]
        nan = np.full(len(rows), np.nan)
        return np.stack([column(path, rows, name) if name in columns else nan for name in names])

    uv = np.stack([of("u_{}_px"), of("v_{}_px")], axis=-1)
    nan = np.full(len(rows), np.nan)
    disparity = uv[0, :, 0] - uv[1, :, 0]
    return Sweep(distance, disparity, uv, of("area_{}_px2"), nan, np.ones(len(rows), np.int64), tuple(place))


def write_table(path: Path, sweep: Sweep) -> None:
    """Write a sweep as a CSV that `read_table` reads.

    Raises:
        CalibrationError: The file cannot be written; the old one is untouched.
    """
    lines = ["distance_m,u_left_px,v_left_px,u_right_px,v_right_px,area_left_px2,area_right_px2"]
    for i in range(sweep.size):
        (ul, vl), (ur, vr) = sweep.uv[:, i]
        al, ar = sweep.area_px2[:, i]
        lines.append(f"{sweep.distance_m[i]:.5f},{ul:.4f},{vl:.4f},{ur:.4f},{vr:.4f},{al:.1f},{ar:.1f}")
    try:
        with replacing(path) as file:
            file.write("\n".join([*lines, ""]).encode())
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write: {error.strerror}") from error


def parse_distances(text: str) -> Float:
    """Parse distances [m] from a range or a list.

    Range such as `1.00:0.20:-0.05` (first, last, step), or list such as `1.0,0.8,0.6`.

    Raises:
        CalibrationError: Neither of the two, a step that does not lead from the first to the last, or no metres.
    """
    distances = parse_numbers(
        text, "--distances", "FIRST:LAST:STEP in metres, such as 1.00:0.20:-0.05, or a list 1.0,0.8,0.6"
    )
    if not ((distances > 0.0) & (distances < FARTHEST_M)).all():
        raise CalibrationError(
            f"--distances {text!r}: distances must be metres, above 0 and below {FARTHEST_M:g}: not centimetres"
        )
    return distances


def parse_numbers(text: str, option: str, wanted: str) -> Float:
    """Numbers of FIRST:LAST:STEP, or of a list with commas.

    Args:
        text: What the user wrote.
        option: Where, for the message.
        wanted: What was expected, for the message.

    Raises:
        CalibrationError: Neither of the two, or a step that does not lead from the first to the last.
    """
    try:
        numbers = [float(part) for part in text.split(":" if ":" in text else ",")]
    except ValueError:
        numbers = []
    ranged = ":" in text
    if (
        not numbers
        or not all(map(math.isfinite, numbers))
        or (ranged and (len(numbers) != 3 or not numbers[2]))
    ):
        raise CalibrationError(f"{option} {text!r}: expected {wanted}")
    if not ranged:
        return np.array(numbers)
    first, last, step = numbers
    count = (last - first) / step
    if count < 0.0 or abs(count - round(count)) > 1e-6 * max(count, 1.0) or count > 10_000:
        raise CalibrationError(f"{option} {text!r}: steps of {step:g} do not lead from {first:g} to {last:g}")
    return np.array([first + step * i for i in range(round(count) + 1)])


def rows_of(path: Path) -> tuple[tuple[str, ...], list[tuple[int, dict[str, str]]]]:
    """Column names, and (line number, row) of a CSV with a header."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restkey=_MORE, restval="", skipinitialspace=True)
            columns = tuple(name.strip() for name in reader.fieldnames or ())
            reader.fieldnames = list(columns)
            rows = [(reader.line_num, row) for row in reader]
    except OSError as error:
        raise CalibrationError(f"{path}: cannot read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: not a table of text: {error}") from error
    if not rows:
        raise CalibrationError(
            f"{path}: no rows; the first line must name the columns, such as distance_m,disparity_px"
        )
    if doubled := {name for name in columns if columns.count(name) > 1}:
        raise CalibrationError(f"{path}: column {', '.join(sorted(doubled))} stands there twice")
    for number, row in rows:
        if any(row.get(_MORE, ())):
            raise CalibrationError(
                f"{path}: line {number}: more cells than columns; commas separate cells, numbers have a decimal point"
            )
    return columns, rows


def column(path: Path, rows: Sequence[tuple[int, dict[str, str]]], name: str) -> Float:
    """One column as finite numbers."""
    out = np.empty(len(rows))
    for i, (number, row) in enumerate(rows):
        text = row[name]
        try:
            out[i] = float(text)
        except ValueError as error:
            raise CalibrationError(f"{path}: line {number}: {name}: {text!r} is not a number") from error
        if not math.isfinite(out[i]):
            raise CalibrationError(
                f"{path}: line {number}: {name} is {text}: the target was not seen there? measure again or leave the"
                " line out"
            )
    return out
