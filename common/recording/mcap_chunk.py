"""One chunk of an MCAP file, opened within bounds.

Its sizes are checked before anything is unpacked.
"""

import io
import struct
import zlib
from dataclasses import dataclass, field
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk

from common.errors import RecordingError
from common.messages.parts import MAX_TIME_NS
from common.recording.mcap_bounds import BEYOND, BOUNDS, CHUNK_RECORDS, WorkBudget

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
        channels: By their number, as they stand there: a chunk repeats them, and only who wants them reads them.
        messages: All of them.
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
    if size not in (
        claimed,
        -1,
    ):  # -1: the frame does not state it, as of a writer that packs while it writes
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
    """Read the content of a channel record.

    Raises:
        RecordingError: It is too long or broken.
    """
    if len(data) > BOUNDS.channel_bytes:
        raise RecordingError(f"a channel of {len(data)} bytes, at most {BOUNDS.channel_bytes}")
    try:
        return Channel.read(stream(data))
    except BROKEN as error:
        raise RecordingError(f"broken: {error or type(error).__name__}") from error
