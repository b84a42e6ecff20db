"""A take is the source of an export, a run or a recording, in a window.

Time window of a source that is exported.

It goes from and to a time, in seconds after the source's beginning.

Sources of an export: the files of a run, or a recording of messages.

They are read in batches, so that an hour fits.
"""

import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, fields, replace
from math import isfinite
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from common.arrays import Bool, Int
from common.errors import PhalanxError, RecordingError
from common.messages import (
    Contact,
    Detections,
    Gesture,
    HandPose,
    MarkerDetections,
    ObjectPose,
    WristDetections,
)
from common.recording.messages import MessageRecording, open_messages
from master.outputs.poses import Poses, load_poses, path_of_hand
from master.outputs.result_files import (
    GESTURES,
    Contacts,
    ObjectPoses,
    contact_record,
    load_contact,
    load_gesture_messages,
    load_object,
)
from master.recording.files import recorded_rigs, unpack

_Table = TypeVar("_Table", Poses, ObjectPoses, Contacts)


@dataclass(frozen=True, slots=True)
class Window:
    """A part of time.

    Attributes:
        from_s, to_s: Seconds after the source's beginning, both included; None: from there on, until its end.
    """

    from_s: float | None = None
    to_s: float | None = None

    def __post_init__(self) -> None:
        """Refuse what holds nothing.

        Raises:
            PhalanxError: Its end is before its beginning, or one of them is no number.
        """
        for option, value in (("--from", self.from_s), ("--until", self.to_s)):
            if value is not None and not isfinite(value):
                raise PhalanxError(f"{option} {value}: give seconds, or leave it out")
        if self.from_s is not None and self.to_s is not None and self.to_s < self.from_s:
            raise PhalanxError(f"--until {self.to_s:g} is before --from {self.from_s:g}")

    def span_ns(self, begin_t_ns: int) -> tuple[int | None, int | None]:
        """First and last time [ns]."""
        first, last = (
            None if one is None else begin_t_ns + round(one * 1e9) for one in (self.from_s, self.to_s)
        )
        return first, last

    def inside(self, t_ns: Int, begin_t_ns: int) -> Bool:
        """Which times (T,) [ns] are in it."""
        first, last = self.span_ns(begin_t_ns)
        good = np.ones(len(t_ns), np.bool_)
        if first is not None:
            good &= t_ns >= first
        if last is not None:
            good &= t_ns <= last
        return good

    def of(self, table: _Table, begin_t_ns: int) -> _Table:
        """The rows of a table that are in it."""
        good = self.inside(table.t_ns, begin_t_ns)
        if good.all():
            return table
        arrays: dict[str, Any] = {
            one.name: getattr(table, one.name)[good]
            for one in fields(table)
            if one.name not in ("hand", "object")
        }
        return replace(table, **arrays)


_Kind = TypeVar("_Kind", HandPose, ObjectPose, Contact, Gesture, MarkerDetections, WristDetections)
_BATCH = 1024


class Take(Protocol):
    """What was recorded of one or more hands."""

    @property
    def begin_t_ns(self) -> int:
        """Time of its beginning [ns], master's clock: second 0 of all that is exported."""
        ...

    @property
    def hands(self) -> tuple[str, ...]:
        """The hands it has poses of, in order."""
        ...

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is not as it should be with the source, for a person."""
        ...

    def count(self, hand: str) -> int:
        """How many poses of a hand there are at most."""
        ...

    def batches(self, hand: str) -> Iterator[Poses]:
        """The poses of a hand."""
        ...

    def objects(self) -> list[ObjectPoses]:
        """The objects."""
        ...

    def contacts(self) -> list[Contacts]:
        """Return the recorded contacts of hands and objects."""
        ...

    def gestures(self) -> list[Gesture]:
        """Return the recorded gestures of the hands."""
        ...

    def detections(self) -> dict[str, list[Detections]]:
        """Camera -> what it saw, where the source has that."""
        ...

    @property
    def rigs(self) -> tuple[str, ...]:
        """Names of the rigs that it was made with, where the source knows them."""
        ...

    def tree(self, given: Path) -> AbstractContextManager[Path]:
        """Return the calibration tree with which the source was made.

        It is the source's own, unpacked until the context ends, or else the tree that is given.
        """
        ...


class RunTake:
    """Files of a run: its poses.npz and what lies beside it.

    These are the poses of other hands, and everything else that the run wrote to the same folder.
    """

    def __init__(self, path: Path, window: Window) -> None:
        """Read the poses.

        Raises:
            RecordingError: A file cannot be read, or is not ours.
        """
        self._folder, self._window = path.parent, window
        first = load_poses(path)
        siblings = {
            file: load_poses(file) for file in sorted(path.parent.glob(f"{path.stem}-*{path.suffix}"))
        }
        hands = [
            first,
            *(poses for file, poses in siblings.items() if file == path_of_hand(path, poses.hand)),
        ]
        self.begin_t_ns = min((int(poses.t_ns[0]) for poses in hands if len(poses)), default=0)
        self._poses = {poses.hand: window.of(poses, self.begin_t_ns) for poses in hands}

    @property
    def hands(self) -> tuple[str, ...]:
        """As of `Take`."""
        return tuple(self._poses)

    @property
    def remarks(self) -> tuple[str, ...]:
        """None."""
        return ()

    def count(self, hand: str) -> int:
        """As of `Take`."""
        return len(self._poses[hand])

    def batches(self, hand: str) -> Iterator[Poses]:
        """As of `Take`."""
        poses = self._poses[hand]
        for start in range(0, len(poses), _BATCH):
            yield poses.rows(start, min(start + _BATCH, len(poses)))

    def objects(self) -> list[ObjectPoses]:
        """As of `Take`.

        Raises:
            RecordingError: A file is broken.
        """
        found = [load_object(path) for path in sorted(self._folder.glob("object_*.npz"))]
        return [self._window.of(one, self.begin_t_ns) for one in found]

    def contacts(self) -> list[Contacts]:
        """As of `Take`.

        Raises:
            RecordingError: A file is broken.
        """
        found = [load_contact(path) for path in sorted(self._folder.glob("contact_*.npz"))]
        return [self._window.of(one, self.begin_t_ns) for one in found]

    def gestures(self) -> list[Gesture]:
        """As of `Take`.

        Raises:
            RecordingError: The file is broken.
        """
        path = self._folder / GESTURES
        found = load_gesture_messages(path) if path.exists() else []
        return _inside(found, self._window, self.begin_t_ns)

    def detections(self) -> dict[str, list[Detections]]:
        """None: a run keeps them nowhere."""
        return {}

    @property
    def rigs(self) -> tuple[str, ...]:
        """None: poses do not know."""
        return ()

    def tree(self, given: Path) -> AbstractContextManager[Path]:
        """The tree that is given."""
        return nullcontext(given)


class MessageTake:
    """A recording of messages."""

    def __init__(self, path: Path, window: Window) -> None:
        """Open it.

        Raises:
            RecordingError: It is no recording of ours.
        """
        self._recording: MessageRecording = open_messages(path)
        self._window = window
        self.begin_t_ns = self._recording.begin_t_ns

    @property
    def hands(self) -> tuple[str, ...]:
        """As of `Take`."""
        return tuple(self._recording.senders.get("hand", {}))

    @property
    def remarks(self) -> tuple[str, ...]:
        """Whether the file is whole."""
        lines: list[str] = []
        if self._recording.cut:
            lines.append("the recording has no end (it broke off); all up to there is exported")
        if self._recording.broken:
            lines.append(f"{self._recording.broken} parts of the recording cannot be read and are left out")
        return tuple(lines)

    def count(self, hand: str) -> int:
        """As of `Take`."""
        return self._recording.senders["hand"][hand]

    def batches(self, hand: str) -> Iterator[Poses]:
        """As of `Take`; a new one begins where the number of markers changes."""
        batch: list[HandPose] = []
        for pose in self._read("hand", HandPose):
            if pose.hand != hand:
                continue
            if batch and (len(batch) == _BATCH or len(pose.markers_m) != len(batch[0].markers_m)):
                yield Poses.of(batch)
                batch = []
            batch.append(pose)
        if batch:
            yield Poses.of(batch)

    def objects(self) -> list[ObjectPoses]:
        """As of `Take`."""
        found: dict[str, list[ObjectPose]] = {}
        for one in self._read("object", ObjectPose):
            found.setdefault(one.object, []).append(one)
        return [ObjectPoses.of(name, rows) for name, rows in found.items()]

    def contacts(self) -> list[Contacts]:
        """As of `Take`."""
        found: dict[tuple[str, str], list[Contact]] = {}
        for one in self._read("contact", Contact):
            found.setdefault((one.hand, one.object), []).append(one)
        return [_contacts(hand, name, rows) for (hand, name), rows in found.items()]

    def gestures(self) -> list[Gesture]:
        """As of `Take`."""
        return list(self._read("gesture", Gesture))

    def detections(self) -> dict[str, list[Detections]]:
        """What the master took, in the order of time."""
        found: dict[str, list[Detections]] = {}
        for one in (*self._read("taken", MarkerDetections), *self._read("taken", WristDetections)):
            found.setdefault(one.camera, []).append(one)
        return {camera: sorted(frames, key=lambda one: one.t_ns) for camera, frames in found.items()}

    @property
    def rigs(self) -> tuple[str, ...]:
        """Return the names of the rigs, as the recording states them."""
        return recorded_rigs(self._recording)

    @contextmanager
    def tree(self, given: Path) -> Generator[Path]:
        """The recording's own; where it has none the tree that is given.

        Raises:
            RecordingError: Its files cannot be unpacked.
        """
        if not self._recording.files:
            yield given
            return
        with tempfile.TemporaryDirectory(prefix="phalanx-") as folder:
            unpack(self._recording, Path(folder))
            yield Path(folder)

    def _read(self, stream: str, kind: type[_Kind]) -> Iterator[_Kind]:
        """The messages of a stream whose own time is in the window."""
        first, last = self._window.span_ns(self.begin_t_ns)
        late_ns = 5_000_000_000
        # A message comes after its time, by no more than this in a run that is worth anything.
        until = None if last is None else last + late_ns
        for one in self._recording.read([stream], first, until):
            message = one.message
            if not isinstance(message, kind):
                continue
            if (first is None or message.t_ns >= first) and (last is None or message.t_ns <= last):
                yield message


def _contacts(hand: str, name: str, rows: Sequence[Contact]) -> Contacts:
    dtype = contact_record()
    arrays = {
        key: np.array([getattr(one, key) for one in rows], dtype[key].base) for key in dtype.names or ()
    }
    return Contacts(hand=hand, object=name, **arrays)


def _inside(gestures: Sequence[Gesture], window: Window, begin_t_ns: int) -> list[Gesture]:
    good = window.inside(np.array([one.t_ns for one in gestures], np.int64), begin_t_ns)
    return [one for one, yes in zip(gestures, good, strict=True) if yes]


def open_take(path: Path, window: Window) -> Take:
    """Open a source.

    An .mcap is a recording of messages, anything else is poses.npz of a run.

    Raises:
        RecordingError: There is no such file, or it is not ours.
    """
    if path.is_dir():
        raise RecordingError(f"{path}: is a folder; give the poses.npz of a run, or an .mcap recording")
    if not path.exists():
        raise RecordingError(f"{path}: no such file; give the poses.npz of a run, or an .mcap recording")
    return MessageTake(path, window) if path.suffix == ".mcap" else RunTake(path, window)
