"""Where the bytes of a recording go: all of them at once, or an error."""

from typing import Protocol


class Disk(Protocol):
    """Where the bytes go: a file, or what a test puts in its place."""

    def write(self, data: bytes, /) -> int | None:
        """Write part of the data and return how much.

        OSError where that fails.
        """
        ...

    def close(self) -> None:
        """Give it back."""
        ...


class Output:
    """Where the library writes to.

    Every byte goes to the disk at once, and is counted.
    """

    def __init__(self, disk: Disk) -> None:
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
