"""Offline solver replays detection on frames, then solves the hands.

Slaves, as processes, detect in every camera's frames (and make a recording of videos or pictures before
that); then all messages are pushed through a `Dispatcher` and scored against the truth, where there is one.
No clock is read for the poses: messages are pushed in the order of their capture times, so two runs write the
same bytes. Only the stage times of the summary are measured.
"""

import heapq
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from common.calibration import RigCalibration
from common.errors import CalibrationError, RecordingError
from common.messages import (
    Contact,
    Detections,
    Gesture,
    HandPose,
    ImuSample,
    ObjectPose,
    ResultMessage,
    TagDetections,
    WristDetections,
)
from common.recording.frame_recording import MANIFEST, FrameRecording, Manifest, load_manifest, open_recording
from master.commands.summary import progress, write_summary
from master.evaluation.score import (
    load_object_truth,
    load_truth,
    score,
    score_hidden,
    score_object,
    score_objects,
)
from master.evaluation.wrist_score import (
    cycles_missed,
    load_wrist_truth,
    score_cycles,
    score_tips,
    score_wrist,
)
from master.monitor.rates import CameraRates
from master.outputs.poses import Poses, RunFiles, path_of_hand
from master.outputs.result_files import ObjectPoses
from master.replay.recorded import recorded_cycles, recorded_detections, recorded_samples, recorded_tags
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigSetup, setups_with_hands
from master.run.app import Solved, StageTimes
from master.run.dispatcher import Dispatcher
from master.run.sequence import CYCLE_FRAMES
from master.run.sequence import Sequence as FrameSequence


def rigs_to_solve(
    manifest: Manifest,
    names: Sequence[str],
    only: Literal["markers", "wrist"] | None = None,
    solver_mode: Literal["fk", "ik", "auto"] | None = None,
    solver: Literal["estimator", "fabrik"] | None = None,
) -> list[RigCalibration]:
    """The rigs of a recording that are solved, those of markers first.

    `names`: rigs that are wanted, none: all; `only` of one kind. `solver_mode` replaces that of wrist rigs,
    `solver` that of marker rigs.

    Raises:
        RecordingError: It has no such rig.
        CalibrationError: A solver mode where no rig is of a wrist device, a solver where none is of markers.
    """
    wanted = [manifest.rig_named(name) for name in names] or list(manifest.all_rigs)
    rigs = [rig for rig in wanted if only in (None, rig.kind)]
    if not rigs:
        known = ", ".join(f"{rig.name} of {rig.kind}" for rig in wanted) or "none"
        raise RecordingError(
            f"{MANIFEST}: no rig to solve{f' of kind {only!r}' if only else ''}; it has {known}"
        )
    for option, value, kind, why in (
        ("solver", solver, "markers", "of a wrist device; a rig of markers has solvers"),
        ("solver_mode", solver_mode, "wrist", "of markers; a wrist device has levels"),
    ):
        if value is None:
            continue
        if all(rig.kind != kind for rig in rigs):
            raise CalibrationError(f"--{option.replace('_', '-')}: rig {rigs[0].name!r} is {why}")
        rigs = [msgspec.structs.replace(rig, **{option: value}) if rig.kind == kind else rig for rig in rigs]
    return rigs


def solve(
    recording: FrameRecording,
    setups: Sequence[RigSetup],
    detections: Path,
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, object]:
    """Solve all hands and objects of a recording; return the first hand's summary.

    Writes into `out` poses.npz and summary.json of the first hand, with the objects, poses-HAND.npz and
    summary-HAND.json of the others, object_NAME.npz, contact_HAND_NAME.npz and gestures.jsonl.

    Args:
        recording: The raw frames' manifest; gives `continuous`, clicks and, where there are, the IMU and the
            truth.
        setups: Of each hand rigs, cameras and hand: of markers, of a wrist device, or of both.
        detections: Folder with detections_<camera>.npz of every camera, and tags_<camera>.npz where objects
            have tags.
        out: Existing folder for the results.
        progress: Called with how many of how many messages are done.

    Raises:
        RecordingError: A detections file is missing or broken, imu.csv is, or the results cannot be written.
        CalibrationError: The depth model does not fit the rig, or an object does not.
    """
    continuous = recording.manifest.continuous
    sensed = [recorded_samples(recording, setup) for setup in setups]
    setups = [setup for _, setup in sensed]
    stages = [StageTimes() for _ in setups]
    pipelines = [
        pipeline_of(setup, stage, continuous=continuous) for setup, stage in zip(setups, stages, strict=True)
    ]
    dispatcher = Dispatcher(setups, pipelines, stages[0], gestures=continuous)
    files = RunFiles.of(out / "poses.npz", setups)
    output = _Output({setup.hand.profile.name: [] for setup in setups})
    messages = _messages(recording, setups, detections)
    done = 0
    for message in heapq.merge(*(samples for samples, _ in sensed), messages, key=lambda one: one.t_ns):
        output.take(dispatcher.push(message), files)
        if not isinstance(message, ImuSample):
            if not isinstance(message, TagDetections):
                output.rates.push(message)
            progress(done := done + 1, len(messages))
    output.take(dispatcher.flush(), files)
    files.close()
    summaries: list[dict[str, object]] = []
    for number, (setup, pipeline, stage) in enumerate(zip(setups, pipelines, stages, strict=True)):
        auxiliary = dict[str, int]() if number else dispatcher.auxiliary_counts
        own = [one for one in messages if not isinstance(one, TagDetections) and one.camera in setup.cameras]
        summary = _summarise(recording, setup, own, output.poses[setup.hand.profile.name]) | {
            "camera_hz": {name: hz for name, hz in output.rates.camera_hz.items() if name in setup.cameras},
            "lost": _lost(setup, own),
            "counts": dict(sorted((dict(pipeline.counts) | auxiliary).items())),
            "stage_us": stage.mean_us(),
        }
        summary |= score_objects(_object_scores(recording, setup, output.objects))
        path = out / "summary.json"
        write_summary(path_of_hand(path, setup.hand.profile.name) if number else path, summary)
        summaries.append(summary)
    return summaries[0]


@dataclass(slots=True)
class _Output:
    """Poses of all hands and objects of an offline solve, and the cameras' rates."""

    poses: dict[str, list[HandPose]]
    objects: dict[str, list[ObjectPose]] = field(default_factory=dict[str, list[ObjectPose]])
    rates: CameraRates = field(default_factory=CameraRates)

    def take(self, solved: Iterable[Solved], files: RunFiles) -> None:
        """Write it and keep what is scored."""
        for one in solved:
            message: ResultMessage = one if isinstance(one, Contact | Gesture) else one.pose
            files.write(message)
            if isinstance(message, HandPose):
                self.poses[message.hand].append(message)
            elif isinstance(message, ObjectPose):
                self.objects.setdefault(message.object, []).append(message)


def _object_scores(
    recording: FrameRecording, setup: RigSetup, poses: Mapping[str, Sequence[ObjectPose]]
) -> dict[str, dict[str, float]]:
    """Score each object of this setup whose truth the recording carries."""
    scores: dict[str, dict[str, float]] = {}
    for one in setup.objects:
        truth = load_object_truth(recording.folder, one.name)
        if truth is not None:
            scores[one.name] = score_object(
                ObjectPoses.stacked(poses.get(one.name, ()), object=one.name), truth
            )
    return scores


def _summarise(
    recording: FrameRecording, setup: RigSetup, messages: Sequence[Detections], poses: list[HandPose]
) -> dict[str, object]:
    """Counts, and scores where the recording carries the truth of this hand."""
    seen = sum(bool(pose.valid.any()) for pose in poses)
    summary: dict[str, object] = {"poses": len(poses), "poses_valid": seen}
    if not poses:
        return summary
    stacked = Poses.of(poses)
    if setup.rig.hand != recording.manifest.rig_named(None).hand:
        return summary | _score_markers(recording, setup, stacked, setup.rig.hand)
    if setup.has_markers:
        summary |= _score_markers(recording, setup, stacked)
    return summary | _score_wrist(recording, setup, messages, stacked)


def _score_markers(
    recording: FrameRecording, setup: RigSetup, poses: Poses, hand: str | None = None
) -> dict[str, float]:
    """Score a hand with markers, also where cameras lose what a wrist device sees."""
    found = np.isfinite(poses.markers_raw_m).all(axis=2).sum(axis=0)
    truth = load_truth(recording.folder, found == found.max(), hand) if found.size else None
    if truth is None:
        return {}
    scores = score(poses, truth, fingers_of(setup))
    if recording.manifest.kind == "both":
        scores |= score_hidden(poses, truth, fingers_of(setup))
    return scores


def _score_wrist(
    recording: FrameRecording, setup: RigSetup, messages: Sequence[Detections], poses: Poses
) -> dict[str, float]:
    """Score a wrist device's observations; without markers also the hand of them."""
    if setup.wrist is None:
        return {}
    exact = load_wrist_truth(recording, setup.wrist_cameras[0])
    if exact is None:
        return {}
    cycles = [message for message in messages if isinstance(message, WristDetections)]
    if setup.has_markers:
        return score_cycles(setup.wrist, cycles, exact) | score_tips(cycles, exact)
    missed = float(cycles_missed(poses, exact))
    return {"cycles_missed": missed} | score_wrist(poses, exact) | score_tips(cycles, exact)


def fingers_of(setup: RigSetup) -> tuple[int, ...]:
    """For each marker of the rig the finger it sits on, or -1."""
    on_hand = {name: setup.hand.mount(name).finger for name in setup.hand_markers}
    fingers = [on_hand.get(name) for name in setup.markers]
    return tuple(-1 if finger is None else finger for finger in fingers)


def _messages(
    recording: FrameRecording, setups: Sequence[RigSetup], folder: Path
) -> list[Detections | TagDetections]:
    """Return all cameras' detections by capture time, then by camera, tags last."""
    shown = {name: len(rig.markers) for rig in recording.manifest.all_rigs for name in rig.cameras}
    messages: list[Detections | TagDetections] = []
    order: dict[str, int] = {}
    for setup in setups:
        for camera in setup.camera_names:
            if camera in order:
                continue  # it watches two hands
            order[camera] = len(order)
            if camera in setup.wrist_cameras:
                messages += recorded_cycles(folder, camera)
            else:
                messages += recorded_detections(folder, camera, shown.get(camera, len(setup.markers)))
    tagged = [setup for setup in setups if any(one.tags is not None for one in setup.objects)]
    for camera in dict.fromkeys(name for setup in tagged for name in setup.models):
        messages += recorded_tags(folder, camera)
    return sorted(messages, key=lambda one: (one.t_ns, isinstance(one, TagDetections), order[one.camera]))


def _lost(setup: RigSetup, messages: Sequence[Detections]) -> int:
    """Count the frames or strobe cycles that were never recorded."""
    numbers = {
        name: FrameSequence(CYCLE_FRAMES if name in setup.wrist_cameras else 1) for name in setup.cameras
    }
    for message in messages:
        numbers[message.camera].take(message.session, message.seq)
    return sum(sequence.counts.lost for sequence in numbers.values())


Notify = Callable[[str], None]


def replay_recording(options: Namespace, notify: Notify) -> None:
    """Detect, and solve what was detected.

    Raises:
        PhalanxError: The recording or a file is missing or broken, an option makes no sense for it, or a step
            failed (its own message is on standard error).
    """
    folder = _recording_of(options, notify)
    wanted = () if folder != _given(options) else options.rig
    manifest = load_manifest(folder)
    rigs = rigs_to_solve(manifest, wanted, options.only, options.solver_mode, options.solver)
    if options.hand is not None and not options.hand.is_file():  # reported now, not after all the detection
        raise RecordingError(f"{options.hand}: no such hand profile")
    out: Path = options.out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"--out {out}: cannot make the folder: {error.strerror}") from error
    if options.detections is None:
        for camera, kind in {camera: rig.kind for rig in rigs for camera in rig.cameras}.items():
            _detect(folder, camera, kind, options, notify)
    if options.detect_only:
        return
    notify("solving ...")
    recording = open_recording(folder)
    setups = setups_with_hands(rigs, manifest.cameras, options.calibration, options.hand, manifest.objects)
    found: Path = options.detections or out
    solve(recording, setups, found, out, lambda done, total: progress("solving", done, total))


def _detect(folder: Path, camera: str, kind: str, options: Namespace, notify: Notify) -> None:
    notify(f"detecting {'markers' if kind == 'markers' else 'fingers'} in camera {camera} ...")
    words = ["--name", camera, "--camera", f"replay:{folder}"]
    words += [] if options.calibration is None else ["--calibration", str(options.calibration)]
    words += [] if options.hand is None or kind == "markers" else ["--hand", str(options.hand)]
    _slave("run", *words, "-o", str(options.out / f"detections_{camera}.npz"))


def _given(options: Namespace) -> Path | None:
    """The recording that was named; None: videos or pictures were."""
    paths: list[Path] = options.paths
    manifest = paths[0] / MANIFEST if len(paths) == 1 and paths[0].is_dir() else None
    if manifest is not None and (
        manifest.is_symlink()
        or manifest.exists()
        or options.calibration is None
        or options.detections is not None
    ):
        return paths[0]
    return None


def _recording_of(options: Namespace, notify: Notify) -> Path:
    """The recording, made of videos or pictures in OUT/recording if need be."""
    if not options.paths and not options.camera:
        raise RecordingError("replay: name a recording, or a video for each camera")
    if (given := _given(options)) is not None:
        if options.camera or options.times is not None:
            raise RecordingError(f"--camera, --times: {given} is a recording, which has its own")
        return given
    if options.calibration is None:
        raise RecordingError(
            "videos and pictures need --calibration DIR: lenses, places and colours of their cameras"
        )
    if len(options.rig) > 1:
        raise RecordingError(f"--rig {' --rig '.join(options.rig)}: videos are of one rig")
    notify("reading the videos or pictures ...")
    made: Path = options.out / "recording"
    words = ["--calibration", str(options.calibration), "-o", str(made)]
    words += [word for rig in options.rig for word in ("--rig", rig)]
    words += [] if options.times is None else ["--times", str(options.times)]
    _slave("record", *words, "--from", *options.camera, *(str(path) for path in options.paths))
    return made


def _slave(*words: str) -> None:
    done = subprocess.run([sys.executable, "-m", "slave", *words], check=False)
    if done.returncode != 0:
        raise RecordingError(f"phalanx-slave {words[0]} ended with code {done.returncode}")
