"""`phalanx-slave run -o`: detections of a recorded camera.

The output has the same bytes on every run.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from common.command_line import UsageError
from common.errors import CalibrationError
from common.terminal import remark


def detect(options: argparse.Namespace) -> int:
    """Detect markers, or fingers before a wrist device, in every frame.

    Raises:
        PhalanxError: The recording or a file of calib_json is missing or broken, or an option makes no sense for it.
    """
    from common.recording.frame_recording import load_manifest
    from slave.cameras.replay import is_grey

    camera, recording = _source(options)

    def progress(done: int, total: int) -> None:
        every = 500  # frames, between two lines that report the progress
        if done % every == 0 or done == total:
            remark(f"{camera}: {done} of {total} frames")

    if is_grey(load_manifest(recording), camera):
        if options.scan == "windows":
            raise CalibrationError(f"--scan: camera {camera!r} sees no markers")
        _detect_fingers(options, recording, progress)
        return 0
    if options.hand is not None:
        raise CalibrationError(f"--hand: camera {camera!r} sees markers; only a wrist camera knows a hand")
    _detect_markers(options, recording, progress)
    return 0


def _source(options: argparse.Namespace) -> tuple[str, Path]:
    """Camera and recording.

    Raises:
        UsageError: They are not named.
    """
    kind, _, folder = str(options.camera).partition(":")
    if kind != "replay" or not folder:
        raise UsageError("-o writes what is detected in a recording: --camera replay:FOLDER")
    return str(options.name), Path(folder)


def _detect_markers(
    options: argparse.Namespace, recording: Path, progress: Callable[[int, int], None]
) -> None:
    from slave.offline import detect_recording, save_detections, tag_collector

    tags = tag_collector(recording, options.name, options.calibration)
    windows = options.scan == "windows"
    found = detect_recording(
        recording, options.name, options.calibration, progress, tags, windows_only=windows
    )
    save_detections(options.output, found)
    if tags is not None:
        save_detections(options.output.parent / f"tags_{options.name}.npz", tags.all())


def _detect_fingers(
    options: argparse.Namespace, recording: Path, progress: Callable[[int, int], None]
) -> None:
    from slave.offline import save_detections
    from slave.wrist.offline import detect_wrist_recording

    done = detect_wrist_recording(recording, options.name, options.calibration, options.hand, progress)
    remark(f"{options.name}: {done.summary()}")
    save_detections(options.output, done.detections)
