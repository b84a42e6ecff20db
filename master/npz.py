"""Reads the arrays of an .npz that may be missing, cut or not an .npz at all."""

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.errors import RecordingError


def read_npz(path: Path, names: Sequence[str] | None = None, fix: str = "") -> dict[str, Float]:
    """Arrays by name, as they are stored.

    Args:
        path: The file.
        names: Which must be there; None: all there are.
        fix: Said after the error: what the user can do.

    Raises:
        RecordingError: Missing, broken, or without one of the names.
    """
    hint = f": {fix}" if fix else ""
    try:
        with np.load(path, allow_pickle=False) as file:
            for name in names or ():
                if name not in file.files:
                    raise RecordingError(f"{path}: key {name!r} is missing{hint}")
            return {name: np.asarray(file[name]) for name in names or file.files}
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror or error}{hint}") from error
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise RecordingError(f"{path}: not an .npz: {error}{hint}") from error
