"""Reader loads detections, tags and IMU samples of a recording as messages.

`phalanx-slave run -o` writes detections_<camera>.npz and tags_<camera>.npz.
"""

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace as with_fields
from math import isfinite
from pathlib import Path
from typing import TypeVar

import numpy as np
from msgspec.structs import replace

from common.arrays import Float, Int
from common.calibration import ImuCalibration
from common.errors import RecordingError
from common.imu.csv_table import IMU, read_imu
from common.imu.fusion import OrientationFilter
from common.messages import FINGER_COUNT, ImuSample, MarkerDetections, TagDetections, WristDetections
from common.recording.frame_recording import FrameRecording
from common.recording.recorded_files import read_npz
from master.rig.setup import RigSetup
from master.run.sequence import CYCLE_FRAMES

DetectionsT = TypeVar("DetectionsT", MarkerDetections, WristDetections)
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
    columns = {"uv": uv, "area": area, "quality": quality, "sigma_px": sigma, "alt_uv": alternative}
    yield from _rows(MarkerDetections, path, fix, camera, t_ns, seq, columns)


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
    columns = {"laser_uv": laser, "tip_uv": tip, **each}
    yield from _rows(WristDetections, path, fix, camera, t_ns, seq, columns)


def _rows(
    message: Callable[..., DetectionsT],
    path: Path,
    fix: str,
    camera: str,
    t_ns: Int,
    seq: Int,
    columns: Mapping[str, Float],
) -> Iterator[DetectionsT]:
    """The message of each row of these columns."""
    for row, (time_ns, number) in enumerate(zip(t_ns.tolist(), seq.tolist(), strict=True)):
        values = {name: array[row] for name, array in columns.items()}
        try:
            yield message(camera=camera, session=0, seq=number, t_ns=time_ns, ready_t_ns=time_ns, **values)
        except ValueError as error:
            raise RecordingError(f"{path}: row {row}: {error}: {fix}") from error


def _file_of(folder: Path, camera: str) -> tuple[Path, str]:
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
    """Return sigmas (T, M) [px] of centroids from qualities (T, M) without any.

    A whole, clear marker is known to a tenth of a pixel; one of no quality, to as much as the part of a cap
    that may be hidden moves its centroid at half a metre. Without a quality the worst is assumed.
    """
    quality_loss = 1.0 - np.clip(np.nan_to_num(quality, nan=0.0), 0.0, 1.0)
    return np.where(np.isnan(uv[..., 0]), np.nan, _CLEAR_PX + _POOR_PX * quality_loss)


_UNPLACED = (
    "imu.q_palm_imu and imu.q_rig_world do not both state how the IMU is mounted and how its world lies to the rig; a "
    "wrist rig alone needs the former"
)
_LOG = logging.getLogger(__name__)


def recorded_samples(recording: FrameRecording, setup: RigSetup) -> tuple[tuple[ImuSample, ...], RigSetup]:
    """Return a recording's IMU samples with orientation, and their accuracy's setup.

    A recording without quaternions is of a sensor that measures only rates and forces: the filter of a live
    slave makes its orientation of them. The heading of that begins anywhere, whatever the rig's file states
    of it.

    Raises:
        RecordingError: imu.csv is broken.
    """
    imu = _imu_of(setup)
    if imu is None or not (imu.placed if setup.has_markers else imu.q_palm_imu is not None):
        others = imu is None and any(rig.imu is not None for rig in recording.manifest.all_rigs)
        if (path := recording.folder / IMU).exists() and not others:
            _LOG.warning("%s: not used: rig %r: %s", path, setup.rig.name, _UNPLACED)
        return (), setup
    samples = read_imu(recording.folder, imu.name)
    oriented = any(np.isfinite(one.orientation_wxyz).all() for one in samples)
    reckoned = not oriented or any(isfinite(one.heading_sigma_rad) for one in samples)
    if reckoned and samples and imu.heading_sigma_rad is not None:
        _LOG.warning(
            "%s: orientations of rates and forces: imu.heading_sigma_rad not used", recording.folder / IMU
        )
        setup = _with_imu(setup, replace(imu, heading_sigma_rad=None))
    if oriented:
        return samples, setup
    fusion = OrientationFilter(imu.rate_hz)
    return tuple(fusion.push(one) for one in samples), setup


def _imu_of(setup: RigSetup) -> ImuCalibration | None:
    """The hand's IMU: on the palm, or on the forearm."""
    if setup.rig.imu is not None or setup.wrist_rig is None:
        return setup.rig.imu
    return setup.wrist_rig.imu


def _with_imu(setup: RigSetup, imu: ImuCalibration) -> RigSetup:
    if setup.has_markers and setup.rig.imu is not None:
        return with_fields(setup, rig=replace(setup.rig, imu=imu))
    if setup.wrist is None or setup.wrist_rig is None:
        return setup
    wrist_rig = replace(setup.wrist_rig, imu=imu)
    rig = setup.rig if setup.has_markers else wrist_rig
    return with_fields(setup, rig=rig, wrist=with_fields(setup.wrist, imu=imu), wrist_rig=wrist_rig)


_ARRAYS = ("t_ns", "seq", "ids", "uv", "sigma_px", "row")


def recorded_tags(folder: Path, camera: str) -> Iterator[TagDetections]:
    """The searched frames of tags_<camera>.npz.

    It holds of T frames `t_ns` and `seq` (T,), and of N tags, frame by frame, `ids` (N,), `uv` (N, 4, 2),
    `sigma_px` (N,) and `row` (N,), which of the frames each is of.

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
