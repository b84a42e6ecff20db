"""A reader opens an MCAP file chunk by chunk, within bounds.

A file that was ended has a summary with a check sum behind its data: then nothing but that is read at the start. Any
other is walked record by record up to the first that is not whole, and its chunks are opened once to see what they
hold. A few bytes can claim any size, and zstd packs 4 MiB of zeros into 400 bytes: so each part is bounded, and so is
what one pass over a file unpacks, by the size of the file (a writer of ours leaves 16 bytes of index for each
message). Records are read by the `mcap` library from bytes that were cut out here, never from the file: a length that
lies reads nothing. What is broken or beyond a bound is counted with its cause, and the rest is read.
"""

import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Statistics,
)

from common.errors import RecordingError
from common.messages.parts import MAX_TIME_NS


class McapBounds(NamedTuple):
    """Most bytes and entries of each part of a recording."""

    # Unpacked: a writer closes a chunk with the message that takes it past its target. Ours is 512 KiB, that of the
    # tools for MCAP that cut and convert files up to 4 MiB; a message has less than 1 MiB.
    chunk_bytes: int = (4 << 20) + (1 << 20)
    channel_bytes: int = 4096
    channels: int = 1024
    attachment_bytes: int = 4 << 20  # of one file of calibration
    attached_bytes: int = 64 << 20  # of all
    attachments: int = 256
    metadata_bytes: int = 16 << 10  # of one; the names of 32 cameras and of their folders take 6 KiB
    metadata: int = 16
    summary_bytes: int = 64 << 20  # a day of chunks takes 26 MiB
    around_bytes: int = 1024  # of a record, beside its content; and all that a header may have


BOUNDS = McapBounds()
CHUNK_RECORDS = BOUNDS.chunk_bytes // 70  # 74,898: a message of ours takes 70 bytes or more

BEYOND = "more than a file of this size can hold"


class WorkBudget:
    """Bytes and records that one pass over a file may still read and unpack."""

    def __init__(self, file_bytes: int) -> None:
        """Of a file of that size."""
        free_bytes = 16 << 20  # that a pass may unpack of the smallest file
        ratio = 256  # unpacked bytes for each byte of the file; ours reach 100 where no marker is seen
        self._bytes = free_bytes + ratio * file_bytes
        index_bytes = 16  # of the file, for each message in it
        self._records = CHUNK_RECORDS + file_bytes // index_bytes

    def holds(self, records: int) -> bool:
        """Whether there may be so many records more."""
        return records <= self._records

    def take_records(self, count: int) -> None:
        """Use up so many records, or what is left."""
        self._records = max(self._records - count, 0)

    def take(self, size: int) -> None:
        """Use up so many bytes; RecordingError if there are not so many left."""
        if size > self._bytes:
            raise RecordingError(BEYOND)
        self._bytes -= size


@dataclass(slots=True)
class Losses:
    """What of a file cannot be read.

    Attributes:
        count: Chunks, attachments, metadata and messages, as far as they were met.
        named: The first five, with the cause; printable.
    """

    count: int = 0
    named: list[str] = field(default_factory=list[str])

    def add(self, what: str) -> None:
        """Count one."""
        self.count += 1
        named = 5
        if len(self.named) < named:
            text = what[:200]
            if not text.isprintable():
                text = "".join(one if one.isprintable() else f"\\x{ord(one):02x}" for one in text)
            self.named += [text] if text not in self.named else []


HEAD = struct.Struct("<BQ")  # of every record: what it is, and the length of what follows
BROKEN = (McapError, ValueError, struct.error, zstandard.ZstdError, MemoryError, OverflowError, RuntimeError)
_MESSAGE = struct.Struct("<HIQQ")


class ChunkMessage(NamedTuple):
    """A message as it stands in a chunk: its channel, its log time [ns], its bytes."""

    channel_id: int
    log_time: int
    data: bytes


@dataclass(frozen=True, slots=True)
class OpenedChunk:
    """What is in a chunk, in the order of writing.

    Attributes:
        channels: By their number, as bytes: a chunk repeats them, and only who wants them reads them.
    """

    channels: dict[int, bytes] = field(default_factory=dict[int, bytes])
    messages: list[ChunkMessage] = field(default_factory=list[ChunkMessage])


def stream(data: bytes) -> ReadDataStream:
    """Bytes as the library reads them."""
    return ReadDataStream(io.BytesIO(data))


def open_chunk(data: bytes, budget: WorkBudget) -> OpenedChunk:
    """Unpack the content of a chunk record.

    Raises:
        RecordingError: It is broken, or beyond a bound; the message states why, not where.
    """
    try:
        return _traversed(_unpacked(Chunk.read(stream(data)), budget), budget)
    except BROKEN as error:
        raise RecordingError(f"broken: {error or type(error).__name__}") from error


def _unpacked(chunk: Chunk, budget: WorkBudget) -> bytes:
    if chunk.compression not in ("", "zstd"):  # not ours; the library unpacks lz4 without any bound
        raise RecordingError(f"compression {chunk.compression[:16]!r}: must be zstd or none")
    packed, claimed = chunk.compression == "zstd", chunk.uncompressed_size
    size = zstandard.frame_content_size(chunk.data) if packed else len(chunk.data)
    if max(size, claimed) > BOUNDS.chunk_bytes:
        raise RecordingError(f"{max(size, claimed)} bytes unpacked, at most {BOUNDS.chunk_bytes}")
    # -1: the frame does not state it, as of a writer that packs while it writes
    if size not in (claimed, -1):
        raise RecordingError(f"claims {claimed} bytes unpacked, its data {size}")
    budget.take(claimed)
    content = zstandard.decompress(chunk.data, max_output_size=claimed) if packed and claimed else chunk.data
    if len(content) != claimed:
        raise RecordingError(f"claims {claimed} bytes unpacked, its data {len(content)}")
    if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise RecordingError("its check sum does not fit")
    return content


def _traversed(content: bytes, budget: WorkBudget) -> OpenedChunk:
    opened, at, count = OpenedChunk(), 0, 0
    try:
        while at < len(content):
            opcode, length = HEAD.unpack_from(content, at)
            at, count = at + HEAD.size, count + 1
            if length > len(content) - at:
                raise RecordingError("a record is longer than the chunk")
            if count > CHUNK_RECORDS or not budget.holds(count):
                raise RecordingError(
                    BEYOND if count <= CHUNK_RECORDS else f"more than {CHUNK_RECORDS} records"
                )
            if opcode == Opcode.MESSAGE:
                opened.messages.append(_message(content, at, length))
            elif opcode == Opcode.CHANNEL:
                number = int.from_bytes(content[at : at + min(length, 2)], "little")
                opened.channels.setdefault(number, content[at : at + length])
                if len(opened.channels) > BOUNDS.channels:
                    raise RecordingError(f"more than {BOUNDS.channels} channels")
            at += length
    finally:
        budget.take_records(count)  # also of a chunk that is refused: it was work
    return opened


def _message(content: bytes, at: int, length: int) -> ChunkMessage:
    if length < _MESSAGE.size:
        raise RecordingError("a message is cut")
    channel_id, _, log_time, _ = _MESSAGE.unpack_from(content, at)
    if log_time > MAX_TIME_NS:
        raise RecordingError(f"log time {log_time}: at most {MAX_TIME_NS}")
    return ChunkMessage(channel_id, log_time, content[at + _MESSAGE.size : at + length])


def read_channel(data: bytes) -> Channel:
    """Read the content of a channel record; RecordingError if too long or broken."""
    if len(data) > BOUNDS.channel_bytes:
        raise RecordingError(f"a channel of {len(data)} bytes, at most {BOUNDS.channel_bytes}")
    try:
        return Channel.read(stream(data))
    except BROKEN as error:
        raise RecordingError(f"broken: {error or type(error).__name__}") from error


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
        attachments, metadata: Those that are whole.
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
    """Messages of each chunk, in the order of writing; `losses` counts broken ones.

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
    first = next(_traverse(fd, len(MAGIC), size), None) if _read(fd, len(MAGIC), 0) == MAGIC else None
    header = _header(fd, first)
    if header is None:
        raise RecordingError(f"{path}: no recording of messages: it does not begin as an MCAP file")
    return _indexed(fd, size, header.profile) or _scanned(fd, size, header.profile)


def _traverse(fd: int, at: int, end: int) -> Iterator[_Place]:
    """Records from `at` on, up to the first that is none or ends beyond `end`."""
    while at + HEAD.size <= end:
        opcode, length = HEAD.unpack(_read(fd, HEAD.size, at))
        at += HEAD.size
        if length > end - at or opcode == 0:  # a hole in a file reads as zeros without end
            return
        yield opcode, at, length
        at += length


def _read(fd: int, length: int, at: int) -> bytes:
    os.lseek(fd, at, os.SEEK_SET)
    return os.read(fd, length)


def _bytes(fd: int, length: int, at: int) -> bytes:
    """Read `length` bytes from position `at`; empty outside the file."""
    return _read(fd, length, at) if 0 < length <= os.fstat(fd).st_size - at else b""


def _header(fd: int, place: _Place | None) -> Header | None:
    if place is None or place[0] != Opcode.HEADER or place[2] > BOUNDS.around_bytes:
        return None
    try:
        return Header.read(stream(_read(fd, place[2], place[1])))
    except BROKEN:
        return None


def _indexed(fd: int, size: int, profile: str) -> McapContent | None:
    """Content of a file by the summary at its end; None: missing, broken, too large."""
    tail = _read(fd, HEAD.size + _FOOTER.size + len(MAGIC), max(size - 37, 0))
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
    """Store one record of the summary; RecordingError or one of `BROKEN` if refused."""
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
    """Keep printable metadata: without check sum, any byte may be another one."""
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
