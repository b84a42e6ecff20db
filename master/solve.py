"""The same line offline: detections of every camera and a recording's calibration -> poses, scores, summary.

No clock is read for the poses: messages are pushed in the order of their capture times, so two runs write the
same bytes. Only the stage times of the summary are measured.
"""

import heapq
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from common.calibration import RigCalibration
from common.errors import CalibrationError, RecordingError
from common.frame_recording import MANIFEST, FrameRecording, Manifest
from common.messages import Detections, HandPose, ImuSample, WristDetections
from master.outputs.files import PosesFile, path_of_hand
from master.outputs.poses import Poses
from master.rates import CameraRates
from master.recorded import recorded_detections, recorded_triples
from master.recorded_imu import recorded_samples
from master.rig import RigSetup, pipeline_of
from master.score import load_truth, score, score_hidden
from master.sequence import TRIPLE
from master.sequence import Sequence as FrameSequence
from master.stages import StageTimes
from master.summary import write_summary
from master.wrist_score import load_wrist_truth, score_tips, score_triples, score_wrist, triples_missed


def rigs_to_solve(
    manifest: Manifest,
    names: Sequence[str],
    only: Literal["markers", "wrist"] | None = None,
    level: Literal["fk", "ik", "auto"] | None = None,
) -> list[RigCalibration]:
    """The rigs of a recording that are solved, those of markers first.

    Args:
        manifest: Of the recording.
        names: Rigs that are wanted; none: all.
        only: Of one kind alone.
        level: Of the wrist rigs in place of their own.

    Raises:
        RecordingError: It has no such rig.
        CalibrationError: A level for rigs of which none is of a wrist device.
    """
    wanted = [manifest.rig_named(name) for name in names] or list(manifest.all_rigs)
    rigs = [rig for rig in wanted if only in (None, rig.kind)]
    if not rigs:
        known = ", ".join(f"{rig.name} of {rig.kind}" for rig in wanted) or "none"
        raise RecordingError(
            f"{MANIFEST}: no rig to solve{f' of kind {only!r}' if only else ''}; it has {known}"
        )
    if level is None:
        return rigs
    if all(rig.kind != "wrist" for rig in rigs):
        raise CalibrationError(f"--level: rig {rigs[0].name!r} is of markers; a wrist device has levels")
    return [msgspec.structs.replace(rig, level=level) if rig.kind == "wrist" else rig for rig in rigs]


def solve_hands(
    recording: FrameRecording,
    setups: Sequence[RigSetup],
    detections: Path,
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, object]:
    """Solve every hand of a recording, as `solve`; poses and summary of the others are named poses-HAND.npz and
    summary-HAND.json. The summary of the first.
    """
    first = solve(recording, setups[0], detections, out, progress)
    for setup in setups[1:]:
        solve(recording, setup, detections, out, progress, beside=True)
    return first


def solve(
    recording: FrameRecording,
    setup: RigSetup,
    detections: Path,
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    beside: bool = False,
) -> dict[str, object]:
    """Solve one hand of a recording and write poses.npz and summary.json into `out`.

    Args:
        recording: The raw frames' manifest; gives `continuous`, clicks and, where there are, the IMU and the truth.
        setup: Rigs, cameras and hand: of markers, of a wrist device, or of both.
        detections: Folder with detections_<camera>.npz of every camera of the setup.
        out: Existing folder for the results.
        progress: Told how many of how many messages are done.
        beside: The hand is another than the first: the results carry its name.

    Returns:
        The summary.

    Raises:
        RecordingError: A detections file is missing or broken, imu.csv is, or the results cannot be written.
        CalibrationError: The depth model does not fit the rig.
    """
    stages = StageTimes()
    samples, setup = recorded_samples(recording, setup)
    pipeline = pipeline_of(setup, stages, continuous=recording.manifest.continuous)
    messages = _messages(recording, setup, detections)
    poses: list[HandPose] = []
    rates = CameraRates()
    hand = setup.hand.profile.name
    file, figures = out / "poses.npz", out / "summary.json"
    if beside:
        file, figures = path_of_hand(file, hand), path_of_hand(figures, hand)
    sink = PosesFile(file, hand, len(setup.markers))
    done = 0
    for message in heapq.merge(samples, messages, key=lambda message: message.t_ns):
        if isinstance(message, ImuSample):
            pipeline.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
            continue
        poses += [solved.pose for solved in pipeline.push(setup.own(message))]
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
    write_summary(figures, summary)
    return summary


def _summarise(
    recording: FrameRecording, setup: RigSetup, messages: Sequence[Detections], poses: list[HandPose]
) -> dict[str, object]:
    """Counts, and scores where the recording carries the truth of this hand."""
    seen = sum(bool(pose.valid.any()) for pose in poses)
    summary: dict[str, object] = {"poses": len(poses), "poses_valid": seen}
    if not poses or setup.rig.hand != recording.manifest.rig_named(None).hand:
        return summary
    stacked = Poses.of(poses)
    if setup.has_markers:
        summary |= _score_markers(recording, setup, stacked)
    return summary | _score_worn(recording, setup, messages, stacked)


def _score_markers(recording: FrameRecording, setup: RigSetup, poses: Poses) -> dict[str, float]:
    """Of a hand with markers; of a recording of both kinds also where cameras lose what a wrist device sees."""
    found = np.isfinite(poses.markers_raw_m).all(axis=2).sum(axis=0)
    truth = load_truth(recording.folder, found == found.max())
    if truth is None:
        return {}
    scores = score(poses, truth, fingers_of(setup))
    if recording.manifest.kind == "both":
        scores |= score_hidden(poses, truth, fingers_of(setup))
    return scores


def _score_worn(
    recording: FrameRecording, setup: RigSetup, messages: Sequence[Detections], poses: Poses
) -> dict[str, float]:
    """Of what a wrist device saw; of a hand without markers also the hand made of that."""
    if setup.wrist is None:
        return {}
    exact = load_wrist_truth(recording, setup.wrist_cameras[0])
    if exact is None:
        return {}
    triples = [message for message in messages if isinstance(message, WristDetections)]
    if setup.has_markers:
        return score_triples(setup.wrist, triples, exact) | score_tips(triples, exact)
    missed = float(triples_missed(poses, exact))
    return {"triples_missed": missed} | score_wrist(poses, exact) | score_tips(triples, exact)


def fingers_of(setup: RigSetup) -> tuple[int, ...]:
    """For each marker of the rig the finger it sits on, or -1."""
    on_hand = {name: setup.hand.mount(name).finger for name in setup.hand_markers}
    fingers = [on_hand.get(name) for name in setup.markers]
    return tuple(-1 if finger is None else finger for finger in fingers)


def _messages(recording: FrameRecording, setup: RigSetup, folder: Path) -> list[Detections]:
    """All cameras' detections in the order of their capture times; ties in the order of the cameras."""
    shown = {name: len(rig.markers) for rig in recording.manifest.all_rigs for name in rig.cameras}
    messages: list[Detections] = []
    for camera in setup.camera_names:
        if camera in setup.wrist_cameras:
            messages += recorded_triples(folder, camera)
        else:
            messages += recorded_detections(folder, camera, shown.get(camera, len(setup.markers)))
    order = {camera: index for index, camera in enumerate(setup.camera_names)}
    return sorted(messages, key=lambda message: (message.t_ns, order[message.camera]))


def _lost(setup: RigSetup, messages: Sequence[Detections]) -> int:
    """Frames, or triples, that a camera skipped: lost before they were recorded, or none was made of them."""
    numbers = {name: FrameSequence(TRIPLE if name in setup.wrist_cameras else 1) for name in setup.cameras}
    for message in messages:
        numbers[message.camera].take(message.session, message.seq)
    return sum(sequence.counts.lost for sequence in numbers.values())
