"""Atomic file replacement: a file is replaced whole or not at all.

A reader sees the old one or the new one, also after a power cut.
"""

import os
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
def replacing(path: Path) -> Generator[IO[bytes], None, None]:
    """Open a new file beside `path` that replaces it at the end of the block.

    It is deleted if the block fails.

    Raises:
        OSError: The folder is missing, read-only or full; the old file is untouched.
    """
    temporary = None
    try:
        # Beside it, because only within one file system is a replacement a single step.
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            temporary = Path(file.name)
            yield file
            file.flush()
            os.fsync(file.fileno())  # before the new name: a power cut must not leave an empty file under it
        temporary.chmod(0o644)  # it was made for its owner alone
        temporary.replace(path)
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
