"""The same line offline: detections of every camera and a recording's calibration -> poses, scores, summary.

No clock is read for the poses: messages are pushed in the order of their capture times, so two runs write the
same bytes. Only the stage times of the summary are measured.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from common.errors import RecordingError
from common.frame_recording import FrameRecording
from common.messages import HandPose, MarkerDetections
from common.npz import read_npz
from master.outputs.files import PosesFile
from master.outputs.poses import Poses
from master.rig import RigSetup, build_pipeline
from master.score import load_truth, score
from master.stages import StageTimes
from master.summary import write_summary


def solve(
    recording: FrameRecording,
    setup: RigSetup,
    detections: Path,
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, object]:
    """Solve a marker recording and write poses.npz and summary.json into `out`.

    Args:
        recording: The raw frames' manifest; gives `continuous`, clicks and, where there is one, the truth.
        setup: Rig, cameras and hand.
        detections: Folder with detections_<camera>.npz of every camera of the rig.
        out: Existing folder for the results.
        progress: Told how many of how many messages are done.

    Returns:
        The summary.

    Raises:
        RecordingError: A detections file is missing or broken, or the results cannot be written.
        CalibrationError: The depth model does not fit the rig.
    """
    stages = StageTimes()
    pipeline = build_pipeline(setup, stages, continuous=recording.manifest.continuous)
    messages = _messages(setup, detections)
    poses: list[HandPose] = []
    sink = PosesFile(out / "poses.npz", setup.hand.profile.name, len(setup.rig.markers))
    for number, message in enumerate(messages, 1):
        poses += [solved.pose for solved in pipeline.push(message)]
        progress(number, len(messages))
    poses += [solved.pose for solved in pipeline.flush()]
    for pose in poses:
        sink.write(pose)
    sink.close()
    summary = summarise(recording, setup, poses) | {
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
    mounts = [setup.hand.mount(name) for name in setup.rig.markers]
    return tuple(-1 if mount.finger is None else mount.finger for mount in mounts)


def _messages(setup: RigSetup, folder: Path) -> list[MarkerDetections]:
    """All cameras' detections in the order of their capture times; ties in the rig's order of cameras."""
    count = len(setup.rig.markers)
    messages = [message for camera in setup.rig.cameras for message in _of_camera(folder, camera, count)]
    order = {camera: index for index, camera in enumerate(setup.rig.cameras)}
    return sorted(messages, key=lambda message: (message.t_ns, order[message.camera]))


def _gaps(messages: list[MarkerDetections]) -> int:
    """Frame numbers that a camera skipped: frames lost before they were recorded."""
    seen: dict[str, set[int]] = {}
    for message in messages:
        seen.setdefault(message.camera, set()).add(message.seq)
    return sum(max(numbers) - min(numbers) + 1 - len(numbers) for numbers in seen.values())


def _of_camera(folder: Path, camera: str, count: int) -> Iterator[MarkerDetections]:
    path = folder / f"detections_{camera}.npz"
    fix = f"run `phalanx-slave detect` for camera {camera!r} first"
    data = read_npz(path, ("t_ns", "seq", "uv", "area_px2", "quality"), fix)
    try:
        t_ns, seq = (data[name].astype(np.int64, casting="same_kind") for name in ("t_ns", "seq"))
        uv, area, quality = (data[name].astype(np.float64) for name in ("uv", "area_px2", "quality"))
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: {error}: {fix}") from error
    if t_ns.ndim != 1 or seq.shape != t_ns.shape:
        raise RecordingError(
            f"{path}: t_ns and seq have shapes {t_ns.shape} and {seq.shape}, expected one (T,)"
        )
    if uv.shape != (len(t_ns), count, 2) or area.shape != uv.shape[:2] or quality.shape != uv.shape[:2]:
        raise RecordingError(f"{path}: uv has shape {uv.shape}, the rig needs ({len(t_ns)}, {count}, 2)")
    for row in range(len(t_ns)):
        yield MarkerDetections(
            camera=camera,
            session=0,
            seq=int(seq[row]),
            t_ns=int(t_ns[row]),
            ready_t_ns=int(t_ns[row]),
            uv=uv[row],
            area=area[row],
            quality=quality[row],
        )
