"""Tables and files keep the objects, contacts and gestures of a run.

Table of fixed row type that becomes an .npz when the run ends.

In constant memory; the file is complete or not written at all.

Rows are spooled to a nameless file beside the target, so a run may have any length and a full disk shows while
tracking, not at the end. `close` turns the spool into the .npz: uncompressed, with fixed time stamps, hence
byte-identical for identical rows.

Writer and reader of the results of a run beside the hands.

object_<name>.npz, contact_<hand>_<object>.npz, gestures.jsonl.

They stand in the folder of poses.npz. A gesture is a line of JSON with the fields of the message; NaN is null.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path
from typing import IO, Any, cast

import msgspec
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Code, Float, Int
from common.calibration.files import replacing
from common.errors import RecordingError
from common.messages import FINGER_COUNT, Gesture, Message, ObjectPose
from common.recording.recorded_files import read_npz, write_npz

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


GESTURES = "gestures.jsonl"
_OURS = "not written by this program"


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPoses:
    """T poses of one object; fields as in `ObjectPose`.

    Attributes:
        object: Name of the object file.
        t_ns: (T,) [ns].
        position_m: (T, 3) [m], rig frame. NaN: not known.
        orientation_wxyz: (T, 4) object axes -> rig frame.
        cov: (T, 6, 6) [m^2, m rad, rad^2].
        residual_m: (T,) [m].
        source: (T,) `ObjectSource` codes.
        tracked, occluded: (T,).
        seen, expected: (T,).
        latency_ns: (T,) [ns]; 0 in an offline run.
    """

    object: str
    t_ns: Int
    position_m: Float
    orientation_wxyz: Float
    cov: Float
    residual_m: Float
    source: Code
    tracked: Bool
    seen: Int
    expected: Int
    occluded: Bool
    latency_ns: Int

    def __len__(self) -> int:
        return len(self.t_ns)

    def rows(self, start: int, stop: int) -> "ObjectPoses":
        """Rows start..stop-1, without copying."""
        names = object_record().names or ()
        return ObjectPoses(object=self.object, **{name: getattr(self, name)[start:stop] for name in names})

    @classmethod
    def of(cls, name: str, poses: Sequence[ObjectPose]) -> "ObjectPoses":
        """Stack the poses of one object; also none."""
        return cls(object=name, **_stacked(poses, object_record()))


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """Distances of one hand to one object at T times.

    Fields as in `Contact`.

    Attributes:
        hand, object: Their names.
        t_ns: (T,) [ns], those of the hand's poses.
        distance_m, sigma_m: (T, 5) [m].
        point_m: (T, 5, 3) [m], rig frame.
        touching: (T, 5).
        palm_distance_m: (T,) [m].
        held: (T,).
    """

    hand: str
    object: str
    t_ns: Int
    distance_m: Float
    sigma_m: Float
    point_m: Float
    touching: Bool
    palm_distance_m: Float
    held: Bool

    def __len__(self) -> int:
        return len(self.t_ns)


def object_record() -> Row:
    """One row of object_<name>.npz."""
    return np.dtype(
        [
            ("t_ns", "<i8"),
            ("position_m", "<f8", (3,)),
            ("orientation_wxyz", "<f8", (4,)),
            ("cov", "<f8", (6, 6)),
            ("residual_m", "<f8"),
            ("source", "u1"),
            ("tracked", "?"),
            ("seen", "<i8"),
            ("expected", "<i8"),
            ("occluded", "?"),
            ("latency_ns", "<i8"),
        ]
    )


def contact_record() -> Row:
    """One row of contact_<hand>_<object>.npz."""
    return np.dtype(
        [
            ("t_ns", "<i8"),
            ("distance_m", "<f8", (FINGER_COUNT,)),
            ("sigma_m", "<f8", (FINGER_COUNT,)),
            ("point_m", "<f8", (FINGER_COUNT, 3)),
            ("touching", "?", (FINGER_COUNT,)),
            ("palm_distance_m", "<f8"),
            ("held", "?"),
        ]
    )


def _stacked(messages: Sequence[Message], dtype: Row) -> dict[str, Any]:
    return {
        name: np.array([getattr(message, name) for message in messages], dtype=dtype[name].base).reshape(
            len(messages), *dtype[name].shape
        )
        for name in dtype.names or ()
    }


def object_path(folder: Path, name: str) -> Path:
    """Where the poses of an object stand."""
    return folder / f"object_{name}.npz"


def contact_path(folder: Path, hand: str, name: str) -> Path:
    """Where it stands how near a hand was to an object."""
    return folder / f"contact_{hand}_{name}.npz"


def object_file(folder: Path, name: str) -> TableFile:
    """Open object_<name>.npz.

    Raises:
        RecordingError: The folder is missing or read-only.
    """
    return TableFile(object_path(folder, name), object_record(), {"object": name})


def contact_file(folder: Path, hand: str, name: str) -> TableFile:
    """Open contact_<hand>_<object>.npz.

    Raises:
        RecordingError: The folder is missing or read-only.
    """
    return TableFile(contact_path(folder, hand, name), contact_record(), {"hand": hand, "object": name})


class GesturesFile:
    """gestures.jsonl; holds the spool of lines written so far."""

    def __init__(self, folder: Path) -> None:
        """Open the spool.

        Raises:
            RecordingError: The folder is missing or read-only.
        """
        self._path = folder / GESTURES
        self._closed = False
        try:
            self._spool: IO[bytes] = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        except OSError as error:
            raise cannot_write(self._path, error) from error

    def write(self, gesture: Gesture) -> None:
        """Append a line.

        Raises:
            RecordingError: Disk full; the run's file is given up.
            ValueError: It is closed.
        """
        if self._closed:
            raise ValueError(f"{self._path}: already closed")
        try:
            self._spool.write(gesture_line(gesture))
        except OSError as error:
            self._give_up()
            raise cannot_write(self._path, error) from error

    def close(self) -> None:
        """Write the file.

        An older file is replaced only by a complete one. Safe to call twice.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        if self._closed:
            return
        try:
            self._spool.seek(0)
            with replacing(self._path) as file:
                while block := self._spool.read(1 << 20):
                    file.write(block)
        except OSError as error:
            raise cannot_write(self._path, error) from error
        finally:
            self._give_up()

    def _give_up(self) -> None:
        self._closed = True
        try:
            self._spool.close()
        except OSError:
            return  # closing flushes what a full disk refused before; that error was already raised


def gesture_line(gesture: Gesture) -> bytes:
    """One gesture as a line of JSON."""
    return msgspec.json.encode(gesture, enc_hook=_as_list) + b"\n"


def _as_list(array: object) -> object:
    if not isinstance(array, np.ndarray):
        raise NotImplementedError(f"cannot encode {type(array)}")
    return cast(Float, array).tolist()


def _from_list(kind: type, values: object) -> object:
    del kind  # the arrays of a gesture are all of one type
    if not isinstance(values, list):
        raise ValueError("array is not a list")
    return np.array(
        [nan if value is None else value for value in cast(list[float | None], values)], np.float64
    )


def load_object(path: Path) -> ObjectPoses:
    """Read object_<name>.npz.

    Raises:
        RecordingError: Missing, not an .npz, a key missing or of the wrong type or shape.
    """
    arrays = _table(path, object_record(), ("object",))
    return ObjectPoses(**arrays)


def load_contact(path: Path) -> Contacts:
    """Read contact_<hand>_<object>.npz.

    Raises:
        RecordingError: As `load_object`.
    """
    return Contacts(**_table(path, contact_record(), ("hand", "object")))


def load_gesture_messages(path: Path) -> list[Gesture]:
    """Read gestures.jsonl.

    Raises:
        RecordingError: Missing, or a line is no gesture; with its number.
    """
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}") from error
    found: list[Gesture] = []
    for number, line in enumerate(lines, start=1):
        try:
            fields = msgspec.json.decode(line, type=dict[str, Any])
            known = {name: nan if value is None else value for name, value in fields.items()}
            found.append(msgspec.convert(known, Gesture, dec_hook=_from_list))
        except (msgspec.MsgspecError, TypeError, ValueError) as error:
            raise RecordingError(f"{path}: line {number}: {error}: {_OURS}") from error
    return found


def _table(path: Path, dtype: Row, labels: tuple[str, ...]) -> dict[str, Any]:
    """The arrays and labels of a table, of the right types.

    Raises:
        RecordingError: Missing, not an .npz, a key missing or of the wrong type or shape.
    """
    names = dtype.names or ()
    arrays = read_npz(path, [*names, *labels], _OURS)
    count = len(arrays["t_ns"]) if arrays["t_ns"].ndim else -1
    for name in names:
        kind, shape = dtype[name].base, (count, *dtype[name].shape)
        if arrays[name].shape != shape or arrays[name].dtype != kind:
            raise RecordingError(
                f"{path}: {name}: {arrays[name].dtype} {arrays[name].shape}, expected {kind} {shape}: {_OURS}"
            )
    return {name: arrays[name] for name in names} | {name: str(arrays[name]) for name in labels}
