"""A recording of messages is one MCAP file that any MCAP tool opens.

    header | metadata "phalanx" | a file of calibration per attachment | chunks of messages | index

There is a channel for each stream, sender and type, topic phalanx/STREAM/SENDER; a message is what `encode` makes of
it (msgpack), and the channel's schema states its fields. The log time is when a message came, on the master's clock;
the order in the file is that of writing. A chunk is closed at least every half second and given to the system at once:
what is lost with the process is that half second. A file without its end is read up to the cut. Names from a file
become names of files, so they are checked once, where a recording is opened or begun.
"""

import io
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import cast

import msgspec
from mcap.records import Channel
from mcap.writer import Writer

from common.calibration.files import PLAIN, is_plain
from common.errors import MessageError, RecordingError
from common.messages import WIRE_VERSION, AnyMessage, Message, decode, encode
from common.messages.parts import MAX_TIME_NS
from common.messages.schema import message_schema
from common.messages.sensed import Detections, ImuSample, TagDetections, TrackerPose
from common.messages.state import Backlog
from common.messages.streams import STREAMS, sender_of
from common.recording.mcap_file import BOUNDS, McapContent, messages_of, read_content


class Output:
    """What the library writes to: every byte goes to the disk at once."""

    def __init__(self, disk: io.FileIO) -> None:
        self._disk, self._written = disk, 0

    def write(self, data: bytes) -> int:
        """Write all of it, or raise OSError."""
        left = memoryview(data)
        while left:
            count = self._disk.write(bytes(left)) or 0
            left = left[count:]
            self._written += count
        return len(data)

    def tell(self) -> int:
        """How many bytes were written."""
        return self._written

    def flush(self) -> None:
        """Nothing waits here."""


def check_files(where: Path, files: Mapping[str, bytes]) -> None:
    """Refuse files of calibration that are not FOLDER/NAME.json, or too large.

    Raises:
        RecordingError: Naming recording and file.
    """
    for name, data in files.items():
        folder, slash, file = name.partition("/")
        if not (
            is_plain(folder) and slash and file.endswith(".json") and is_plain(file.removesuffix(".json"))
        ):
            raise RecordingError(f"{where}: its file {name!r}: must be FOLDER/NAME.json, each name {PLAIN}")
        if len(data) > BOUNDS.attachment_bytes:
            raise RecordingError(
                f"{where}: its file {name!r}: {len(data)} bytes, at most {BOUNDS.attachment_bytes}"
            )
    if len(files) > BOUNDS.attachments:
        raise RecordingError(f"{where}: {len(files)} files of calibration, at most {BOUNDS.attachments}")


def channel_names(where: Path, channels: Iterable[Channel]) -> dict[int, tuple[str, str]]:
    """Number of each channel of ours -> stream and sender, plain names."""
    found: dict[int, tuple[str, str]] = {}
    for one in channels:
        if not {"stream", "name"} <= one.metadata.keys():
            continue  # somebody else's
        found[one.id] = one.metadata["stream"], one.metadata["name"]
        for key, name in zip(("stream", "name"), found[one.id], strict=True):
            if not is_plain(name):
                raise RecordingError(f"{where}: channel {one.id}: {key}: {name[:80]!r}: must be {PLAIN}")
    return found


def plain_names(where: Path, key: str, text: str) -> tuple[str, ...]:
    """The plain names in a JSON list, `key` of the metadata, or RecordingError."""
    try:
        names = msgspec.json.decode(text, type=tuple[str, ...])
    except (msgspec.DecodeError, RecursionError) as error:
        raise RecordingError(f"{where}: metadata: {key}: must be a list of names: {error}") from error
    for name in names:
        if not is_plain(name):
            raise RecordingError(f"{where}: metadata: {key}: {name[:80]!r}: must be {PLAIN}")
    return names


def refuse_misplaced(stream: str, name: str, message: AnyMessage) -> None:
    """Refuse a message of another kind or sender than its channel's, or a bad time.

    Raises:
        RecordingError: The text states what, not where.
    """
    if not isinstance(message, _kinds(stream)) or sender_of(message) != name:
        raise RecordingError(
            f"{type(message).__name__} of {sender_of(message)!r} on the channel {stream} of {name!r}"
        )
    for key in _times(type(message)):
        if abs(getattr(message, key)) > MAX_TIME_NS:
            raise RecordingError(f"{key}: {getattr(message, key)}: must be -{MAX_TIME_NS} to {MAX_TIME_NS}")


@cache
def _kinds(stream: str) -> tuple[type[Message], ...]:
    """Types of the messages on a stream; any, where we do not know it."""
    if stream == "taken":
        return (*Detections.__args__, TagDetections, TrackerPose, ImuSample, Backlog)
    return (STREAMS[stream].message if stream in STREAMS else Message,)


@cache
def _times(kind: type[Message]) -> tuple[str, ...]:
    return tuple(one.name for one in msgspec.structs.fields(kind) if one.name.endswith("t_ns"))


PROFILE = "phalanx"


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """One message of a recording.

    Attributes:
        stream: A key of `common.messages.streams.STREAMS`.
        name: Its sender, or what it is about: a camera, a hand, a process.
        t_ns: When it came [ns], master's clock.
    """

    stream: str
    name: str
    t_ns: int
    message: AnyMessage


class MessageWriter:
    """Writer of one recording."""

    def __init__(
        self,
        path: Path,
        files: Mapping[str, bytes],
        about: Mapping[str, str] | None = None,
        open_disk: Callable[[Path], io.FileIO] = lambda path: io.FileIO(path, "xb"),
    ) -> None:
        """Begin a new file.

        Args:
            path: Must not exist.
            files: Files of calibration by their relative path, for example "rigs/desk.json".
            about: Metadata beside wire, program and start.
            open_disk: Makes the file.

        Raises:
            RecordingError: It is there already, or cannot be written; a file of calibration has no plain name.
        """
        check_files(path, files)
        try:
            self._disk = open_disk(path)
        except FileExistsError as error:
            raise RecordingError(
                f"{path}: is there already; nothing is recorded over something else"
            ) from error
        except OSError as error:
            raise RecordingError(f"{path}: cannot write: {error.strerror}") from error
        self._path, self._out = path, Output(self._disk)
        chunk_bytes = 512 << 10
        self._writer = Writer(cast(io.BufferedWriter, self._out), chunk_bytes)
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}
        self._chunk_ns: int | None = None
        self._number = 0
        self._ended = False
        started = datetime.now(UTC).isoformat(timespec="milliseconds")
        known = {"wire": str(WIRE_VERSION), "program": version("phalanx-hand"), "started": started}
        self._do(lambda: self._begin(known | dict(about or {}), files))

    @property
    def bytes_written(self) -> int:
        """What is on the disk so far."""
        return self._out.tell()

    def write(self, stream: str, message: Message, t_ns: int) -> None:
        """Append one message that came at `t_ns`.

        Raises:
            RecordingError: The disk is full or gone; what was written before stays readable, nothing more is written.
            ValueError: The file is closed.
        """
        if self._ended:
            raise ValueError(f"{self._path}: is closed")
        t_ns = max(t_ns, 0)
        if self._chunk_ns is None:
            self._chunk_ns = t_ns
        data = encode(message)
        self._do(lambda: self._add(stream, message, data, t_ns))
        chunk_ns = 500_000_000
        if not 0 <= t_ns - self._chunk_ns < chunk_ns:
            self.flush()

    def flush(self) -> None:
        """End the chunk in progress, and give all of it to the system; raises as `write`."""
        self._chunk_ns = None
        if not self._ended:
            self._do(self._writer.flush)

    def close(self) -> None:
        """Write the index and end the file; raises as `write`. Safe to call again."""
        if not self._ended:
            self._do(self._writer.finish)
            self._end()

    def _begin(self, about: dict[str, str], files: Mapping[str, bytes]) -> None:
        self._writer.start(PROFILE)
        self._writer.add_metadata(PROFILE, about)
        for name, data in files.items():
            self._writer.add_attachment(0, 0, name, "application/json", data)

    def _add(self, stream: str, message: Message, data: bytes, t_ns: int) -> None:
        key = stream, sender_of(message), type(message).__name__
        if key not in self._channels:
            self._channels[key] = self._channel(*key, type(message))
        captured = getattr(message, "t_ns", t_ns)
        self._number = self._number + 1 & 0xFFFFFFFF
        self._writer.add_message(self._channels[key], t_ns, data, max(captured, 0), self._number)

    def _channel(self, stream: str, name: str, kind: str, type_: type[Message]) -> int:
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(kind, "jsonschema", message_schema(type_))
        about = {"stream": stream, "name": name}
        return self._writer.register_channel(
            f"phalanx/{stream}/{name}", "msgpack", self._schemas[kind], about
        )

    def _do(self, step: Callable[[], object]) -> None:
        """Write something; on an OSError take a begun chunk back, raise RecordingError."""
        whole = self._out.tell()
        try:
            step()
        except OSError as error:
            with suppress(OSError):
                os.truncate(self._path, whole)
            self._end()
            raise RecordingError(
                f"{self._path}: cannot write any more: {error.strerror or error}; what was recorded before is readable"
            ) from error

    def _end(self) -> None:
        self._ended = True
        with suppress(OSError):
            self._disk.close()


class MessageRecording:
    """An opened recording.

    Attributes:
        files: Files of calibration by their relative path.
        about: Metadata from its writer: wire, program, started, and what else it gave.
        begin_t_ns, end_t_ns: First and last log time [ns]; both 0 where there is no message.
        counts: Stream -> messages.
        senders: Stream -> sender -> messages.
        cut: It has no end: it broke off, or its end is broken.
        losses: Chunks, attachments and messages that cannot be read, as far as they were met.
    """

    def __init__(self, path: Path, content: McapContent) -> None:
        """Of the content of a file; RecordingError if a name in it is not plain."""
        self.path, self.cut, self.losses = path, content.cut, content.losses
        self.files = {one.name: one.data for one in content.attachments}
        check_files(path, self.files)
        self.about = content.metadata.get(PROFILE, {})
        self._chunks = content.chunks
        self._named = channel_names(path, content.channels.values())
        self.begin_t_ns = min((one.first_ns for one in self._chunks), default=0)
        self.end_t_ns = max((one.last_ns for one in self._chunks), default=0)
        self.senders: dict[str, Counter[str]] = {}
        for number, count in content.counts.items():
            stream, name = self._named.get(number, ("", ""))
            self.senders.setdefault(stream, Counter())[name] += count
        self.counts = {stream: names.total() for stream, names in self.senders.items()}

    @property
    def broken(self) -> int:
        """How many losses there are."""
        return self.losses.count

    def read(
        self, streams: Collection[str] | None = None, from_t_ns: int | None = None, to_t_ns: int | None = None
    ) -> Iterator[Recorded]:
        """Messages from `from_t_ns` to `to_t_ns` [ns] in the order of writing; None: all.

        Raises:
            RecordingError: The file cannot be read any more.
        """
        first = self.begin_t_ns if from_t_ns is None else from_t_ns
        last = self.end_t_ns if to_t_ns is None else to_t_ns
        places = [one for one in self._chunks if one.last_ns >= first and one.first_ns <= last]
        for place, messages in messages_of(self.path, places, self.losses):
            for one in messages:
                stream, name = self._named.get(one.channel_id, ("", ""))
                if not first <= one.log_time <= last or (streams is not None and stream not in streams):
                    continue
                try:
                    message = decode(one.data)
                    refuse_misplaced(stream, name, message)
                except (MessageError, RecordingError) as error:
                    self.losses.add(f"message in the chunk at byte {place.offset}: {error}")
                    continue
                yield Recorded(stream, name, one.log_time, message)


def open_messages(path: Path) -> MessageRecording:
    """Open a recording, whole or cut.

    Raises:
        RecordingError: It cannot be read, is no recording of ours, or has a name that is not plain.
    """
    content = read_content(path)
    if content.profile != PROFILE:
        raise RecordingError(f"{path}: an MCAP file of profile {content.profile!r}, not a recording of ours")
    return MessageRecording(path, content)
