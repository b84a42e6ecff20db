"""A take is the source of an export, a run or a recording, in a window.

Both are read in batches, so that an hour fits.
"""

import tempfile
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TypeAlias, TypeVar

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
from master.outputs.poses import Poses, path_of_hand
from master.outputs.result_files import GESTURES, Contacts, ObjectPoses, load_gesture_messages
from master.recording.files import recorded_rigs, unpack

TableT = TypeVar("TableT", Poses, ObjectPoses, Contacts)


@dataclass(frozen=True, slots=True)
class Window:
    """A part of time."""

    # seconds after the source's beginning, both included; None: from there on, until its end
    from_s: float | None = None
    to_s: float | None = None

    def __post_init__(self) -> None:
        """Refuse what holds nothing; PhalanxError."""
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

    def of(self, table: TableT, begin_t_ns: int) -> TableT:
        """The rows of a table that are in it."""
        good = self.inside(table.t_ns, begin_t_ns)
        return table if good.all() else table.where(good)


_Kind = TypeVar("_Kind", HandPose, ObjectPose, Contact, Gesture, MarkerDetections, WristDetections)
_BATCH = 1024


class _RunTake:
    """Files of a run: its poses.npz and what else the run wrote beside it."""

    remarks: tuple[str, ...] = ()
    rigs: tuple[str, ...] = ()  # poses do not know

    def __init__(self, path: Path, window: Window) -> None:
        self._folder, self._window = path.parent, window
        first = Poses.load(path)
        files = sorted(path.parent.glob(f"{path.stem}-*{path.suffix}"))
        siblings = {file: Poses.load(file) for file in files}
        hands = [first, *(one for file, one in siblings.items() if file == path_of_hand(path, one.hand))]
        self.begin_t_ns = min((int(poses.t_ns[0]) for poses in hands if len(poses)), default=0)
        self._poses = {poses.hand: window.of(poses, self.begin_t_ns) for poses in hands}

    @property
    def hands(self) -> tuple[str, ...]:
        return tuple(self._poses)

    def count(self, hand: str) -> int:
        return len(self._poses[hand])

    def batches(self, hand: str) -> Iterator[Poses]:
        poses = self._poses[hand]
        for start in range(0, len(poses), _BATCH):
            yield poses.rows(start, min(start + _BATCH, len(poses)))

    def objects(self) -> list[ObjectPoses]:
        return self._tables(ObjectPoses, "object_*.npz")

    def contacts(self) -> list[Contacts]:
        return self._tables(Contacts, "contact_*.npz")

    def _tables(self, kind: type[TableT], pattern: str) -> list[TableT]:
        found = [kind.load(path) for path in sorted(self._folder.glob(pattern))]
        return [self._window.of(one, self.begin_t_ns) for one in found]

    def gestures(self) -> list[Gesture]:
        path = self._folder / GESTURES
        found = load_gesture_messages(path) if path.exists() else []
        good = self._window.inside(np.array([one.t_ns for one in found], np.int64), self.begin_t_ns)
        return [one for one, yes in zip(found, good, strict=True) if yes]

    def detections(self) -> dict[str, list[Detections]]:
        return {}  # a run keeps them nowhere

    def tree(self, given: Path) -> AbstractContextManager[Path]:
        return nullcontext(given)


class _MessageTake:
    """A recording of messages."""

    def __init__(self, path: Path, window: Window) -> None:
        self._recording: MessageRecording = open_messages(path)
        self._window = window
        self.begin_t_ns = self._recording.begin_t_ns

    @property
    def hands(self) -> tuple[str, ...]:
        return tuple(self._recording.senders.get("hand", {}))

    @property
    def remarks(self) -> tuple[str, ...]:
        lines: list[str] = []
        if self._recording.cut:
            lines.append("the recording has no end (it broke off); all up to there is exported")
        if self._recording.broken:
            lines.append(f"{self._recording.broken} parts of the recording cannot be read and are left out")
        return tuple(lines)

    def count(self, hand: str) -> int:
        return self._recording.senders["hand"][hand]

    def batches(self, hand: str) -> Iterator[Poses]:
        """A new one begins where the number of markers changes."""
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
        found: dict[str, list[ObjectPose]] = {}
        for one in self._read("object", ObjectPose):
            found.setdefault(one.object, []).append(one)
        return [ObjectPoses.stacked(rows, object=name) for name, rows in found.items()]

    def contacts(self) -> list[Contacts]:
        found: dict[tuple[str, str], list[Contact]] = {}
        for one in self._read("contact", Contact):
            found.setdefault((one.hand, one.object), []).append(one)
        return [Contacts.stacked(rows, hand=hand, object=name) for (hand, name), rows in found.items()]

    def gestures(self) -> list[Gesture]:
        return list(self._read("gesture", Gesture))

    def detections(self) -> dict[str, list[Detections]]:
        """What the master took, in the order of time."""
        found: dict[str, list[Detections]] = {}
        for one in (*self._read("taken", MarkerDetections), *self._read("taken", WristDetections)):
            found.setdefault(one.camera, []).append(one)
        return {camera: sorted(frames, key=lambda one: one.t_ns) for camera, frames in found.items()}

    @property
    def rigs(self) -> tuple[str, ...]:
        return recorded_rigs(self._recording)

    @contextmanager
    def tree(self, given: Path) -> Generator[Path]:
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


# what was recorded of one or more hands
Take: TypeAlias = _RunTake | _MessageTake


def open_take(path: Path, window: Window) -> Take:
    """Open an .mcap recording of messages, or the poses.npz of a run; RecordingError."""
    if path.is_dir():
        raise RecordingError(f"{path}: is a folder; give the poses.npz of a run, or an .mcap recording")
    if not path.exists():
        raise RecordingError(f"{path}: no such file; give the poses.npz of a run, or an .mcap recording")
    return _MessageTake(path, window) if path.suffix == ".mcap" else _RunTake(path, window)
