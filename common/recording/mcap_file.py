"""Contents of an MCAP file: its chunks, channels, attachments and metadata.

The file may be whole or cut anywhere.

A file that was ended has a summary behind its data, with a check sum: then nothing but that is read at the start. Any
other is walked record by record up to the first that is not whole, and its chunks are opened once to see what they
hold. Bytes that were flipped cost the chunk or the attachment they are in, no other: each has a check sum. Records
are read by the `mcap` library from bytes that were cut out here, never from the file: a length that lies reads nothing.
What is beyond a bound is a loss as what is broken is: it is counted with its cause, and the rest is read.
"""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Statistics,
)

from common.errors import RecordingError
from common.messages.parts import MAX_TIME_NS
from common.recording.mcap_bounds import BOUNDS, Losses, WorkBudget
from common.recording.mcap_chunk import (
    BROKEN,
    HEAD,
    ChunkMessage,
    OpenedChunk,
    open_chunk,
    read_channel,
    stream,
)

MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<QQI")
_Place: TypeAlias = tuple[int, int, int]  # opcode, offset of the content, its length


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """Position of a chunk's content, and its first and last log time [ns]."""

    offset: int
    length: int
    first_ns: int
    last_ns: int


@dataclass(slots=True)
class McapContent:
    """What a file holds.

    Attributes:
        profile: Who made it.
        channels: By their number.
        chunks: In the order of the file.
        counts: Number of a channel -> messages in it.
        attachments: Those that are whole.
        metadata: Those that are whole, by name.
        metadata_met: How many there are, also those that are not kept.
        cut: It has no end: it broke off, or its end is broken.
        losses: What cannot be read, as far as that is known.
    """

    profile: str
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    chunks: list[ChunkPlace] = field(default_factory=list[ChunkPlace])
    counts: Counter[int] = field(default_factory=Counter[int])
    attachments: list[Attachment] = field(default_factory=list[Attachment])
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    metadata_met: int = 0
    cut: bool = False
    losses: Losses = field(default_factory=Losses)

    def add_channel(self, number: int, data: bytes) -> None:
        """Keep a channel; one that is there already is not read again.

        Raises:
            RecordingError: It is too long or broken, or there are too many.
        """
        if number in self.channels:
            return
        if len(self.channels) >= BOUNDS.channels:
            raise RecordingError(f"more than {BOUNDS.channels} channels")
        self.channels[number] = read_channel(data)


def read_content(path: Path) -> McapContent:
    """See what is in a file.

    Raises:
        RecordingError: It cannot be read, or does not begin as an MCAP file.
    """
    try:
        with path.open("rb") as file:
            return _content(path, file.fileno(), os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error


def messages_of(
    path: Path, chunks: list[ChunkPlace], losses: Losses
) -> Iterator[tuple[ChunkPlace, list[ChunkMessage]]]:
    """The messages of each chunk, in the order in which they were written.

    `losses` counts what is broken.

    Raises:
        RecordingError: The file cannot be read any more.
    """
    try:
        with path.open("rb") as file:
            budget = WorkBudget(os.fstat(file.fileno()).st_size)
            for place in chunks:
                opened = _opened(file.fileno(), place.offset, place.length, budget, losses)
                if opened is not None:
                    yield place, opened.messages
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error


def _content(path: Path, fd: int, size: int) -> McapContent:
    first = next(_traverse(fd, len(MAGIC), size), None) if os.pread(fd, len(MAGIC), 0) == MAGIC else None
    header = _header(fd, first)
    if header is None:
        raise RecordingError(f"{path}: no recording of messages: it does not begin as an MCAP file")
    return _indexed(fd, size, header.profile) or _scanned(fd, size, header.profile)


def _traverse(fd: int, at: int, end: int) -> Iterator[_Place]:
    """The records from `at` on, as far as they are whole.

    The walk stops at the first that does not end before `end`, or that is none.
    """
    while at + HEAD.size <= end:
        opcode, length = HEAD.unpack(os.pread(fd, HEAD.size, at))
        at += HEAD.size
        if length > end - at or opcode == 0:  # a hole in a file reads as zeros without end
            return
        yield opcode, at, length
        at += length


def _bytes(fd: int, length: int, at: int) -> bytes:
    """Read `length` bytes from position `at`.

    Empty where a false index points outside the file.
    """
    return os.pread(fd, length, at) if 0 < length <= os.fstat(fd).st_size - at else b""


def _header(fd: int, place: _Place | None) -> Header | None:
    if place is None or place[0] != Opcode.HEADER or place[2] > BOUNDS.around_bytes:
        return None
    try:
        return Header.read(stream(os.pread(fd, place[2], place[1])))
    except BROKEN:
        return None


def _indexed(fd: int, size: int, profile: str) -> McapContent | None:
    """Content of a file by the summary at its end.

    None: there is no summary, or it is broken or holds what cannot be.
    """
    tail = os.pread(fd, HEAD.size + _FOOTER.size + len(MAGIC), max(size - 37, 0))
    if len(tail) != 37 or tail[:1] != bytes([Opcode.FOOTER]) or tail[-len(MAGIC) :] != MAGIC:
        return None
    footer = Footer(*_FOOTER.unpack(tail[9:29]))
    length = size - 37 - footer.summary_start
    summary = _bytes(fd, length, footer.summary_start) if length <= BOUNDS.summary_bytes else b""
    if not summary or zlib.crc32(tail[:25], zlib.crc32(summary)) != footer.summary_crc:
        return None
    content, budget = McapContent(profile), WorkBudget(size)
    try:
        for opcode, at, length in _traverse(fd, footer.summary_start, size - 37):
            begin = at - footer.summary_start
            _take_summary(content, fd, opcode, summary[begin : begin + length], budget)
    except (*BROKEN, RecordingError):
        return None
    return content if budget.holds(content.counts.total()) else None


def _take_summary(content: McapContent, fd: int, opcode: int, data: bytes, budget: WorkBudget) -> None:
    """Store the contents of one record of the summary.

    Raises:
        RecordingError: It is beyond a bound.
        McapError, ValueError, struct.error: It is broken.
    """
    if opcode == Opcode.CHANNEL:
        content.add_channel(int.from_bytes(data[:2], "little"), data)
    elif opcode == Opcode.STATISTICS:
        content.counts.update(Statistics.read(stream(data)).channel_message_counts)
    elif opcode == Opcode.CHUNK_INDEX:
        one = ChunkIndex.read(stream(data))
        if not one.message_start_time <= one.message_end_time <= MAX_TIME_NS:
            raise RecordingError("a time that cannot be")
        place = one.chunk_start_offset + HEAD.size, one.chunk_length - HEAD.size
        content.chunks.append(ChunkPlace(*place, one.message_start_time, one.message_end_time))
    elif opcode == Opcode.ATTACHMENT_INDEX:
        kept = AttachmentIndex.read(stream(data))
        _take_attachment(content, fd, kept.offset + HEAD.size, kept.length - HEAD.size, budget)
    elif opcode == Opcode.METADATA_INDEX:
        about = MetadataIndex.read(stream(data))
        _take_metadata(content, fd, about.offset + HEAD.size, about.length - HEAD.size, budget)


def _scanned(fd: int, size: int, profile: str) -> McapContent:
    """Record by record, up to the first that is not whole."""
    content, budget = McapContent(profile, cut=True), WorkBudget(size)
    for opcode, at, length in _traverse(fd, len(MAGIC), size):
        if opcode == Opcode.DATA_END:
            break
        if opcode == Opcode.ATTACHMENT:
            _take_attachment(content, fd, at, length, budget)
        elif opcode == Opcode.METADATA:
            _take_metadata(content, fd, at, length, budget)
        elif opcode == Opcode.CHUNK:
            _take_chunk(content, at, length, _opened(fd, at, length, budget, content.losses))
    return content


def _take_chunk(content: McapContent, at: int, length: int, opened: OpenedChunk | None) -> None:
    if opened is None:
        return
    try:
        for number, data in opened.channels.items():
            content.add_channel(number, data)
    except RecordingError as error:
        content.losses.add(f"chunk at byte {at}: {error}")
        return
    if opened.messages:
        times = [one.log_time for one in opened.messages]
        content.chunks.append(ChunkPlace(at, length, min(times), max(times)))
        content.counts.update(one.channel_id for one in opened.messages)


def _opened(fd: int, at: int, length: int, budget: WorkBudget, losses: Losses) -> OpenedChunk | None:
    """The chunk whose content stands there; None: it is lost."""
    try:
        if not 0 < length <= BOUNDS.chunk_bytes + BOUNDS.around_bytes:
            raise RecordingError(f"{length} bytes, at most {BOUNDS.chunk_bytes}")
        budget.take(length)
        return open_chunk(_bytes(fd, length, at), budget)
    except RecordingError as error:
        losses.add(f"chunk at byte {at}: {error}")
        return None


def _take_attachment(content: McapContent, fd: int, at: int, length: int, budget: WorkBudget) -> None:
    """Keep an attachment whose check sum fits; the library does not look at it."""
    try:
        if len(content.attachments) >= BOUNDS.attachments:
            raise RecordingError(f"there are {BOUNDS.attachments} already")
        attached = sum(len(one.data) for one in content.attachments)
        if length > min(BOUNDS.attachment_bytes, BOUNDS.attached_bytes - attached) + BOUNDS.around_bytes:
            raise RecordingError(
                f"{length} bytes, at most {BOUNDS.attachment_bytes}, and {BOUNDS.attached_bytes} of all"
            )
        budget.take(max(length, 0))
        data = _bytes(fd, length, at)
        if len(data) <= 4 or zlib.crc32(data[:-4]).to_bytes(4, "little") != data[-4:]:
            raise RecordingError("broken")
        content.attachments.append(Attachment.read(stream(data)))
    except (*BROKEN, RecordingError) as error:
        content.losses.add(f"attachment at byte {at}: {error}")


def _take_metadata(content: McapContent, fd: int, at: int, length: int, budget: WorkBudget) -> None:
    """Keep metadata that are printable.

    They have no check sum, so any byte of them may be another one.
    """
    try:
        content.metadata_met += 1  # not by their names: one may stand in the index many times
        if content.metadata_met > BOUNDS.metadata:
            raise RecordingError(f"there are {BOUNDS.metadata} already")
        if length > BOUNDS.metadata_bytes:
            raise RecordingError(f"{length} bytes, at most {BOUNDS.metadata_bytes}")
        budget.take(max(length, 0))
        one = Metadata.read(stream(_bytes(fd, length, at)))
        if not "".join([one.name, *one.metadata, *one.metadata.values()]).isprintable():
            raise RecordingError("not printable")
        content.metadata[one.name] = one.metadata
    except (*BROKEN, RecordingError) as error:
        content.losses.add(f"metadata at byte {at}: {error}")
