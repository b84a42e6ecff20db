"""Folders that take long to make and are kept: each is made whole under another name, then renamed."""

import hashlib
import tempfile
from collections.abc import Callable
from pathlib import Path


def key_of(inputs: str) -> str:
    """A short name of what a folder is made of: other inputs, another folder."""
    return hashlib.sha256(inputs.encode()).hexdigest()[:12]


def made_once(place: Path, make: Callable[[Path], None]) -> Path:
    """Return the folder `place`; where it is absent, `make` fills an empty one, what it puts beside that goes."""
    if place.is_dir():
        return place
    place.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=place.parent, prefix=f"unfinished-{place.name}-") as unfinished:
        folder = Path(unfinished) / "made"
        folder.mkdir()
        make(folder)
        try:
            folder.rename(place)
        except OSError:
            if not place.is_dir():  # else another run was faster, and made the same
                raise
    return place
