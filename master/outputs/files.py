"""Writes and reads poses.npz, the record of a run that anybody can open with numpy.

Rows are spooled to a nameless file beside the target, so memory stays constant for a run of any
length and a full disk shows while tracking, not at the end. `close` turns the spool into the .npz:
uncompressed, with fixed time stamps, hence byte-identical for identical poses; it appears under
its name complete or not at all.
"""

import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import numpy.typing as npt

from common.errors import RecordingError
from common.messages import HandPose
from common.npz import read_npz, write_npz
from master.outputs.poses import Poses, record


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
            table = self._table()
            columns = {name: table[name] for name in self._dtype.names or ()}
            write_npz(self._path, {**columns, "hand": np.array(self._hand)})
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


class PosesFiles:
    """A `Sink` that becomes a poses.npz for each hand: the first at the path itself, others beside it."""

    def __init__(self, path: Path, marker_counts: Mapping[str, int]) -> None:
        """Open the spools; `marker_counts`: name of the hand profile -> M.

        Raises:
            RecordingError: The folder is missing or read-only.
        """
        first = next(iter(marker_counts))
        self._files = {
            hand: PosesFile(path if hand == first else path_of_hand(path, hand), hand, count)
            for hand, count in marker_counts.items()
        }

    def write(self, pose: HandPose) -> None:
        """Append one row to the file of its hand.

        Raises:
            RecordingError: Disk full; the hand's file is given up.
            ValueError: A hand that the files were not opened for, or another marker count, or they are closed.
        """
        if pose.hand not in self._files:
            raise ValueError(f"a pose of {pose.hand!r} does not fit, opened for {', '.join(self._files)}")
        self._files[pose.hand].write(pose)

    def close(self) -> None:
        """Write each .npz.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        with ExitStack() as all_of_them:
            for file in self._files.values():
                all_of_them.callback(file.close)


def path_of_hand(path: Path, hand: str) -> Path:
    """Where the poses of another hand than the first stand: poses.npz -> poses-HAND.npz."""
    return path.with_name(f"{path.stem}-{hand}{path.suffix}")


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
    arrays = read_npz(path, names, "not a poses.npz of ours")
    hand = str(arrays.pop("hand"))
    try:
        return Poses(hand=hand, **cast(dict[str, Any], arrays))
    except (ValueError, AttributeError) as error:
        raise RecordingError(f"{path}: not a poses.npz: {error}") from error


def _cannot_write(path: Path, error: OSError) -> RecordingError:
    fix = "free the disk or choose another folder"
    return RecordingError(f"{path}: cannot write: {error.strerror or error}; {fix}")
