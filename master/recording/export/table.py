"""Writer of tables of columns as CSV or Parquet, batch by batch.

This is the only file of the project that depends on pyarrow.

A Parquet column carries its unit, frame and meaning as metadata, the file what it is of. A CSV has names alone.
"""

from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, cast

import numpy as np
import pyarrow
from pyarrow import csv, parquet

from common.calibration.replacing import replacing
from master.recording.export.columns import Column

TableKind = Literal["csv", "parquet"]
_arrow, _csv, _parquet = (cast(Any, module) for module in (pyarrow, csv, parquet))  # they have no types


class _Writer(Protocol):
    def write_table(self, table: object) -> None: ...
    def close(self) -> None: ...


def write_table(
    path: Path,
    kind: TableKind,
    empty: Sequence[Column],
    batches: Iterable[Sequence[Column]],
    about: Mapping[str, str],
) -> int:
    """Write a table.

    Args:
        path: The file; replaced only by a complete one.
        kind: csv or parquet.
        empty: The columns, with no rows or any: what an empty table consists of.
        batches: The rows, each batch with the same columns.
        about: What the table is, for the metadata of a Parquet file.

    Returns:
        How many rows were written.

    Raises:
        OSError: It cannot be written; nothing half written is left.
    """
    rows = 0
    schema = _schema(empty, about)
    with replacing(path) as file, _writer(kind, file, schema) as writer:
        for batch in batches:
            arrays = [_arrow.array(one.values, from_pandas=True) for one in batch]
            writer.write_table(_arrow.Table.from_arrays(arrays, schema=schema))
            rows += len(batch[0].values)
    return rows


@contextmanager
def _writer(kind: TableKind, file: object, schema: object) -> Generator[_Writer]:
    """The library's writer into an open file."""
    writer: _Writer
    opens = {"csv": _csv.CSVWriter, "parquet": partial(_parquet.ParquetWriter, compression="zstd")}
    writer = opens[kind](file, schema)
    try:
        yield writer
    finally:
        writer.close()


def _schema(columns: Sequence[Column], about: Mapping[str, str]) -> object:
    """Names, types and meanings."""
    fields = [
        _arrow.field(
            one.name,
            _kind(one),
            metadata={
                key: value
                for key, value in (("unit", one.unit), ("frame", one.frame), ("description", one.text))
                if value
            },
        )
        for one in columns
    ]
    return _arrow.schema(fields, metadata=dict(about))


def _kind(column: Column) -> object:
    kinds = {"f": _arrow.float64(), "i": _arrow.int64(), "b": _arrow.bool_(), "U": _arrow.string()}
    return kinds[np.asarray(column.values).dtype.kind]
