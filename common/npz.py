"""Writes an .npz with the same bytes on every run, and reads one that may be missing, cut or none at all."""

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from common.arrays import Float
from common.errors import RecordingError
from common.replacing import replacing

_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip file can carry: equal content gives equal bytes


def write_npz(path: Path, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
    """Write the arrays uncompressed; memory stays constant, also for the columns of a mapped file.

    Raises:
        OSError: The folder is missing, read-only or full; no part of a file is left.
    """
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy", _EPOCH)
            with archive.open(info, "w", force_zip64=True) as member:
                npy.write_array(member, array, version=(1, 0), allow_pickle=False)


def read_npz(
    path: Path, names: Sequence[str] | None = None, fix: str = "", also: Sequence[str] = ()
) -> dict[str, Float]:
    """Arrays by name, as they are stored.

    Args:
        path: The file.
        names: Which must be there; None: all there are.
        fix: Said after the error: what the user can do.
        also: Which are read as well where they are there.

    Raises:
        RecordingError: Missing, broken, or without one of the names.
    """
    hint = f": {fix}" if fix else ""
    try:
        with np.load(path, allow_pickle=False) as file:
            for name in names or ():
                if name not in file.files:
                    raise RecordingError(f"{path}: key {name!r} is missing{hint}")
            found = [*names, *(name for name in also if name in file.files)] if names else file.files
            return {name: np.asarray(file[name]) for name in found}
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}{hint}") from error
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise RecordingError(f"{path}: not an .npz: {error}{hint}") from error
