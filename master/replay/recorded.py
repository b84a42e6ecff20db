"""Reader loads detections, tags and IMU samples of a recording as messages.

`phalanx-slave run -o` writes detections_<camera>.npz and tags_<camera>.npz.
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace as with_fields
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
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
    path, row, pair = folder / f"detections_{camera}.npz", ("T", count), ("T", count, 2)
    needed = {"seq": ("T",), "t_ns": ("T",), "uv": pair, "area_px2": row, "quality": row}
    data = _read(path, camera, needed, {"sigma_px": row, "alt_uv": pair})
    typical = {
        "sigma_px": _sigma_of(data["uv"], data["quality"]),
        "alt_uv": np.full_like(data["uv"], np.nan),
        "area": data.pop("area_px2"),
    }
    yield from _rows(MarkerDetections, path, camera, typical | data)


def recorded_cycles(folder: Path, camera: str) -> Iterator[WristDetections]:
    """The rows of detections_<camera>.npz of the camera of a wrist device.

    Raises:
        RecordingError: The file is missing or broken.
    """
    path, row, pair = folder / f"detections_{camera}.npz", ("T", FINGER_COUNT), ("T", FINGER_COUNT, 2)
    each = dict.fromkeys(("laser_sigma_px", "laser_px", "tip_sigma_px", "tip_depth"), row)
    needed = {"t_ns": ("T",), "laser_uv": pair, "tip_uv": pair}
    data = _read(path, camera, needed, {"seq": ("T",), **each})
    unknown = np.full(data["laser_uv"].shape[:2], np.nan)
    laser_px, tip_px = 0.5, 3.0  # of a wrist device: some tenths of the line's width, and of a fingertip's
    typical = {
        "seq": CYCLE_FRAMES * np.arange(len(data["t_ns"])),
        "laser_sigma_px": _where_seen(data["laser_uv"], laser_px),
        "laser_px": unknown,
        "tip_sigma_px": _where_seen(data["tip_uv"], tip_px),
        "tip_depth": unknown,
    }
    yield from _rows(WristDetections, path, camera, typical | data)


_WHOLE = ("t_ns", "seq", "ids", "row")  # arrays of whole numbers


def _fix(camera: str) -> str:
    return f"run `phalanx-slave run -o` for camera {camera!r} first"


def _read(
    path: Path,
    camera: str,
    needed: Mapping[str, Sequence[int | str]],
    also: Mapping[str, Sequence[int | str]] = MappingProxyType({}),
) -> dict[str, Any]:
    """Arrays by name; a letter in a shape is one number throughout."""
    data, sizes = read_npz(path, list(needed), _fix(camera), also=also), dict[str, int]()
    for name, array in data.items():
        whole, shape = name in _WHOLE, (needed.get(name) or also[name])
        try:
            kind: Any = np.int64 if whole else np.float64
            data[name] = array.astype(kind, casting="same_kind" if whole else "unsafe")
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{path}: {name}: {error}: {_fix(camera)}") from error
        for letter, size in zip(shape, array.shape, strict=False):
            if isinstance(letter, str):
                sizes.setdefault(letter, size)
        expected = tuple(sizes.get(size, -1) if isinstance(size, str) else size for size in shape)
        if array.shape != expected:
            raise RecordingError(
                f"{path}: {name} has shape {array.shape}, expected {expected}: {_fix(camera)}"
            )
    return data


def _rows(
    message: Callable[..., DetectionsT], path: Path, camera: str, columns: Mapping[str, Any]
) -> Iterator[DetectionsT]:
    """The message of each row of these columns."""
    for row in range(len(columns["t_ns"])):
        values = {name: int(array[row]) if name in _WHOLE else array[row] for name, array in columns.items()}
        try:
            yield message(camera=camera, session=0, ready_t_ns=values["t_ns"], **values)
        except ValueError as error:
            raise RecordingError(f"{path}: row {row}: {error}: {_fix(camera)}") from error


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


def recorded_tags(folder: Path, camera: str) -> Iterator[TagDetections]:
    """The searched frames of tags_<camera>.npz.

    It holds of T frames `t_ns` and `seq` (T,), and of N tags, frame by frame, `ids` (N,), `uv` (N, 4, 2),
    `sigma_px` (N,) and `row` (N,), which of the frames each is of.

    Raises:
        RecordingError: The file is missing or broken.
    """
    path = folder / f"tags_{camera}.npz"
    needed = {
        "seq": ("T",),
        "t_ns": ("T",),
        "ids": ("N",),
        "uv": ("N", 4, 2),
        "sigma_px": ("N",),
        "row": ("N",),
    }
    data = _read(path, camera, needed)
    t_ns, ids, row = data["t_ns"], data["ids"], data["row"]
    if ((row < 0) | (row >= len(t_ns))).any() or ((ids < 0) | (ids > 65535)).any():
        raise RecordingError(f"{path}: row or ids: out of range: {_fix(camera)}")
    for frame in range(len(t_ns)):
        own = np.flatnonzero(row == frame)
        own = own[np.argsort(ids[own], kind="stable")]
        try:
            yield TagDetections(
                camera=camera,
                session=0,
                seq=int(data["seq"][frame]),
                t_ns=int(t_ns[frame]),
                ready_t_ns=int(t_ns[frame]),
                ids=ids[own].astype(np.uint16),
                uv=data["uv"][own],
                sigma_px=data["sigma_px"][own],
            )
        except ValueError as error:
            raise RecordingError(f"{path}: frame {frame}: {error}: {_fix(camera)}") from error
