"""What is inside an MCAP file, whole or cut anywhere: its chunks, channels, attachments and metadata.

A file that was ended has a summary behind its data, with a check sum: then nothing but that is read at the start. Any
other is walked record by record up to the first that is not whole, and its chunks are opened once to see what they
hold. Bytes that were flipped cost the chunk or the attachment they are in, no other: each has a check sum. Records
are read by the `mcap` library from bytes that were cut out here, never from the file: a length that lies reads nothing.
"""

import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

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
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Statistics,
)
from mcap.stream_reader import breakup_chunk

from common.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
_MOST_BYTES = (
    64 << 20
)  # of a chunk in memory; ours have less than 2 MiB, and a broken length must not ask for more
_HEAD = struct.Struct("<BQ")  # of every record: what it is, and the length of what follows
_FOOTER = struct.Struct("<QQI")
_BROKEN = (McapError, ValueError, struct.error, zstandard.ZstdError, MemoryError, OverflowError, RuntimeError)
_Place: TypeAlias = tuple[int, int, int]  # opcode, offset of the content, its length


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """Where the content of a chunk stands, and the first and last log time in it [ns]."""

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
        cut: It has no end: it broke off, or its end is broken.
        broken: Chunks and attachments that cannot be read, as far as that is known.
    """

    profile: str
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    chunks: list[ChunkPlace] = field(default_factory=list[ChunkPlace])
    counts: Counter[int] = field(default_factory=Counter[int])
    attachments: list[Attachment] = field(default_factory=list[Attachment])
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    cut: bool = False
    broken: int = 0

    def add(self, record: Attachment | Metadata | None) -> None:
        """Keep an attachment or metadata; None: it was broken."""
        if isinstance(record, Attachment):
            self.attachments.append(record)
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        else:
            self.broken += 1


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


def messages_of(path: Path, chunks: list[ChunkPlace]) -> Iterator[tuple[ChunkPlace, list[Message] | None]]:
    """The messages of each chunk, in the order in which they were written; None: the chunk is broken.

    Raises:
        RecordingError: The file cannot be read any more.
    """
    try:
        with path.open("rb") as file:
            for place in chunks:
                records = _opened(_bytes(file.fileno(), place.length, place.offset))
                yield place, None if records is None else [r for r in records if isinstance(r, Message)]
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error


def _content(path: Path, fd: int, size: int) -> McapContent:
    first = next(_walk(fd, len(MAGIC), size), None) if os.pread(fd, len(MAGIC), 0) == MAGIC else None
    header = _header(fd, first)
    if header is None:
        raise RecordingError(f"{path}: no recording of messages: it does not begin as an MCAP file")
    return _indexed(fd, size, header.profile) or _scanned(fd, size, header.profile)


def _walk(fd: int, at: int, end: int) -> Iterator[_Place]:
    """The records from `at` on, up to the first that does not end before `end`."""
    while at + _HEAD.size <= end:
        opcode, length = _HEAD.unpack(os.pread(fd, _HEAD.size, at))
        at += _HEAD.size
        if length > end - at:
            return
        yield opcode, at, length
        at += length


def _bytes(fd: int, length: int, at: int) -> bytes:
    """So many bytes from there on; none where an index that lies points out of the file."""
    return os.pread(fd, length, at) if 0 < length <= os.fstat(fd).st_size - at else b""


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


def _header(fd: int, place: _Place | None) -> Header | None:
    if place is None or place[0] != Opcode.HEADER:
        return None
    try:
        return Header.read(_stream(os.pread(fd, place[2], place[1])))
    except _BROKEN:
        return None


def _indexed(fd: int, size: int, profile: str) -> McapContent | None:
    """By the summary at the end; None: there is none, or it is broken."""
    tail = os.pread(fd, _HEAD.size + _FOOTER.size + len(MAGIC), max(size - 37, 0))
    if len(tail) != 37 or tail[:1] != bytes([Opcode.FOOTER]) or tail[-len(MAGIC) :] != MAGIC:
        return None
    footer = Footer(*_FOOTER.unpack(tail[9:29]))
    summary = _bytes(fd, size - 37 - footer.summary_start, footer.summary_start)
    if not summary or zlib.crc32(tail[:25], zlib.crc32(summary)) != footer.summary_crc:
        return None
    content = McapContent(profile)
    try:
        for opcode, at, length in _walk(fd, footer.summary_start, size - 37):
            _take_summary(content, fd, opcode, _stream(_bytes(fd, length, at)))
    except _BROKEN:
        return None
    return content


def _take_summary(content: McapContent, fd: int, opcode: int, stream: ReadDataStream) -> None:
    if opcode == Opcode.CHANNEL:
        channel = Channel.read(stream)
        content.channels[channel.id] = channel
    elif opcode == Opcode.STATISTICS:
        content.counts.update(Statistics.read(stream).channel_message_counts)
    elif opcode == Opcode.CHUNK_INDEX:
        one = ChunkIndex.read(stream)
        place = one.chunk_start_offset + _HEAD.size, one.chunk_length - _HEAD.size
        content.chunks.append(ChunkPlace(*place, one.message_start_time, one.message_end_time))
    elif opcode == Opcode.ATTACHMENT_INDEX:
        kept = AttachmentIndex.read(stream)
        content.add(_attachment(_bytes(fd, kept.length - _HEAD.size, kept.offset + _HEAD.size)))
    elif opcode == Opcode.METADATA_INDEX:
        told = MetadataIndex.read(stream)
        content.add(_metadata(_bytes(fd, told.length - _HEAD.size, told.offset + _HEAD.size)))


def _scanned(fd: int, size: int, profile: str) -> McapContent:
    """Record by record, up to the first that is not whole."""
    content = McapContent(profile, cut=True)
    for opcode, at, length in _walk(fd, len(MAGIC), size):
        if opcode == Opcode.DATA_END:
            break
        if opcode == Opcode.ATTACHMENT:
            content.add(_attachment(os.pread(fd, length, at)))
        elif opcode == Opcode.METADATA:
            content.add(_metadata(os.pread(fd, length, at)))
        elif opcode == Opcode.CHUNK:
            _take_chunk(content, at, length, _opened(os.pread(fd, length, at)))
    return content


def _take_chunk(content: McapContent, at: int, length: int, records: list[McapRecord] | None) -> None:
    if records is None:
        content.broken += 1
        return
    for record in records:
        if isinstance(record, Channel):
            content.channels[record.id] = record
    messages = [record for record in records if isinstance(record, Message)]
    if messages:
        times = [one.log_time for one in messages]
        content.chunks.append(ChunkPlace(at, length, min(times), max(times)))
        content.counts.update(one.channel_id for one in messages)


def _attachment(data: bytes) -> Attachment | None:
    """An attachment whose check sum fits; the library does not look at it."""
    if len(data) < 4 or zlib.crc32(data[:-4]).to_bytes(4, "little") != data[-4:]:
        return None
    with suppress(*_BROKEN):
        return Attachment.read(_stream(data))
    return None


def _metadata(data: bytes) -> Metadata | None:
    with suppress(*_BROKEN):
        return Metadata.read(_stream(data))
    return None


def _opened(data: bytes) -> list[McapRecord] | None:
    """What is in a chunk, or None where any of it is broken."""
    try:
        chunk = Chunk.read(_stream(data))
        if chunk.compression not in ("", "zstd"):  # not ours; the library unpacks lz4 without any bound
            return None
        packed = chunk.compression == "zstd"
        asked = zstandard.frame_content_size(chunk.data) if packed else len(chunk.data)
        if max(asked, chunk.uncompressed_size) > _MOST_BYTES:
            return None
        return breakup_chunk(chunk, validate_crc=True)
    except _BROKEN:
        return None
