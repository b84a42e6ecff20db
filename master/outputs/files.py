"""Writer and reader of poses.npz, the record of a run readable with numpy.

Also writes and reads all files of a run at once.

Each appears under its name complete or not at all, and identical poses make identical bytes (`table_file`).
"""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

from common.errors import RecordingError
from common.messages import Gesture, HandPose, ObjectPose, ResultMessage
from common.recording.npz import read_npz
from master.outputs.poses import Poses, record
from master.outputs.result_files import GesturesFile, contact_file, object_file
from master.outputs.table_file import TableFile


class PosesFile:
    """poses.npz of one hand; holds the spool of rows written so far."""

    def __init__(self, path: Path, hand: str, marker_count: int) -> None:
        """Open the spool in the folder of `path`.

        Args:
            path: The .npz to write.
            hand: Name of the hand profile; every pose must carry it.
            marker_count: M; every pose must have as many markers.

        Raises:
            RecordingError: The folder is missing or read-only.
        """
        self._path, self._hand = path, hand
        self._markers = (marker_count, 3)
        self._file = TableFile(path, record(marker_count), {"hand": hand})

    def write(self, pose: HandPose) -> None:
        """Append one row.

        Raises:
            RecordingError: Disk full; the run's file is given up, see `close`.
            ValueError: Another hand or marker count than the file was opened for, or it is closed.
        """
        if pose.hand != self._hand or pose.markers_m.shape != self._markers:
            what = f"{pose.hand!r} with {len(pose.markers_m)} markers"
            raise ValueError(f"{self._path}: a pose of {what} does not fit, opened for {self._hand!r}")
        self._file.write(pose)

    def close(self) -> None:
        """Write the .npz; an older file of that name is replaced only by a complete one.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        self._file.close()


class RunFiles:
    """A `Sink` that writes the files of a run.

    A poses.npz for each hand, and beside it the other results.

    The first hand's poses stand at the path itself, those of others beside it under their names; objects, contact and
    gestures in the same folder (`told_files`).
    """

    def __init__(self, path: Path, marker_counts: Mapping[str, int], objects: Sequence[str] = ()) -> None:
        """Open the spools.

        Args:
            path: Of the first hand's poses.
            marker_counts: Name of the hand profile -> M.
            objects: Names of the objects.

        Raises:
            RecordingError: The folder is missing or read-only.
        """
        first, folder = next(iter(marker_counts)), path.parent
        self._hands = {
            hand: PosesFile(path if hand == first else path_of_hand(path, hand), hand, count)
            for hand, count in marker_counts.items()
        }
        self._objects = {name: object_file(folder, name) for name in objects}
        self._contacts = {
            (hand, name): contact_file(folder, hand, name)
            for hand, count in marker_counts.items()
            if count  # a wrist device alone measures no contact
            for name in objects
        }
        self._gestures = GesturesFile(folder)

    def write(self, message: ResultMessage) -> None:
        """Append a row to the file of its hand or object.

        Raises:
            RecordingError: Disk full; the file is given up.
            ValueError: A hand or object that they were not opened for, or another marker count, or they are closed.
        """
        if isinstance(message, Gesture):
            self._gestures.write(message)
        elif isinstance(message, HandPose):
            if message.hand not in self._hands:
                raise ValueError(
                    f"a pose of {message.hand!r} does not fit, opened for {', '.join(self._hands)}"
                )
            self._hands[message.hand].write(message)
        elif isinstance(message, ObjectPose):
            if message.object not in self._objects:
                opened = ", ".join(self._objects) or "none"
                raise ValueError(f"a pose of object {message.object!r} does not fit, opened for {opened}")
            self._objects[message.object].write(message)
        else:
            if (message.hand, message.object) not in self._contacts:
                raise ValueError(f"contact of {message.hand!r} and {message.object!r} does not fit")
            self._contacts[message.hand, message.object].write(message)

    def close(self) -> None:
        """Write each file.

        A file that cannot be completed does not keep any other from being written.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        with ExitStack() as all_of_them:
            files = (*self._hands.values(), *self._objects.values(), *self._contacts.values(), self._gestures)
            for file in files:
                all_of_them.callback(file.close)


def path_of_hand(path: Path, hand: str) -> Path:
    """Return the poses file of a hand other than the first.

    poses.npz -> poses-HAND.npz.
    """
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
