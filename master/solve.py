"""The same line offline: detections of every camera and a recording's calibration -> poses, scores, summary.

No clock is read for the poses: messages are pushed in the order of their capture times, so two runs write the
same bytes. Only the stage times of the summary are measured.
"""

import heapq
import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.errors import RecordingError
from common.frame_recording import FrameRecording
from common.imu_recording import IMU, read_imu
from common.messages import HandPose, ImuSample, MarkerDetections
from common.npz import read_npz
from master.outputs.files import PosesFile
from master.outputs.poses import Poses
from master.rates import CameraRates
from master.rig import RigSetup, build_pipeline
from master.score import load_truth, score
from master.stages import StageTimes
from master.summary import write_summary

_CLEAR_PX, _DOUBT_PX = (
    0.1,
    0.6,
)  # sigma of detections that state none: of full quality, and added where it is 0
_LOG = logging.getLogger(__name__)


def solve(
    recording: FrameRecording,
    setup: RigSetup,
    detections: Path,
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, object]:
    """Solve a marker recording and write poses.npz and summary.json into `out`.

    Args:
        recording: The raw frames' manifest; gives `continuous`, clicks and, where there are, the IMU and the truth.
        setup: Rig, cameras and hand.
        detections: Folder with detections_<camera>.npz of every camera of the rig.
        out: Existing folder for the results.
        progress: Told how many of how many messages are done.

    Returns:
        The summary.

    Raises:
        RecordingError: A detections file is missing or broken, imu.csv is, or the results cannot be written.
        CalibrationError: The depth model does not fit the rig.
    """
    stages = StageTimes()
    pipeline = build_pipeline(setup, stages, continuous=recording.manifest.continuous)
    messages = _messages(setup, detections)
    poses: list[HandPose] = []
    rates = CameraRates()
    sink = PosesFile(out / "poses.npz", setup.hand.profile.name, len(setup.rig.markers))
    done = 0
    for message in heapq.merge(_samples(recording, setup), messages, key=lambda message: message.t_ns):
        if isinstance(message, ImuSample):
            pipeline.push_orientation(message.t_ns, message.orientation_wxyz)
            continue
        poses += [solved.pose for solved in pipeline.push(message)]
        rates.push(message)
        progress(done := done + 1, len(messages))
    poses += [solved.pose for solved in pipeline.flush()]
    for pose in poses:
        sink.write(pose)
    sink.close()
    summary = summarise(recording, setup, poses) | {
        "camera_hz": rates.camera_hz,
        "lost": _gaps(messages),
        "counts": dict(sorted(pipeline.counts.items())),
        "stage_us": stages.mean_us(),
    }
    write_summary(out / "summary.json", summary)
    return summary


def summarise(recording: FrameRecording, setup: RigSetup, poses: list[HandPose]) -> dict[str, object]:
    """Counts, and scores where the recording carries its truth."""
    seen = sum(bool(pose.valid.any()) for pose in poses)
    summary: dict[str, object] = {"poses": len(poses), "poses_valid": seen}
    if not poses:
        return summary
    found = np.isfinite([pose.markers_raw_m for pose in poses]).all(axis=2).sum(axis=0)
    truth = load_truth(recording.folder, found == found.max())
    return summary if truth is None else summary | score(Poses.of(poses), truth, fingers_of(setup))


def fingers_of(setup: RigSetup) -> tuple[int, ...]:
    """For each marker of the rig the finger it sits on, or -1."""
    on_hand = {name: setup.hand.mount(name).finger for name in setup.hand_markers}
    fingers = [on_hand.get(name) for name in setup.rig.markers]
    return tuple(-1 if finger is None else finger for finger in fingers)


def _messages(setup: RigSetup, folder: Path) -> list[MarkerDetections]:
    """All cameras' detections in the order of their capture times; ties in the rig's order of cameras."""
    count = len(setup.rig.markers)
    messages = [
        message for camera in setup.rig.cameras for message in recorded_detections(folder, camera, count)
    ]
    order = {camera: index for index, camera in enumerate(setup.rig.cameras)}
    return sorted(messages, key=lambda message: (message.t_ns, order[message.camera]))


def _samples(recording: FrameRecording, setup: RigSetup) -> tuple[ImuSample, ...]:
    """What the recording's IMU measured; nothing, with a warning, where the rig does not say how that lies."""
    imu = setup.rig.imu
    if imu is not None and imu.placed:
        return read_imu(recording.folder, imu.name)
    if (path := recording.folder / IMU).exists():
        _LOG.warning(
            "%s: not used: rig %r: imu.q_palm_imu and imu.q_rig_world do not both say how the IMU is mounted and how "
            "its world lies to the rig",
            path,
            setup.rig.name,
        )
    return ()


def _gaps(messages: list[MarkerDetections]) -> int:
    """Frame numbers that a camera skipped: frames lost before they were recorded."""
    seen: dict[str, set[int]] = {}
    for message in messages:
        seen.setdefault(message.camera, set()).add(message.seq)
    return sum(max(numbers) - min(numbers) + 1 - len(numbers) for numbers in seen.values())


def recorded_detections(folder: Path, camera: str, count: int) -> Iterator[MarkerDetections]:
    """The rows of detections_<camera>.npz, which has `count` markers.

    Raises:
        RecordingError: The file is missing or broken, or has another number of markers.
    """
    path = folder / f"detections_{camera}.npz"
    fix = f"run `phalanx-slave detect` for camera {camera!r} first"
    data = read_npz(path, ("t_ns", "seq", "uv", "area_px2", "quality"), fix, also=("sigma_px", "rival_uv"))
    try:
        t_ns, seq = (data[name].astype(np.int64, casting="same_kind") for name in ("t_ns", "seq"))
        uv, area, quality = (data[name].astype(np.float64) for name in ("uv", "area_px2", "quality"))
        sigma = data["sigma_px"].astype(np.float64) if "sigma_px" in data else _sigma_of(uv, quality)
        rival = data["rival_uv"].astype(np.float64) if "rival_uv" in data else np.full_like(uv, np.nan)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: {error}: {fix}") from error
    if t_ns.ndim != 1 or seq.shape != t_ns.shape:
        raise RecordingError(
            f"{path}: t_ns and seq have shapes {t_ns.shape} and {seq.shape}, expected one (T,)"
        )
    if uv.shape != (len(t_ns), count, 2) or area.shape != uv.shape[:2] or quality.shape != uv.shape[:2]:
        raise RecordingError(f"{path}: uv has shape {uv.shape}, the rig needs ({len(t_ns)}, {count}, 2)")
    if sigma.shape != uv.shape[:2] or rival.shape != uv.shape:
        raise RecordingError(
            f"{path}: sigma_px and rival_uv have shapes {sigma.shape} and {rival.shape}, expected {uv.shape[:2]}"
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
                rival_uv=rival[row],
            )
        except ValueError as error:
            raise RecordingError(f"{path}: row {row}: {error}: {fix}") from error


def _sigma_of(uv: Float, quality: Float) -> Float:
    """Standard deviations (T, M) [px] of centroids whose file states none, from their quality (T, M).

    A whole, clear marker is known to a tenth of a pixel; one of no quality, to as much as the part of a cap that
    may be hidden moves its centroid at half a metre. Without a quality the worst is assumed.
    """
    doubt = 1.0 - np.clip(np.nan_to_num(quality, nan=0.0), 0.0, 1.0)
    return np.where(np.isnan(uv[..., 0]), np.nan, _CLEAR_PX + _DOUBT_PX * doubt)
