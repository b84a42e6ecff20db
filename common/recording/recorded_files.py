"""Read files in a folder that somebody else made.

They are read within bounds, and none that is outside of the folder.
"""

import stat
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePath

from common.arrays import Float
from common.errors import RecordingError
from common.recording.npz import read_npz

TRUTH = "truth.npz"


def read_table(folder: Path, name: str) -> str:
    """The text of a table in a folder.

    Raises:
        FileNotFoundError: There is none.
        RecordingError: It cannot be read, leads out of the folder, is no plain file, too large, or no text.
    """
    path = folder / name
    refuse_links(folder, [name])
    try:
        about = path.stat()
        table_bytes = 256 << 20  # a row has some 45 bytes; three cameras at 90 Hz write 44 MB of them an hour
        if not stat.S_ISREG(about.st_mode) or about.st_size > table_bytes:
            raise RecordingError(f"{path}: must be a plain file of at most {table_bytes >> 20} MiB")
        return path.read_bytes().decode()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not a table of text: {error}") from error


def has_truth(folder: Path) -> bool:
    """Whether a folder has exact values.

    A link that leads nowhere counts, and is refused when it is read.
    """
    path = folder / TRUTH
    return path.is_symlink() or path.exists()


def read_truth(
    folder: Path, names: Sequence[str] = (), fix: str = "", also: Iterable[str] = ()
) -> dict[str, Float]:
    """The exact values of a rendered recording, by name.

    Args:
        folder: The recording.
        names: Which must be there.
        fix: Printed after the error: what the user can do.
        also: Which are read as well where they are there.

    Raises:
        RecordingError: It is missing, broken, too large, no plain file, leads out of the folder, or lacks a name.
    """
    refuse_links(folder, [TRUTH])
    truth_bytes = 256 << 20  # unpacked; a frame has some 3 kB: 20 minutes at 60 Hz
    return read_npz(folder / TRUTH, names, fix, also, most_bytes=truth_bytes)


def refuse_links(folder: Path, names: Iterable[str]) -> None:
    """Refuse files that links lead out of a folder, and pipes and devices.

    The links are symbolic; reading a pipe or a device has no end.

    Args:
        folder: Itself it may be a link.
        names: Relative paths without "..".

    Raises:
        RecordingError: One is; the text names it.
    """
    inside: dict[PurePath, bool] = {}
    try:
        root = folder.resolve()
        for name in names:
            path, parent = folder / name, PurePath(name).parent
            if parent not in inside:
                inside[parent] = (folder / parent).resolve().is_relative_to(root)
            mode = path.lstat().st_mode if path.exists() or path.is_symlink() else stat.S_IFREG
            if not inside[parent] or (stat.S_ISLNK(mode) and not path.resolve().is_relative_to(root)):
                raise RecordingError(f"{path}: leads to {path.resolve()}, outside the recording's folder")
            if not stat.S_ISREG(mode) and not path.is_file():
                raise RecordingError(f"{path}: must be a plain file")
    except (OSError, RuntimeError) as error:  # a link to itself
        raise RecordingError(f"{folder}: its links cannot be followed: {error}") from error
