"""Tables and files keep the objects, contacts and gestures of a run.

object_<name>.npz, contact_<hand>_<object>.npz and gestures.jsonl (a message a line, NaN is null) beside
poses.npz. What is written is spooled to a nameless file beside the target, so a run may have any length in
constant memory, and a full disk shows while tracking. `close` makes the file, complete or not at all; an .npz
is uncompressed, with fixed time stamps, hence byte-identical for identical rows.
"""

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
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
from common.messages import FINGER_COUNT, Contact, Gesture, Message, ObjectPose
from common.recording.recorded_files import read_npz, write_npz

Row = np.dtype[np.void]


class _SpooledFile(ABC):
    def __init__(self, path: Path) -> None:
        """Open the spool in the folder of `path`; RecordingError: missing or read-only."""
        self._path, self._closed = path, False
        try:
            # Its name is gone at once: a killed process leaves nothing behind.
            self._spool: IO[bytes] = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115
        except OSError as error:
            raise cannot_write(path, error) from error

    def close(self) -> None:
        """Make the file, replacing an older one when complete. Safe to call twice.

        Raises:
            RecordingError: Disk full or folder gone; no part of a file is left.
        """
        if self._closed:
            return
        try:
            self._finish()
        except OSError as error:
            raise cannot_write(self._path, error) from error
        finally:
            self._give_up()

    @abstractmethod
    def _finish(self) -> None:
        """Turn the spool into the file."""

    def _append(self, data: bytes) -> None:
        try:
            self._spool.write(data)
        except OSError as error:
            self._give_up()
            raise cannot_write(self._path, error) from error

    def _refuse_closed(self) -> None:
        if self._closed:
            raise ValueError(f"{self._path}: already closed")

    def _give_up(self) -> None:
        self._closed = True
        # Closing flushes what a full disk refused before; that error was already raised.
        with suppress(OSError):
            self._spool.close()


class TableFile(_SpooledFile):
    """A table of fixed row type that becomes an .npz."""

    def __init__(self, path: Path, dtype: Row, labels: Mapping[str, str]) -> None:
        """Open the spool in the folder of `path`; RecordingError: missing or read-only.

        Args:
            dtype: Of a row: each field is an attribute of the messages, and becomes an array of the file.
            labels: Texts that stand in the file beside the arrays.
        """
        self._dtype, self._labels = dtype, dict(labels)
        self._rows = 0
        super().__init__(path)

    def write(self, message: Message) -> None:
        """Append the row of one message; RecordingError: disk full, the file is given up."""
        self._refuse_closed()
        row = np.empty((), self._dtype)
        for name in self._dtype.names or ():
            row[name] = getattr(message, name)
        self._append(row.tobytes())
        self._rows += 1

    def _finish(self) -> None:
        self._spool.flush()
        if self._rows == 0:  # an empty file cannot be mapped
            table = np.empty(0, self._dtype)
        else:
            table = np.memmap(self._spool, self._dtype, "r", shape=(self._rows,))
        columns: dict[str, npt.NDArray[Any]] = {name: table[name] for name in self._dtype.names or ()}
        write_npz(self._path, columns | {name: np.array(text) for name, text in self._labels.items()})


def cannot_write(path: Path, error: OSError) -> RecordingError:
    """Return the error for a file of a run that cannot be written."""
    fix = "free the disk or choose another folder"
    return RecordingError(f"{path}: cannot write: {error.strerror or error}; {fix}")


GESTURES = "gestures.jsonl"
_OURS = "not written by this program"


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPoses:
    """T poses of one object; fields as in `ObjectPose`."""

    object: str
    t_ns: Int  # (T,) [ns]
    position_m: Float  # (T, 3) [m], rig frame. NaN: not known
    orientation_wxyz: Float  # (T, 4) object axes -> rig frame
    cov: Float  # (T, 6, 6) [m^2, m rad, rad^2]
    residual_m: Float  # (T,) [m]
    source: Code  # (T,) `ObjectSource` codes
    tracked: Bool  # (T,)
    seen: Int  # (T,)
    expected: Int  # (T,)
    occluded: Bool  # (T,)
    latency_ns: Int  # (T,) [ns]; 0 in an offline run

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

    def messages(self) -> list[ObjectPose]:
        """The rows as the messages they were."""
        return [ObjectPose(object=self.object, **row) for row in _rows(self, object_record())]


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """Distances of one hand to one object at T times; fields as in `Contact`."""

    hand: str
    object: str
    t_ns: Int  # (T,) [ns], those of the hand's poses
    distance_m: Float  # (T, 5) [m]
    sigma_m: Float  # (T, 5) [m]
    point_m: Float  # (T, 5, 3) [m], rig frame
    touching: Bool  # (T, 5)
    palm_distance_m: Float  # (T,) [m]
    held: Bool  # (T,)

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def of(cls, hand: str, name: str, contacts: Sequence[Contact]) -> "Contacts":
        """Stack the contacts of a hand and an object; also none."""
        return cls(hand=hand, object=name, **_stacked(contacts, contact_record()))

    def messages(self) -> list[Contact]:
        """The rows as the messages they were."""
        return [Contact(hand=self.hand, object=self.object, **row) for row in _rows(self, contact_record())]


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


def _rows(table: ObjectPoses | Contacts, dtype: Row) -> list[dict[str, Any]]:
    """Each row by its fields: arrays, and plain numbers where a field is one number."""
    columns = {name: getattr(table, name) for name in dtype.names or ()}
    values = {name: column.tolist() if column.ndim == 1 else column for name, column in columns.items()}
    return [{name: value[row] for name, value in values.items()} for row in range(len(table))]


def nearest_rows(rising_ns: Int, t_ns: Int) -> Int:
    """Rows (T,) of rising times that are nearest to others (T,)."""
    after = np.clip(np.searchsorted(rising_ns, t_ns), 0, len(rising_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(rising_ns[before] - t_ns) <= np.abs(rising_ns[after] - t_ns)
    return np.where(nearer, before, after)


def object_path(folder: Path, name: str) -> Path:
    """Where the poses of an object stand."""
    return folder / f"object_{name}.npz"


def contact_path(folder: Path, hand: str, name: str) -> Path:
    """Where it stands how near a hand was to an object."""
    return folder / f"contact_{hand}_{name}.npz"


def object_file(folder: Path, name: str) -> TableFile:
    """Open object_<name>.npz; RecordingError: the folder is missing or read-only."""
    return TableFile(object_path(folder, name), object_record(), {"object": name})


def contact_file(folder: Path, hand: str, name: str) -> TableFile:
    """Open contact_<hand>_<object>.npz; RecordingError as `object_file`."""
    return TableFile(contact_path(folder, hand, name), contact_record(), {"hand": hand, "object": name})


class GesturesFile(_SpooledFile):
    """gestures.jsonl in a folder."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / GESTURES)

    def write(self, gesture: Gesture) -> None:
        """Append a line; RecordingError: disk full, the file is given up."""
        self._refuse_closed()
        self._append(gesture_line(gesture))

    def _finish(self) -> None:
        self._spool.seek(0)
        with replacing(self._path) as file:
            while block := self._spool.read(1 << 20):
                file.write(block)


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
    """Read object_<name>.npz; RecordingError: missing, or not of this type and shape."""
    return ObjectPoses(**_table(path, object_record(), ("object",)))


def load_contact(path: Path) -> Contacts:
    """Read contact_<hand>_<object>.npz; RecordingError as `load_object`."""
    return Contacts(**_table(path, contact_record(), ("hand", "object")))


def load_gesture_messages(path: Path) -> list[Gesture]:
    """Read gestures.jsonl; RecordingError: missing, or a line is no gesture."""
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
    """The arrays and labels of a table; RecordingError as `load_object`."""
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
