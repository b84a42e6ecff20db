"""Reader of tags_<camera>.npz of a recording.

Tag detections written by `phalanx-slave run -o`; returned as messages of its frames.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from common.errors import RecordingError
from common.messages import TagDetections
from common.recording.npz import read_npz

_ARRAYS = ("t_ns", "seq", "ids", "uv", "sigma_px", "row")


def recorded_tags(folder: Path, camera: str) -> Iterator[TagDetections]:
    """The searched frames of tags_<camera>.npz.

    It holds of T frames `t_ns` and `seq` (T,), and of N tags, frame by frame, `ids` (N,), `uv` (N, 4, 2), `sigma_px`
    (N,) and `row` (N,), which of the frames each is of.

    Raises:
        RecordingError: The file is missing or broken.
    """
    path, fix = folder / f"tags_{camera}.npz", f"run `phalanx-slave run -o` for camera {camera!r} first"
    data = read_npz(path, _ARRAYS, fix)
    try:
        t_ns, seq, row, ids = (
            data[name].astype(np.int64, casting="same_kind") for name in ("t_ns", "seq", "row", "ids")
        )
        uv, sigma = (data[name].astype(np.float64) for name in ("uv", "sigma_px"))
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: {error}: {fix}") from error
    tags = len(ids) if ids.ndim == 1 else -1
    for name, array, shape in (
        ("t_ns", t_ns, (len(seq) if seq.ndim == 1 else -1,)),
        ("uv", uv, (tags, 4, 2)),
        ("sigma_px", sigma, (tags,)),
        ("row", row, (tags,)),
    ):
        if array.shape != shape:
            raise RecordingError(f"{path}: {name} has shape {array.shape}, expected {shape}: {fix}")
    if ((row < 0) | (row >= len(t_ns))).any() or ((ids < 0) | (ids > 65535)).any():
        raise RecordingError(f"{path}: row or ids: out of range: {fix}")
    for frame in range(len(t_ns)):
        own = np.flatnonzero(row == frame)
        own = own[np.argsort(ids[own], kind="stable")]
        try:
            yield TagDetections(
                camera=camera,
                session=0,
                seq=int(seq[frame]),
                t_ns=int(t_ns[frame]),
                ready_t_ns=int(t_ns[frame]),
                ids=ids[own].astype(np.uint16),
                uv=uv[own],
                sigma_px=sigma[own],
            )
        except ValueError as error:
            raise RecordingError(f"{path}: frame {frame}: {error}: {fix}") from error
