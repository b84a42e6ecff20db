"""Readers check the tables and .npz files of a foreign folder.

Nothing outside of the folder is read, and nothing without a bound. An .npz is a zip file of arrays, so a few bytes can
claim any size, twice: the zip's index states how large a member is unpacked, the member's header how large the array.
Both are compared, with each other and with a bound, before anything is unpacked. Equal arrays give equal files.
"""

import math
import stat
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from common.arrays import Float
from common.calibration.files import replacing
from common.errors import RecordingError

PACKED_BYTES = 256 << 20  # unpacked, of a file that is smaller itself: what a bomb may cost
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip file can carry: equal content gives equal bytes
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # of NumPy; others are unpacked without a bound
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_BROKEN = (  # what the zip file, the header of an array and its data can raise
    *(
        ArithmeticError,
        AttributeError,
        EOFError,
        LookupError,
        MemoryError,
        RuntimeError,
        SyntaxError,
        TypeError,
    ),
    *(ValueError, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)


def write_npz(path: Path, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
    """Write arrays uncompressed, in constant memory, also columns of a mapped file.

    Raises:
        OSError: The folder is missing, read-only or full; no part of a file is left.
    """
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy", _EPOCH)
            with archive.open(info, "w", force_zip64=True) as member:
                npy.write_array(member, array, version=(1, 0), allow_pickle=False)


def read_npz(
    path: Path,
    names: Sequence[str] | None = None,
    fix: str = "",
    also: Iterable[str] = (),
    *,
    most_bytes: int = 4 << 30,  # of a file of our own: six hours of poses
) -> dict[str, Float]:
    """Arrays by name, as they are stored.

    Args:
        path: The file.
        names: Which must be there; None: all there are.
        fix: Printed after the error: what the user can do.
        also: Which are read as well where they are there.
        most_bytes: What the arrays may have together, unpacked; a small file may have less.

    Raises:
        RecordingError: Missing, broken, no plain file, too large, or without one of the names.
    """
    hint = f": {fix}" if fix else ""
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):  # reading a pipe or a device has no end
            raise RecordingError(f"{path}: must be a plain file{hint}")
        with zipfile.ZipFile(path) as archive:
            members = {one.filename.removesuffix(".npy"): one for one in archive.infolist()}
            for name in names or ():
                if name not in members:
                    raise RecordingError(f"{path}: key {name!r} is missing{hint}")
            wanted = members if names is None else [*names, *(name for name in also if name in members)]
            most_bytes = min(most_bytes, max(PACKED_BYTES, about.st_size))
            if (size := sum(members[name].file_size for name in wanted)) > most_bytes:
                raise ValueError(f"{size} bytes unpacked, at most {most_bytes}")
            return {name: _array(archive, members[name]) for name in wanted}
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}{hint}") from error
    except _BROKEN as error:
        raise RecordingError(f"{path}: not an .npz: {error or type(error).__name__}{hint}") from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Float:
    """Array of a member; ValueError if its sizes differ or NumPy did not pack it."""
    name = member.filename[:80]
    if member.compress_type not in _METHODS:
        raise ValueError(f"{name!r}: must be stored or deflated")
    with archive.open(member) as file:
        if (read := _HEADERS.get(npy.read_magic(file))) is None:
            raise ValueError(f"{name!r}: must be of version 1.0 or 2.0 of the format")
        shape, _, dtype = read(file)
        # An element without any byte costs none, however many there are, until it is made a number.
        size = math.prod(shape) * max(dtype.itemsize, 1)
        if dtype.hasobject or min(shape, default=0) < 0 or size != member.file_size - file.tell():
            raise ValueError(f"{name!r}: its header says {str(dtype)[:80]} {shape}: its size does not fit")
    with archive.open(member) as file:
        return np.asarray(npy.read_array(file, allow_pickle=False))


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
    """Whether a folder has exact values; a link that leads nowhere counts."""
    path = folder / TRUTH
    return path.is_symlink() or path.exists()


def read_truth(
    folder: Path, names: Sequence[str] = (), fix: str = "", also: Iterable[str] = ()
) -> dict[str, Float]:
    """The exact values of a rendered recording, by name; otherwise as `read_npz`."""
    refuse_links(folder, [TRUTH])
    truth_bytes = 256 << 20  # unpacked; a frame has some 3 kB: 20 minutes at 60 Hz
    return read_npz(folder / TRUTH, names, fix, also, most_bytes=truth_bytes)


def refuse_links(folder: Path, names: Iterable[str]) -> None:
    """Refuse files that symbolic links lead out of a folder, and pipes and devices.

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
            if not stat.S_ISREG(mode) and not stat.S_ISREG(path.stat().st_mode):
                raise RecordingError(f"{path}: must be a plain file")
    except (OSError, RuntimeError) as error:  # a link to itself
        raise RecordingError(f"{folder}: its links cannot be followed: {error}") from error
