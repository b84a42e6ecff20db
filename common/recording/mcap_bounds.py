"""Bounds of an MCAP file: what a recording of ours can hold.

What is beyond them is lost, and counted with its cause.

A few bytes can claim any size, and zstd packs 4 MiB of zeros into 400 bytes. So each part is bounded, and so is what
one pass over a file unpacks, by the size of the file: a writer of ours leaves 16 bytes of index for each message.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

from common.errors import RecordingError


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
    """What one pass over a file may still read and unpack.

    Holds the bytes and records that are left.
    """

    def __init__(self, file_bytes: int) -> None:
        """Of a file of that size."""
        free_bytes = 16 << 20  # that a pass may unpack of the smallest file
        # unpacked bytes for each byte of the file; ours reach 100 where nobody sees any of 48 markers
        ratio = 256
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
        """Use up so many bytes.

        Raises:
            RecordingError: There are not so many left.
        """
        if size > self._bytes:
            raise RecordingError(BEYOND)
        self._bytes -= size


@dataclass(slots=True)
class Losses:
    """What of a file cannot be read.

    Attributes:
        count: Chunks, attachments, metadata and messages, as far as they were met.
        named: The first few, with the cause; printable.
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
