"""Reader of the labelled points of a C3D file (c3d.org), by py-c3d."""

import struct
import warnings
from pathlib import Path
from typing import Any, cast

import c3d
import numpy as np

from common.errors import RecordingError
from master.mocap.bvh_file import PointTable, Unit

_UNITS: dict[str, Unit] = {"m": "m", "cm": "cm", "mm": "mm", "in": "in"}
_BROKEN = (
    OSError,
    ValueError,
    KeyError,
    IndexError,
    AssertionError,
    AttributeError,
    TypeError,
    struct.error,
    EOFError,
)


def read_c3d(path: Path) -> PointTable:
    """Read a file; a point whose residual is negative was not seen.

    Raises:
        RecordingError: It cannot be read, or has no labelled points.
    """
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns of files without analog channels
            reader = cast(Any, c3d).Reader(file)
            labels = [str(label).strip() for label in reader.point_labels]
            rate_hz = float(reader.point_rate)
            unit = str(reader.get("POINT:UNITS").string_value).strip().lower()
            frames = [np.asarray(points, np.float64)[:, :4] for _, points, _ in reader.read_frames()]
    except _BROKEN as error:
        raise RecordingError(f"{path}: cannot read as C3D: {error or type(error).__name__}") from error
    if not frames or not labels:
        raise RecordingError(f"{path}: has no frames, or no points with labels")
    points = np.stack(frames)[:, : len(labels)]
    if not rate_hz > 0.0:
        raise RecordingError(f"{path}: POINT:RATE is {rate_hz:g}: no frames a second")
    labels = labels[: points.shape[1]]
    named = [k for k, label in enumerate(labels) if label and labels.index(label) == k]
    position = np.where(points[..., 3:4] < 0.0, np.nan, points[..., :3])[:, named]
    t_s = np.arange(len(points)) / rate_hz
    return PointTable(tuple(labels[k] for k in named), t_s, position, _UNITS.get(unit))
