"""Reader of detections_<camera>.npz of a recording.

Written by `phalanx-slave run -o`; returned as the messages of its rows.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.errors import RecordingError
from common.messages import FINGER_COUNT, MarkerDetections, WristDetections
from common.recording.npz import read_npz
from master.run.sequence import CYCLE_FRAMES

# Sigma of detections that state none: of full quality, and added where it is 0.
_CLEAR_PX, _POOR_PX = 0.1, 0.6


def recorded_detections(folder: Path, camera: str, count: int) -> Iterator[MarkerDetections]:
    """The rows of detections_<camera>.npz, which has `count` markers.

    Raises:
        RecordingError: The file is missing or broken, or has another number of markers.
    """
    path, fix = _file_of(folder, camera)
    data = read_npz(path, ("t_ns", "seq", "uv", "area_px2", "quality"), fix, also=("sigma_px", "alt_uv"))
    try:
        t_ns, seq = (data[name].astype(np.int64, casting="same_kind") for name in ("t_ns", "seq"))
        uv, area, quality = (data[name].astype(np.float64) for name in ("uv", "area_px2", "quality"))
        sigma = data["sigma_px"].astype(np.float64) if "sigma_px" in data else _sigma_of(uv, quality)
        alternative = data["alt_uv"].astype(np.float64) if "alt_uv" in data else np.full_like(uv, np.nan)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: {error}: {fix}") from error
    _check_times(path, t_ns, seq, fix)
    if uv.shape != (len(t_ns), count, 2) or area.shape != uv.shape[:2] or quality.shape != uv.shape[:2]:
        raise RecordingError(f"{path}: uv has shape {uv.shape}, the rig needs ({len(t_ns)}, {count}, 2)")
    if sigma.shape != uv.shape[:2] or alternative.shape != uv.shape:
        raise RecordingError(
            f"{path}: sigma_px and alt_uv have shapes {sigma.shape} and {alternative.shape}, expected {uv.shape[:2]}"
            f" and {uv.shape}: {fix}"
        )
    for row in range(len(t_ns)):
        try:
            yield MarkerDetections(
                camera=camera,
                session=0,
                seq=int(seq[row]),
                t_ns=int(t_ns[row]),
                ready_t_ns=int(t_ns[row]),
                uv=uv[row],
                area=area[row],
                quality=quality[row],
                sigma_px=sigma[row],
                alt_uv=alternative[row],
            )
        except ValueError as error:
            raise RecordingError(f"{path}: row {row}: {error}: {fix}") from error


def recorded_cycles(folder: Path, camera: str) -> Iterator[WristDetections]:
    """The rows of detections_<camera>.npz of the camera of a wrist device.

    Raises:
        RecordingError: The file is missing or broken.
    """
    path, fix = _file_of(folder, camera)
    also = ("seq", "laser_sigma_px", "laser_px", "tip_sigma_px", "tip_depth")
    data = read_npz(path, ("t_ns", "laser_uv", "tip_uv"), fix, also=also)
    try:
        t_ns = data["t_ns"].astype(np.int64, casting="same_kind")
        laser, tip = (data[name].astype(np.float64) for name in ("laser_uv", "tip_uv"))
        # of a wrist device: some tenths of the line's width, and of a fingertip's
        laser_px, tip_px = 0.5, 3.0
        typical = {
            "seq": CYCLE_FRAMES * np.arange(len(laser)),
            "laser_sigma_px": _where_seen(laser, laser_px),
            "laser_px": np.full(laser.shape[:2], np.nan),
            "tip_sigma_px": _where_seen(tip, tip_px),
            "tip_depth": np.full(tip.shape[:2], np.nan),
        }
        rest = {name: data[name] if name in data else typical[name] for name in also}
        seq = rest.pop("seq").astype(np.int64, casting="same_kind")
        each = {name: array.astype(np.float64) for name, array in rest.items()}
    except (TypeError, ValueError, IndexError) as error:
        raise RecordingError(f"{path}: {error}: {fix}") from error
    _check_times(path, t_ns, seq, fix)
    for name, array, shape in (
        ("laser_uv", laser, (len(t_ns), FINGER_COUNT, 2)),
        ("tip_uv", tip, (len(t_ns), FINGER_COUNT, 2)),
        *((name, array, (len(t_ns), FINGER_COUNT)) for name, array in each.items()),
    ):
        if array.shape != shape:
            raise RecordingError(f"{path}: {name} has shape {array.shape}, expected {shape}: {fix}")
    for row in range(len(t_ns)):
        try:
            yield WristDetections(
                camera=camera,
                session=0,
                seq=int(seq[row]),
                t_ns=int(t_ns[row]),
                ready_t_ns=int(t_ns[row]),
                laser_uv=laser[row],
                tip_uv=tip[row],
                **{name: array[row] for name, array in each.items()},
            )
        except ValueError as error:
            raise RecordingError(f"{path}: row {row}: {error}: {fix}") from error


def _file_of(folder: Path, camera: str) -> tuple[Path, str]:
    """The file, and what to do where it is missing or broken."""
    return folder / f"detections_{camera}.npz", f"run `phalanx-slave run -o` for camera {camera!r} first"


def _check_times(path: Path, t_ns: Int, seq: Int, fix: str) -> None:
    if t_ns.ndim != 1 or seq.shape != t_ns.shape:
        raise RecordingError(
            f"{path}: t_ns and seq have shapes {t_ns.shape} and {seq.shape}, expected one (T,): {fix}"
        )


def _where_seen(uv: Float, value: float) -> Float:
    """`value` (T, F) where uv (T, F, 2) is seen, NaN elsewhere."""
    return np.where(np.isnan(uv).any(axis=2), np.nan, value)


def _sigma_of(uv: Float, quality: Float) -> Float:
    """Return standard deviations (T, M) [px] of centroids from their quality.

    For centroids whose file states none; the quality is (T, M).

    A whole, clear marker is known to a tenth of a pixel; one of no quality, to as much as the part of a cap that
    may be hidden moves its centroid at half a metre. Without a quality the worst is assumed.
    """
    quality_loss = 1.0 - np.clip(np.nan_to_num(quality, nan=0.0), 0.0, 1.0)
    return np.where(np.isnan(uv[..., 0]), np.nan, _CLEAR_PX + _POOR_PX * quality_loss)
