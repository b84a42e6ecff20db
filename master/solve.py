"""The same line offline: detections of every camera and a recording's calibration -> poses, scores, summary.

No clock is read for the poses: messages are pushed in the order of their capture times, so two runs write the
same bytes. Only the stage times of the summary are measured.
"""

import heapq
import logging
from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path

import msgspec
import numpy as np

from common.frame_recording import FrameRecording
from common.imu_fusion import OrientationFilter
from common.imu_recording import IMU, read_imu
from common.messages import Detections, HandPose, ImuSample, WristDetections
from master.outputs.files import PosesFile
from master.outputs.poses import Poses
from master.rates import CameraRates
from master.recorded import recorded_detections, recorded_triples
from master.rig import RigSetup, pipeline_of
from master.score import load_truth, score
from master.sequence import TRIPLE
from master.sequence import Sequence as FrameSequence
from master.stages import StageTimes
from master.summary import write_summary
from master.wrist_score import load_wrist_truth, score_tips, score_wrist, triples_missed

_UNPLACED = (
    "imu.q_palm_imu and imu.q_rig_world do not both say how the IMU is mounted and how its world lies to the rig; a "
    "wrist rig needs the former"
)
_LOG = logging.getLogger(__name__)


def solve(
    recording: FrameRecording,
    setup: RigSetup,
    detections: Path,
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, object]:
    """Solve a recording of a rig of either kind and write poses.npz and summary.json into `out`.

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
    samples, setup = _samples(recording, setup)
    pipeline = pipeline_of(setup, stages, continuous=recording.manifest.continuous)
    messages = _messages(setup, detections)
    poses: list[HandPose] = []
    rates = CameraRates()
    sink = PosesFile(out / "poses.npz", setup.hand.profile.name, len(setup.markers))
    done = 0
    for message in heapq.merge(samples, messages, key=lambda message: message.t_ns):
        if isinstance(message, ImuSample):
            pipeline.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
            continue
        poses += [solved.pose for solved in pipeline.push(message)]
        rates.push(message)
        progress(done := done + 1, len(messages))
    poses += [solved.pose for solved in pipeline.flush()]
    for pose in poses:
        sink.write(pose)
    sink.close()
    summary = _summarise(recording, setup, messages, poses) | {
        "camera_hz": rates.camera_hz,
        "lost": _lost(setup, messages),
        "counts": dict(sorted(pipeline.counts.items())),
        "stage_us": stages.mean_us(),
    }
    write_summary(out / "summary.json", summary)
    return summary


def _summarise(
    recording: FrameRecording, setup: RigSetup, messages: Sequence[Detections], poses: list[HandPose]
) -> dict[str, object]:
    """Counts, and scores where the recording carries its truth."""
    seen = sum(bool(pose.valid.any()) for pose in poses)
    summary: dict[str, object] = {"poses": len(poses), "poses_valid": seen}
    if not poses:
        return summary
    if setup.wrist is not None:
        exact = load_wrist_truth(recording, setup.rig.cameras[0])
        if exact is None:
            return summary
        triples = [message for message in messages if isinstance(message, WristDetections)]
        stacked = Poses.of(poses)
        summary["triples_missed"] = triples_missed(stacked, exact)
        return summary | score_wrist(stacked, exact) | score_tips(triples, exact)
    found = np.isfinite([pose.markers_raw_m for pose in poses]).all(axis=2).sum(axis=0)
    truth = load_truth(recording.folder, found == found.max())
    return summary if truth is None else summary | score(Poses.of(poses), truth, fingers_of(setup))


def fingers_of(setup: RigSetup) -> tuple[int, ...]:
    """For each marker of the rig the finger it sits on, or -1."""
    on_hand = {name: setup.hand.mount(name).finger for name in setup.hand_markers}
    fingers = [on_hand.get(name) for name in setup.markers]
    return tuple(-1 if finger is None else finger for finger in fingers)


def _messages(setup: RigSetup, folder: Path) -> list[Detections]:
    """All cameras' detections in the order of their capture times; ties in the rig's order of cameras."""
    messages: list[Detections] = []
    for camera in setup.rig.cameras:
        if camera in setup.wrist_cameras:
            messages += recorded_triples(folder, camera)
        else:
            messages += recorded_detections(folder, camera, len(setup.markers))
    order = {camera: index for index, camera in enumerate(setup.rig.cameras)}
    return sorted(messages, key=lambda message: (message.t_ns, order[message.camera]))


def _samples(recording: FrameRecording, setup: RigSetup) -> tuple[tuple[ImuSample, ...], RigSetup]:
    """What the recording's IMU measured, with its orientation, and the setup that knows what that is worth.

    A recording without quaternions is of a sensor that measures only rates and forces: the filter of a live slave makes
    its orientation of them. The heading of that begins anywhere, whatever the rig's file says of it.
    """
    imu = setup.rig.imu
    if imu is None or not (imu.placed if setup.wrist is None else imu.q_palm_imu is not None):
        if (path := recording.folder / IMU).exists():
            _LOG.warning("%s: not used: rig %r: %s", path, setup.rig.name, _UNPLACED)
        return (), setup
    samples = read_imu(recording.folder, imu.name)
    told = any(np.isfinite(one.orientation_wxyz).all() for one in samples)
    reckoned = not told or any(isfinite(one.heading_sigma_rad) for one in samples)
    if reckoned and samples and imu.heading_sigma_rad is not None:
        _LOG.warning(
            "%s: orientations of rates and forces: imu.heading_sigma_rad not used", recording.folder / IMU
        )
        rig = msgspec.structs.replace(setup.rig, imu=msgspec.structs.replace(imu, heading_sigma_rad=None))
        setup = RigSetup.of(rig, setup.cameras, setup.hand)
    if told:
        return samples, setup
    fusion = OrientationFilter(imu.rate_hz)
    return tuple(fusion.push(one) for one in samples), setup


def _lost(setup: RigSetup, messages: Sequence[Detections]) -> int:
    """Frames, or triples, that a camera skipped: lost before they were recorded, or none was made of them."""
    numbers = {name: FrameSequence(TRIPLE if name in setup.wrist_cameras else 1) for name in setup.cameras}
    for message in messages:
        numbers[message.camera].take(message.session, message.seq)
    return sum(sequence.counts.lost for sequence in numbers.values())
