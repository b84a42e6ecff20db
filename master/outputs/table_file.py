"""Table of fixed row type that becomes an .npz when the run ends.

In constant memory; the file is complete or not written at all.

Rows are spooled to a nameless file beside the target, so a run may have any length and a full disk shows while
tracking, not at the end. `close` turns the spool into the .npz: uncompressed, with fixed time stamps, hence
byte-identical for identical rows.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from common.errors import RecordingError
from common.messages import Message
from common.recording.npz import write_npz

Row = np.dtype[np.void]


class TableFile:
    """The file of one table; holds the spool of rows written so far."""

    def __init__(self, path: Path, dtype: Row, labels: Mapping[str, str]) -> None:
        """Open the spool in the folder of `path`.

        Args:
            path: The .npz to write.
            dtype: Of a row: each field is an attribute of the messages, and becomes an array of the file.
            labels: Texts that stand in the file beside the arrays.

        Raises:
            RecordingError: The folder is missing or read-only.
        """
        self._path, self._dtype, self._labels = path, dtype, dict(labels)
        self._rows = 0
        self._closed = False
        try:
            # Its name is gone at once: a killed process leaves nothing behind.
            self._spool: IO[bytes] = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115
        except OSError as error:
            raise cannot_write(path, error) from error

    def write(self, message: Message) -> None:
        """Append the row of one message.

        Raises:
            RecordingError: Disk full; the run's file is given up, see `close`.
            ValueError: It is closed.
        """
        if self._closed:
            raise ValueError(f"{self._path}: already closed")
        row = np.empty((), self._dtype)
        for name in self._dtype.names or ():
            row[name] = getattr(message, name)
        try:
            self._spool.write(row.tobytes())
        except OSError as error:
            self._give_up()
            raise cannot_write(self._path, error) from error
        self._rows += 1

    def close(self) -> None:
        """Write the .npz.

        An older file of that name is replaced only by a complete one. Safe to call twice.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        if self._closed:
            return
        try:
            self._spool.flush()
            table = self._table()
            columns: dict[str, npt.NDArray[Any]] = {name: table[name] for name in self._dtype.names or ()}
            write_npz(self._path, columns | {name: np.array(text) for name, text in self._labels.items()})
        except OSError as error:
            raise cannot_write(self._path, error) from error
        finally:
            self._give_up()

    def _table(self) -> npt.NDArray[np.void]:
        if self._rows == 0:  # an empty file cannot be mapped
            return np.empty(0, self._dtype)
        return np.memmap(self._spool, self._dtype, "r", shape=(self._rows,))

    def _give_up(self) -> None:
        self._closed = True
        try:
            self._spool.close()
        except OSError:
            # Closing flushes what a full disk refused before; that error was already raised.
            return


def cannot_write(path: Path, error: OSError) -> RecordingError:
    """Return the error for a file of a run that cannot be written."""
    fix = "free the disk or choose another folder"
    return RecordingError(f"{path}: cannot write: {error.strerror or error}; {fix}")
