"""What was observed: things, by whom, when, and how surely; live and recorded.

A recording is read by `recorded_motion`, a running master by `session.listening`; both come to one table.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float, Int
from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_rotation_vector, rotation_vector_to_matrix
from common.messages import HandPose, MarkerDetections
from common.recording.frame_recording import FrameRecording, open_recording
from master.calibrate.tree_files import load_marker_rig
from master.estimator.sensors import CameraArrays
from master.fabrik.caps import LensShift
from master.fabrik.depth import CalibrationResidual
from master.fabrik.intersection import triangulate
from master.fabrik.sync import FrameSync
from master.replay.recorded import recorded_detections


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """M things that one observer saw over T epochs.

    Attributes:
        names: (M,) what was seen: markers of a hand, beads of an object.
        by: Who saw it: a camera, or a rig.
        t_ns: (T,) when [ns], rising.
        value: (T, M, D) where: pixels of a camera (D = 2) [px], points of a rig (D = 3) [m]. NaN: not seen.
        cov: (T, M, D, D) how surely; NaN as the values.
    """

    names: tuple[str, ...]
    by: str
    t_ns: Int
    value: Float
    cov: Float

    @classmethod
    def of(
        cls, names: Sequence[str], by: str, t_ns: Sequence[int], value: Sequence[Float], cov: Sequence[Float]
    ) -> "Observations":
        """Order epochs by time, each once; what lacks a number is not seen."""
        times, first = np.unique(np.array(t_ns, np.int64), return_index=True)
        size = np.shape(value[0])[-1] if len(value) else 3
        at = np.array(value, np.float64).reshape(-1, len(names), size)[first]
        own = np.array(cov, np.float64).reshape(-1, len(names), size, size)[first]
        nan = np.where(np.isfinite(at.sum(axis=-1) + own.sum(axis=(-2, -1))), 0.0, np.nan)
        return cls(tuple(names), by, times, at + nan[..., None], own + nan[..., None, None])

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def t_s(self) -> Float:
        """(T,) since the first epoch [s]."""
        return np.multiply(self.t_ns - (self.t_ns[0] if len(self) else 0), 1e-9, dtype=np.float64)

    @property
    def known(self) -> Bool:
        """(T, M) which thing is seen when."""
        return np.isfinite(self.value[..., 0])

    def at(self, epochs: Int | Bool) -> "Observations":
        """The chosen epochs."""
        return Observations(self.names, self.by, self.t_ns[epochs], self.value[epochs], self.cov[epochs])


def thinned(rows: Int, most: int) -> Int:
    """At most so many of the rows (N,), evenly spread."""
    return (
        rows if len(rows) <= most else rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.int64))]
    )


GAP_S = 0.06  # between samples of a turn: farther apart, what was between them is not known


def between(samples_s: Float, t_s: Float) -> tuple[Int, Float, Bool]:
    """Sample after each time (T,), share (T, 1) of the way to it, if both are near."""
    after = np.clip(np.searchsorted(samples_s, t_s), 1, len(samples_s) - 1)
    span = samples_s[after] - samples_s[after - 1]
    share = (t_s - samples_s[after - 1]) / span
    return after, np.clip(share, 0.0, 1.0)[:, None], (share >= 0.0) & (share <= 1.0) & (span <= GAP_S)


def turned(R: Float, after: Int, share: Float) -> Float:
    """Rotations (T, 3, 3) on the arc between samples R (S, 3, 3), as of `between`."""
    before = R[after - 1]
    arc = matrix_to_rotation_vector(np.swapaxes(before, 1, 2) @ R[after])
    return before @ rotation_vector_to_matrix(share * arc)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedMotion:
    """Something that moved before the cameras of a rig, as it was recorded."""

    data: str  # name of the recording, for the provenance
    rig: RigCalibration
    cameras: Mapping[str, CameraCalibration]
    messages: Sequence[MarkerDetections]  # of all cameras, by their stamps, as they were recorded

    @property
    def models(self) -> dict[str, CameraModel]:
        """The camera models in the rig's order.

        Raises:
            CalibrationError: A camera has no intrinsics.
        """
        return {
            name: CameraModel.of(self.cameras[name], self.rig.camera_pose(name)) for name in self.rig.cameras
        }

    @property
    def rates_hz(self) -> dict[str, float]:
        """Nominal rates of the cameras."""
        return {name: self.cameras[name].frame_rate_hz for name in self.rig.cameras}


def recorded_motion(recording: Path, detections: Path, rig: str | None, calibration: Path) -> RecordedMotion:
    """Read a motion from a recording and its detections_<camera>.npz.

    Rig and cameras are the recording's own, or those of a calibration tree where `rig` names one.

    Raises:
        RecordingError: A file of it is missing or broken, or it has no marker rig.
        CalibrationError: Its frames are unrelated, it lacks a camera of the rig, or the rig has only one.
    """
    opened = open_recording(recording)
    used, cameras = _geometry(opened, rig, calibration)
    if not opened.manifest.continuous:
        raise CalibrationError(
            f"{recording}: its frames are unrelated poses (continuous is false): a motion is needed, recorded as one"
        )
    if len(used.cameras) < 2:
        raise CalibrationError(
            f"rig {used.name!r}: cameras: two or more are needed, it has {', '.join(used.cameras)}"
        )
    return RecordedMotion(recording.resolve().name, used, cameras, detections_of(used, detections))


def _geometry(
    recording: FrameRecording, rig: str | None, calibration: Path
) -> tuple[RigCalibration, dict[str, CameraCalibration]]:
    own = recording.manifest.cameras
    used = recording.manifest.marker_rig() if rig is None else load_marker_rig(calibration, rig)
    if missing := [name for name in used.cameras if name not in own]:
        raise CalibrationError(
            f"{recording.folder}: no camera {missing[0]!r}, which rig {used.name!r} has; it has {', '.join(own)}:"
            " record all cameras of the rig, or name the rig that was recorded with --rig"
        )
    if rig is None:
        return used, {name: own[name] for name in used.cameras}
    files = calibration / "cameras"
    return used, {name: load(files / f"{name}.json", CameraCalibration) for name in used.cameras}


def detections_of(rig: RigCalibration, detections: Path) -> list[MarkerDetections]:
    """Recorded detections of a rig's cameras, by their stamps.

    Raises:
        RecordingError: A detections file is missing or broken.
    """
    messages = [
        message for name in rig.cameras for message in recorded_detections(detections, name, len(rig.markers))
    ]
    return sorted(messages, key=lambda message: message.t_ns)


def rows_of(rig: RigCalibration, names: Sequence[str]) -> list[int]:
    """Rows of the beads of an object among the rig's markers.

    Raises:
        CalibrationError: The rig has no such marker, or it sits on the hand; the message names the remedy.
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


def points_of_detections(
    rig: RigCalibration,
    models: Mapping[str, CameraModel],
    rates_hz: Mapping[str, float],
    messages: Iterable[MarkerDetections],
    names: Sequence[str],
) -> Observations:
    """Bring the cameras to common epochs and triangulate beads there.

    What has a second place in a camera is rejected at that epoch: there is no pose yet that determines which is
    right. Models and nominal rates are by camera, in the rig's order; messages are of all cameras, by their stamps.

    Raises:
        CalibrationError: As `rows_of`.
    """
    rows, cameras = rows_of(rig, names), tuple(models.values())
    sync, shift = FrameSync(dict(models), dict(rates_hz), len(rig.markers)), LensShift(cameras)
    arrays, rays_px = CameraArrays.of(cameras), CalibrationResidual.of(rig).rays_px
    late_ns = {camera: round(1e3 * us) for camera, us in rig.stamp_offset_us.items()}
    moved = (replace(one, t_ns=one.t_ns + late_ns.get(one.camera, 0)) for one in messages)
    times, points, covs = list[int](), list[Float](), list[Float]()
    for frames in [frames for one in moved for frames in sync.push(one)] + sync.flush():
        uv = shift.centres(frames.uv, frames.area) if shift.any else frames.uv
        if frames.alt_uv is not None:
            uv = np.where(np.isfinite(frames.alt_uv[..., :1]), np.nan, uv)
        found = triangulate(arrays, uv[:, rows], frames.sigma_px[:, rows], rays_px)
        times.append(frames.t_ns)
        points.append(np.where(found.outliers[:, None], np.nan, found.points_m))
        covs.append(found.cov_m2)
    return Observations.of(names, rig.name, times, points, covs)


def points_of_poses(poses: Sequence[HandPose], rig: RigCalibration, names: Sequence[str]) -> Observations:
    """The same from the poses of a running master of this rig.

    Raises:
        CalibrationError: As `rows_of`; the master has another number of markers than the rig.
    """
    rows = rows_of(rig, names)
    for pose in poses:
        check_markers(pose, rig.markers)
    return Observations.of(
        names,
        rig.name,
        [pose.t_ns for pose in poses],
        [pose.markers_raw_m[rows] for pose in poses],
        [pose.markers_cov_m2[rows] for pose in poses],
    )


def check_markers(pose: HandPose, names: Sequence[str]) -> None:
    """Refuse poses of a master with other markers than the rig's.

    Raises:
        CalibrationError: As the name says.
    """
    if len(pose.markers_raw_m) != len(names):
        raise CalibrationError(
            f"the running master has {len(pose.markers_raw_m)} markers, the rig {len(names)}: name its rig with --rig"
        )
