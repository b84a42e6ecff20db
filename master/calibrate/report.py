"""Report a calibration: lines, figures, one picture, and the files it writes.

Every calibration ends by `finish`. A `Table` is made once, and read by a person as lines, by programs as JSON.
"""

from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import cast

import numpy as np

from common.arrays import Bool, Float, Int
from common.command_line import echo
from master.calibrate.tree_files import print_lines
from master.commands.summary import write_summary


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One quantity of a table.

    Attributes:
        title: Its heading; empty: not printed.
        values: (N,) numbers, NaN where unknown, or texts; what is only in JSON may be anything.
        form: How a number is printed, such as "8.2f"; empty: texts.
        unit: Printed behind a number.
        key: Its key in JSON, with the unit; what follows a dot is a key of an object in there. Empty: not in JSON.
        foot: Numbers below, in the rows of `Table.foot`, without the sign that `form` asks for.
    """

    title: str
    values: Float | Int | Bool | Sequence[object]
    form: str = ""
    unit: str = ""
    key: str = ""
    foot: Sequence[float] = ()

    def cells(self) -> list[str]:
        """Heading, rows and foot, equally wide."""
        below = [self._text(one, self.form.lstrip("+")) for one in self.foot]
        texts = [self.title, *(self._text(one, self.form) for one in self.values), *below]
        width, side = max(map(len, texts)), ">" if self.form else "<"
        return [f"{text:{side}{width}s}" for text in texts]

    def _text(self, value: object, form: str) -> str:
        number = _python(value)
        if not isinstance(number, int | float):
            return str(number)
        return "-" if np.isnan(number) else f"{number:{form}} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of equal length; `foot` names the rows below, such as "mean |error|"."""

    columns: Sequence[Column]
    foot: Sequence[str] = ()

    def lines(self) -> list[str]:
        """Heading, rows and foot for a person."""
        shown = [column for column in self.columns if column.title]
        rows = [list(row) for row in zip_longest(*(column.cells() for column in shown), fillvalue="")]
        free = next((i for i, column in enumerate(shown) if column.foot), 0)
        width = len("  ".join(rows[0][:free]))
        for title, row in zip(self.foot, rows[len(rows) - len(self.foot) :], strict=True):
            row[:free] = [f"{title:{width}s}"]
        return ["  " + "  ".join(row).rstrip() for row in rows]

    def json(self) -> list[dict[str, object]]:
        """One object for each row; null: unknown."""
        rows = [dict[str, object]() for _ in self.columns[0].values]
        for column in self.columns:
            parent, _, child = column.key.partition(".")
            for row, value in zip(rows, column.values, strict=True):
                if child:
                    within = row.setdefault(parent, dict[str, object]())
                    assert isinstance(within, dict)
                    within[child] = plain(value)
                elif parent:
                    row[parent] = plain(value)
        return rows


def plain(value: object) -> object:
    """A value as JSON has it: numbers of Python, null for NaN, lists for arrays."""
    value = _python(value)
    if isinstance(value, list):
        return [plain(one) for one in cast("list[object]", value)]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _python(value: object) -> object:
    return cast(object, np.asarray(value).tolist()) if hasattr(value, "tolist") else value


Write = Callable[[Path], Mapping[Path, str]]
"""Writes files into a tree, and returns for each what was written."""


def finish(
    options: Namespace,
    lines: Iterable[str],
    numbers: dict[str, object],
    draw: Callable[[Path], None] | None,
    write: Write | None = None,
) -> None:
    """End a calibration: print it, draw its picture, write its files and its figures.

    Args:
        options: `out`, `json_file` and `picture` of the command line, each may be None.
        lines: The report for a person.
        numbers: The same for programs; "written" is added, the paths of the files.
        draw: Draws the picture; None: there is none.
        write: Called with `out`; None: the command writes no files.

    Raises:
        CalibrationError, RecordingError: A file cannot be written.
    """
    print_lines(lines)
    if draw is not None and options.picture is not None:
        draw(options.picture)
        echo(f"drew {options.picture}")
    if write is not None:
        written: Mapping[Path, str] = {} if options.out is None else write(options.out)
        for path, what in written.items():
            echo(f"wrote {path}: {what}")
        if options.out is None:
            echo("nothing written: give --out DIR")
        numbers = numbers | {"written": [str(path) for path in written]}
    if options.json_file is not None:
        write_summary(options.json_file, numbers)
