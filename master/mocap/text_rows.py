"""Cells of text tables, and numbers of cells."""

import csv
import math
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.errors import RecordingError
from master.mocap.joint_motion import MAX_BYTES


def read_rows(path: Path) -> list[list[str]]:
    """The cells of a table, separated by commas, semicolons or tabs.

    Raises:
        RecordingError: It cannot be read, is too large or no text.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise RecordingError(f"{path}: larger than 1 GiB: cut it")
        text = path.read_text(encoding="utf-8-sig")
        head = text[:20_000]
        separator = max("\t;,", key=head.count)
        return [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), delimiter=separator)]
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path}: not a text table: {error}") from error


def numbers(rows: list[list[str]], first_line: int, columns: list[int], path: Path) -> Float:
    """Return the cells of some columns as numbers (T, C).

    Empty cells and those that a row does not have are NaN.

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
