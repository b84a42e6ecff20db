"""File change monitor: detects changes since the last check.

A check costs one `stat` per file.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class _Look:
    """A file as it was: time [ns], inode and size; digest of its content."""

    stat: tuple[int, int, int]
    digest: bytes


class MonitoredFiles:
    """Set of monitored files and their state at the last check.

    Empty before the first check.
    """

    def __init__(self) -> None:
        """Nothing was looked at yet."""
        self._seen: dict[Path, _Look | None] = {}

    def changed(self, paths: Iterable[Path]) -> bool:
        """Check whether file content is new, or a file has appeared or disappeared.

        Each change is reported once.

        The first look at a file reports a change: whoever read the file before may have read another content.
        """
        found = False
        for path in paths:
            before = self._seen.get(path)
            now = _look(path, before)
            known = path in self._seen
            self._seen[path] = now
            found |= not known or (now and now.digest) != (before and before.digest)
        return found


def _look(path: Path, before: _Look | None) -> _Look | None:
    try:
        status = path.stat()
        stat = (status.st_mtime_ns, status.st_ino, status.st_size)
        if before is not None and stat == before.stat:
            return before
        return _Look(stat, hashlib.sha256(path.read_bytes()).digest())
    except OSError:  # gone, or not to be read: whoever loads it reports why
        return None
