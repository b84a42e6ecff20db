"""Tables and files keep the poses, objects, contacts and gestures of a run.

poses.npz, object_<name>.npz, contact_<hand>_<object>.npz and gestures.jsonl (a message a line, NaN is null).
What is written is spooled to a nameless file beside the target, so a run may have any length in constant
memory, and a full disk shows while tracking. `close` makes the file, complete or not at all; an .npz is
uncompressed, with fixed time stamps, hence byte-identical for identical rows.
"""

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from math import nan
from pathlib import Path
from typing import IO, Any, ClassVar, Generic, Self, TypeVar, cast

import msgspec
import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.calibration.files import replacing
from common.errors import RecordingError
from common.messages import FINGER_COUNT, JOINT_COUNT, Contact, Gesture, HandPose, Message, ObjectPose
from common.recording.recorded_files import read_npz, write_npz

Row = np.dtype[np.void]
MessageT = TypeVar("MessageT", bound=Message)
GESTURES = "gestures.jsonl"
_OURS = "not written by this program"
_LABELS = ("hand", "object")  # texts of a file and a message, beside the arrays


def row_type(kind: type[Message], markers: int = 0) -> Row:
    """Return the type of a row of an .npz; nothing else fixes names and shapes."""
    f, j, m = FINGER_COUNT, JOINT_COUNT, markers
    columns: dict[type[Message], list[tuple[str, str, tuple[int, ...]]]] = {
        HandPose: [
            ("t_ns", "<i8", ()),
            ("position_m", "<f8", (j, 3)),
            ("orientation_wxyz", "<f8", (j, 4)),
            ("radius_m", "<f8", (j,)),
            ("valid", "?", (j,)),
            ("tracked", "?", (j,)),
            ("cov_m2", "<f8", (j, 3, 3)),
            ("source", "u1", (j,)),
            ("angles_rad", "<f8", (f, 4)),
            ("markers_m", "<f8", (m, 3)),
            ("markers_raw_m", "<f8", (m, 3)),
            ("markers_cov_m2", "<f8", (m, 3, 3)),
            ("inside_volume", "?", (j,)),
            ("latency_ns", "<i8", ()),
            ("laser_m", "<f8", (f, 3)),
            ("solver_mode", "u1", (f,)),
            ("ambiguous", "?", (f,)),
            ("palm_world_wxyz", "<f8", (4,)),
            ("palm_world_sigma_rad", "<f8", (2,)),
            ("wrist_angles_rad", "<f8", (2,)),
            ("wrist_angles_sigma_rad", "<f8", (2,)),
        ],
        ObjectPose: [
            ("t_ns", "<i8", ()),
            ("position_m", "<f8", (3,)),
            ("orientation_wxyz", "<f8", (4,)),
            ("cov", "<f8", (6, 6)),
            ("residual_m", "<f8", ()),
            ("source", "u1", ()),
            ("tracked", "?", ()),
            ("seen", "<i8", ()),
            ("expected", "<i8", ()),
            ("occluded", "?", ()),
            ("latency_ns", "<i8", ()),
        ],
        Contact: [
            ("t_ns", "<i8", ()),
            ("distance_m", "<f8", (f,)),
            ("sigma_m", "<f8", (f,)),
            ("point_m", "<f8", (f, 3)),
            ("touching", "?", (f,)),
            ("palm_distance_m", "<f8", ()),
            ("held", "?", ()),
        ],
    }
    return np.dtype(columns[kind])


class Table(Generic[MessageT]):
    """T rows of one hand or object; an array for each field of its message."""

    __slots__ = ()
    kind: ClassVar[type[Message]]
    t_ns: Int

    @property
    def marker_count(self) -> int:
        """M; 0: not of a hand."""
        return 0

    def __post_init__(self) -> None:
        """Refuse arrays of shapes or types that do not fit together; ValueError."""
        row = row_type(self.kind, self.marker_count)
        count = len(self) if self.t_ns.ndim else -1
        for name in row.names or ():
            array, kind, shape = getattr(self, name), row[name].base, (count, *row[name].shape)
            if array.shape != shape or array.dtype != kind:
                raise ValueError(f"{name}: {array.dtype} {array.shape}, expected {kind} {shape}")

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def stacked(cls, messages: Sequence[MessageT], markers: int = 0, **labels: str) -> Self:
        """The table of messages, also of none."""
        row = row_type(cls.kind, markers)
        arrays: dict[str, Any] = {
            name: np.array([getattr(message, name) for message in messages], row[name].base).reshape(
                len(messages), *row[name].shape
            )
            for name in row.names or ()
        }
        return cls(**labels, **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read an .npz; RecordingError: missing, or not of this type and shape."""
        labels = [one.name for one in fields(cast(Any, cls)) if one.name in _LABELS]
        arrays: dict[str, Any] = read_npz(path, [*(row_type(cls.kind).names or ()), *labels], _OURS)
        try:
            return cls(**arrays | {name: str(arrays[name]) for name in labels})
        except ValueError as error:
            raise RecordingError(f"{path}: {error}: {_OURS}") from error

    def where(self, chosen: slice | Bool) -> Self:
        """Some of the rows."""
        names = row_type(self.kind).names or ()
        return replace(cast(Any, self), **{name: getattr(self, name)[chosen] for name in names})

    def rows(self, start: int, stop: int) -> Self:
        """Rows start..stop-1, without copying."""
        return self.where(slice(start, stop))

    def messages(self) -> list[MessageT]:
        """The rows as the messages they were."""
        labels = {name: getattr(self, name) for name in _LABELS if hasattr(self, name)}
        columns = {name: getattr(self, name) for name in row_type(self.kind).names or ()}
        values = {name: column.tolist() if column.ndim == 1 else column for name, column in columns.items()}
        make = cast(Any, self.kind)
        return [
            make(**labels, **{name: value[row] for name, value in values.items()}) for row in range(len(self))
        ]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPoses(Table[ObjectPose]):
    """T poses of one object; fields as in `ObjectPose`."""

    kind = ObjectPose
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


@dataclass(frozen=True, slots=True, eq=False)
class Contacts(Table[Contact]):
    """Distances of one hand to one object at T times; fields as in `Contact`."""

    kind = Contact
    hand: str
    object: str
    t_ns: Int  # (T,) [ns], those of the hand's poses
    distance_m: Float  # (T, 5) [m]
    sigma_m: Float  # (T, 5) [m]
    point_m: Float  # (T, 5, 3) [m], rig frame
    touching: Bool  # (T, 5)
    palm_distance_m: Float  # (T,) [m]
    held: Bool  # (T,)


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


class SpooledFile(ABC):
    """A file of messages that appears when it is complete."""

    def __init__(self, path: Path) -> None:
        """Open the spool in the folder of `path`; RecordingError: missing or read-only."""
        self._path, self._closed = path, False
        try:
            # Its name is gone at once: a killed process leaves nothing behind.
            self._spool: IO[bytes] = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115
        except OSError as error:
            raise cannot_write(path, error) from error

    def write(self, message: Message) -> None:
        """Append one message.

        Raises:
            RecordingError: Disk full; the file is given up, see `close`.
            ValueError: The message does not fit, or the file is closed.
        """
        if self._closed:
            raise ValueError(f"{self._path}: already closed")
        try:
            self._spool.write(self._encoded(message))
        except OSError as error:
            self._give_up()
            raise cannot_write(self._path, error) from error

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
    def _encoded(self, message: Message) -> bytes:
        """One message as it is spooled; ValueError: it does not fit."""

    @abstractmethod
    def _finish(self) -> None:
        """Turn the spool into the file."""

    def _give_up(self) -> None:
        self._closed = True
        # Closing flushes what a full disk refused before; that error was already raised.
        with suppress(OSError):
            self._spool.close()


class TableFile(SpooledFile):
    """An .npz of messages of one kind, a row each, and of the texts `labels`."""

    def __init__(self, path: Path, kind: type[Message], labels: Mapping[str, str], markers: int = 0) -> None:
        super().__init__(path)
        self._row, self._labels, self._count = row_type(kind, markers), dict(labels), 0

    def _encoded(self, message: Message) -> bytes:
        row = np.empty((), self._row)
        for name in self._row.names or ():
            row[name] = getattr(message, name)
        self._count += 1
        return row.tobytes()

    def _finish(self) -> None:
        self._spool.flush()
        if self._count == 0:  # an empty file cannot be mapped
            table = np.empty(0, self._row)
        else:
            table = np.memmap(self._spool, self._row, "r", shape=(self._count,))
        columns = {name: table[name] for name in self._row.names or ()}
        write_npz(self._path, columns | {name: np.array(text) for name, text in self._labels.items()})


class GesturesFile(SpooledFile):
    """gestures.jsonl."""

    def _encoded(self, message: Message) -> bytes:
        return gesture_line(cast(Gesture, message))

    def _finish(self) -> None:
        self._spool.seek(0)
        with replacing(self._path) as file:
            while block := self._spool.read(1 << 20):
                file.write(block)


def cannot_write(path: Path, error: OSError) -> RecordingError:
    """Return the error for a file of a run that cannot be written."""
    fix = "free the disk or choose another folder"
    return RecordingError(f"{path}: cannot write: {error.strerror or error}; {fix}")


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


def load_gesture_messages(path: Path) -> list[Gesture]:
    """Read gestures.jsonl; RecordingError: missing, or a line is no gesture."""
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}") from error
    found: list[Gesture] = []
    for number, line in enumerate(lines, start=1):
        try:
            columns = msgspec.json.decode(line, type=dict[str, Any])
            known = {name: nan if value is None else value for name, value in columns.items()}
            found.append(msgspec.convert(known, Gesture, dec_hook=_from_list))
        except (msgspec.MsgspecError, TypeError, ValueError) as error:
            raise RecordingError(f"{path}: line {number}: {error}: {_OURS}") from error
    return found
