"""Positions of an object's beads over time, with covariances.

From what cameras found or a master published.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.calibration import RigCalibration
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.messages import HandPose, MarkerDetections
from master.estimator.cameras import CameraArrays
from master.fabrik.blob_bias import LensShift
from master.fabrik.depth import CalibrationResidual
from master.fabrik.intersection import triangulate
from master.fabrik.sync import FrameSet, FrameSync


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Beads of one object over time.

    Attributes:
        names: (B,) of the beads.
        t_s: (T,) rising [s], from the first.
        points_m: (T, B, 3) rig frame; NaN: not seen by two cameras.
        cov_m2: (T, B, 3, 3); NaN as the points.
    """

    names: tuple[str, ...]
    t_s: Float
    points_m: Float
    cov_m2: Float

    @property
    def known(self) -> Bool:
        """(T, B) which bead is known when."""
        return np.isfinite(self.points_m[..., 0])


def rows_of(rig: RigCalibration, names: Sequence[str]) -> list[int]:
    """Rows of the beads among the rig's markers.

    Raises:
        CalibrationError: The rig has no such marker, or it sits on the hand; the message states what to write.
    """
    listed = ", ".join(f'"{name}"' for name in names)
    for name in names:
        for key, there in (("markers", rig.markers), ("free_markers", rig.free_markers)):
            if name not in there:
                raise CalibrationError(
                    f"rig {rig.name!r}: {key}: {name!r} is not among them. Beads of an object stand in markers and in"
                    f" free_markers: add {listed} to both, teach their colours (`phalanx-slave colours`), detect again"
                )
    return [rig.markers.index(name) for name in names]


def seen_by(
    rig: RigCalibration,
    models: Mapping[str, CameraModel],
    frame_rate_hz: Mapping[str, float],
    messages: Iterable[MarkerDetections],
    names: Sequence[str],
) -> Seen:
    """Bring the cameras to common epochs and triangulate the beads there.

    What has a second place in a camera is rejected at that epoch: there is no pose yet that determines which is right.

    Args:
        rig: Whose markers these are.
        models: Camera -> model, in the rig's order.
        frame_rate_hz: Camera -> nominal rate.
        messages: Of all cameras, by their stamps.
        names: Of the beads.

    Raises:
        CalibrationError: As `rows_of`.
    """
    rows = rows_of(rig, names)
    cameras = tuple(models.values())
    sync, shift = FrameSync(dict(models), dict(frame_rate_hz), len(rig.markers)), LensShift(cameras)
    arrays, rays_px = CameraArrays.of(cameras), CalibrationResidual.of(rig).rays_px
    late_ns = {camera: round(1e3 * us) for camera, us in rig.stamp_offset_us.items()}
    moved = (replace(one, t_ns=one.t_ns + late_ns.get(one.camera, 0)) for one in messages)
    sets = [frames for one in moved for frames in sync.push(one)] + sync.flush()
    times, points, covs = list[int](), list[Float](), list[Float]()
    for frames in sets:
        uv = shift.centres(frames.uv, frames.area) if shift.any else frames.uv
        uv, sigma = _clear(frames, uv)[:, rows], frames.sigma_px[:, rows]
        found = triangulate(arrays, uv, sigma, rays_px)
        times.append(frames.t_ns)
        points.append(np.where(found.outliers[:, None], np.nan, found.points_m))
        covs.append(found.cov_m2)
    return _seen(tuple(names), times, points, covs)


def seen_in(poses: Sequence[HandPose], rig: RigCalibration, names: Sequence[str]) -> Seen:
    """The same from the poses of a running master of this rig.

    Raises:
        CalibrationError: As `rows_of`; the master has another number of markers than the rig.
    """
    rows = rows_of(rig, names)
    for pose in poses:
        if len(pose.markers_raw_m) != len(rig.markers):
            raise CalibrationError(
                f"the running master has {len(pose.markers_raw_m)} markers, rig {rig.name!r} {len(rig.markers)}: name"
                " its rig with --rig"
            )
    ordered = sorted({pose.t_ns: pose for pose in poses}.items())
    return _seen(
        tuple(names),
        [t_ns for t_ns, _ in ordered],
        [pose.markers_raw_m[rows] for _, pose in ordered],
        [pose.markers_cov_m2[rows] for _, pose in ordered],
    )


def _clear(frames: FrameSet, uv: Float) -> Float:
    """Return the pixels (C, M, 2) without those that have an alternative."""
    if frames.alt_uv is None:
        return uv
    return np.where(np.isfinite(frames.alt_uv[..., :1]), np.nan, uv)


def _seen(names: tuple[str, ...], times: list[int], points: list[Float], covs: list[Float]) -> Seen:
    t_ns = np.array(times, np.int64)
    at = np.array(points, np.float64).reshape(-1, len(names), 3)
    cov = np.array(covs, np.float64).reshape(-1, len(names), 3, 3)
    nan = np.where(np.isfinite(at.sum(axis=-1) + cov.sum(axis=(-2, -1))), 0.0, np.nan)
    t_s = np.multiply(t_ns - (t_ns[0] if len(t_ns) else 0), 1e-9, dtype=np.float64)
    return Seen(names, t_s, at + nan[..., None], cov + nan[..., None, None])
