"""Writes and reads poses.npz, the record of a run that anybody can open with numpy.

Rows are spooled to a nameless file beside the target, so memory stays constant for a run of any
length and a full disk shows while tracking, not at the end. `close` turns the spool into the .npz:
uncompressed, with fixed time stamps, hence byte-identical for identical poses; it appears under
its name complete or not at all.
"""

import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from common.errors import RecordingError
from common.messages import HandPose
from common.replacing import replacing
from master.outputs.poses import Poses, record

_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)


class PosesFile:
    """A `Sink` that becomes poses.npz; holds the spool of rows written so far."""

    def __init__(self, path: Path, hand: str, marker_count: int) -> None:
        """Open the spool in the folder of `path`.

        Args:
            path: The .npz to write.
            hand: Name of the hand profile; every pose must carry it.
            marker_count: M; every pose must have as many markers.

        Raises:
            RecordingError: The folder is missing or read-only.
        """
        self._path = path
        self._hand = hand
        self._dtype = record(marker_count)
        self._rows = 0
        self._closed = False
        try:
            # Its name is gone at once: a killed process leaves nothing behind.
            self._spool: IO[bytes] = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115
        except OSError as error:
            raise _cannot_write(path, error) from error

    def write(self, pose: HandPose) -> None:
        """Append one row.

        Raises:
            RecordingError: Disk full; the run's file is given up, see `close`.
            ValueError: Another hand or marker count than the file was opened for, or it is closed.
        """
        if self._closed:
            raise ValueError(f"{self._path}: already closed")
        if pose.hand != self._hand or pose.markers_m.shape != self._dtype["markers_m"].shape:
            what = f"{pose.hand!r} with {len(pose.markers_m)} markers"
            raise ValueError(f"{self._path}: a pose of {what} does not fit, opened for {self._hand!r}")
        row = np.empty((), self._dtype)
        for name in self._dtype.names or ():
            row[name] = getattr(pose, name)
        try:
            self._spool.write(row.tobytes())
        except OSError as error:
            self._give_up()
            raise _cannot_write(self._path, error) from error
        self._rows += 1

    def close(self) -> None:
        """Write the .npz; an older file of that name is replaced only by a complete one.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        if self._closed:
            return
        try:
            self._spool.flush()
            _write(self._path, self._hand, self._table())
        except OSError as error:
            raise _cannot_write(self._path, error) from error
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


def save_poses(path: Path, poses: Poses) -> None:
    """Write poses.npz in one call.

    Raises:
        RecordingError: As `PosesFile`.
    """
    file = PosesFile(path, poses.hand, poses.marker_count)
    for index in range(len(poses)):
        file.write(poses.pose(index))
    file.close()


def load_poses(path: Path) -> Poses:
    """Read a poses.npz.

    Raises:
        RecordingError: Missing, not an .npz, a key missing or of the wrong type or shape.
    """
    names = [*(record(0).names or ()), "hand"]
    try:
        with np.load(path, allow_pickle=False) as data:
            missing = [name for name in names if name not in data.files]
            if missing:
                raise RecordingError(f"{path}: key {missing[0]!r} is missing; not a poses.npz of ours")
            arrays = {name: np.asarray(data[name]) for name in names}
        hand = str(arrays.pop("hand"))
        return Poses(hand=hand, **arrays)
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}") from error
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise RecordingError(f"{path}: not a poses.npz: {error}") from error


def _write(path: Path, hand: str, table: npt.NDArray[np.void]) -> None:
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name in table.dtype.names or ():
            _add(archive, name, table[name])
        _add(archive, "hand", np.array(hand))


def _add(archive: zipfile.ZipFile, name: str, array: npt.NDArray[np.generic]) -> None:
    """Add one array; `write_array` walks a strided map in small buffers, so memory stays constant."""
    info = zipfile.ZipInfo(f"{name}.npy", _ZIP_EPOCH)
    with archive.open(info, "w", force_zip64=True) as member:
        npy.write_array(member, array, version=(1, 0), allow_pickle=False)


def _cannot_write(path: Path, error: OSError) -> RecordingError:
    fix = "free the disk or choose another folder"
    return RecordingError(f"{path}: cannot write: {error.strerror or error}; {fix}")
