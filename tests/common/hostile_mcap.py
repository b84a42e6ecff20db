"""Writes MCAP files that no writer of ours would: any record, any size, an index that says what it likes."""

import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Statistics,
)

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
TINY = 31  # bytes of a message record without any data


def record(one: McapRecord) -> bytes:
    """The bytes of a record."""
    builder = RecordBuilder()
    one.write(builder)
    return builder.end()


def channel(number: int = 1, stream: str = "health", name: str = "master") -> Channel:
    """A channel of ours, or nearly."""
    return Channel(number, f"phalanx/{stream}/{name}", "msgpack", {"stream": stream, "name": name}, 0)


def message(data: bytes, log_time: int = 1_000_000_000, number: int = 1) -> Message:
    """A message of a channel."""
    return Message(number, log_time, data, min(log_time, 1_000_000_000), 0)


def chunk(
    content: bytes,
    first_ns: int = 1_000_000_000,
    last_ns: int = 1_000_000_000,
    *,
    compression: str = "zstd",
    size: int | None = None,
) -> Chunk:
    """A chunk of these bytes; `size`: what it says of its own size."""
    packed = zstandard.compress(content, 19) if compression == "zstd" else content
    output = len(content) if size is None else size
    return Chunk(compression, packed, last_ns, first_ns, zlib.crc32(content), output)


def streamed(content: bytes, size: int) -> Chunk:
    """A chunk whose frame does not say how large it is unpacked, as of writers that pack while they write."""
    packer = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    packed = packer.compress(content) + packer.flush()
    return Chunk("zstd", packed, 1_000_000_000, 1_000_000_000, zlib.crc32(content), size)


def wide_channel(keys: int, number: int = 1) -> Channel:
    """A channel of ours with so many keys more, each of a few bytes."""
    one = channel(number)
    one.metadata |= {f"{key:02x}": "" for key in range(keys)}
    return one


def tiny_messages(size: int) -> bytes:
    """So many bytes of messages without data, and their channel."""
    return record(channel()) + record(message(b"")) * (size // TINY)


@dataclass(slots=True)
class HostileMcap:
    """A file in the making. Holds its bytes and the records of its index."""

    data: bytearray = field(default_factory=lambda: bytearray(MAGIC + record(Header("phalanx", "hostile"))))
    index: bytearray = field(default_factory=bytearray)

    def about(self, values: Mapping[str, str]) -> "HostileMcap":
        """Add the metadata that says what the recording is of."""
        return self.note("phalanx", values)

    def note(self, name: str, values: Mapping[str, str], times: int = 1) -> "HostileMcap":
        """Add metadata of a name; as many rows about them as wanted stand in the index."""
        at, one = len(self.data), record(Metadata(name, dict(values)))
        self.data += one
        self.index += record(MetadataIndex(at, len(one), "")) * times
        return self

    def attach(self, name: str, content: bytes) -> "HostileMcap":
        """Add an attachment."""
        at, one = len(self.data), record(Attachment(0, 0, name, "application/json", content))
        self.data += one
        self.index += record(AttachmentIndex(at, len(one), 0, 0, len(content), name, "application/json"))
        return self

    def add(self, one: Chunk, channels: Iterable[Channel] = (), times: int = 1) -> "HostileMcap":
        """Add a chunk; its channels, and as many rows about it as wanted, stand in the index."""
        at, content = len(self.data), record(one)
        self.data += content
        self.index += b"".join(map(record, channels))
        row = ChunkIndex(
            len(content),
            at,
            one.compression,
            len(one.data),
            one.message_end_time,
            0,
            {},
            one.message_start_time,
            one.uncompressed_size,
        )
        self.index += record(row) * times
        return self

    def cut(self) -> bytes:
        """The file without its end: whoever reads it has to look at every record."""
        return bytes(self.data)

    def ended(self, counts: Mapping[int, int] | None = None) -> bytes:
        """The file with its index, whose check sum is right; `counts`: messages that it claims by channel."""
        data, index = self.data + record(DataEnd(0)), bytes(self.index)
        claimed = dict(counts or {})
        index += record(Statistics(0, 0, claimed, 0, sum(claimed.values()) & (2**64 - 1), 0, 0, 0, 0))
        footer = RECORD.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", len(data), 0)
        crc = zlib.crc32(footer, zlib.crc32(index))
        return bytes(data) + index + record(Footer(len(data), 0, crc)) + MAGIC
