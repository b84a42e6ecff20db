"""`phalanx-slave detect`: what a camera of a recording shows, the same bytes on every run."""

import argparse
from collections.abc import Callable
from pathlib import Path

from common.errors import CalibrationError

PURPOSE = "detect in a recording"
EXAMPLES = """\
  phalanx-slave detect recordings/wave --camera left --calibration calib_json -o detections_left.npz
        offline: every frame of one camera, the same bytes on every run; of a rig whose objects have tags those, too:
        tags_left.npz beside it
  phalanx-slave detect recordings/curl --camera wrist --calibration calib_json -o detections_wrist.npz
        of a wrist device: laser points and fingertips of every strobed triple; the hand is DIR/hands/RIG'S HAND.json
"""
_EVERY = 500  # frames, between two lines that say how far it is


def add_options(command: argparse.ArgumentParser) -> None:
    """The options of `detect`."""
    command.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder with recording.json, frames.csv"
    )
    command.add_argument("--camera", required=True, metavar="NAME")
    command.add_argument(
        "--calibration",
        type=Path,
        metavar="DIR",
        help="its cameras/NAME.json gives the colours; for a wrist device its hands/ the hand",
    )
    command.add_argument(
        "--scan",
        choices=("full", "windows"),
        default="full",
        help="where markers are looked for: in the full frame, or in windows about where they are expected, as a live "
        "slave does where full frames do not fit (default: %(default)s; docs/cameras.md)",
    )
    command.add_argument("--hand", type=Path, metavar="FILE", help="hand profile, for a wrist device")
    command.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="detections_NAME.npz"
    )


def run(options: argparse.Namespace, aside: Callable[[str], None]) -> int:
    """Detect markers, or fingers before a wrist device, in every frame.

    Raises:
        PhalanxError: The recording or a file of calib_json is missing or broken, or an option makes no sense for it.
    """
    from common.frame_recording import load_manifest
    from slave.cameras.replay import is_grey

    def progress(done: int, total: int) -> None:
        if done % _EVERY == 0 or done == total:
            aside(f"{options.camera}: {done} of {total} frames")

    if is_grey(load_manifest(options.recording), options.camera):
        if options.scan != "full":
            raise CalibrationError(f"--scan: camera {options.camera!r} sees no markers")
        _detect_fingers(options, progress, aside)
        return 0
    if options.hand is not None:
        raise CalibrationError(
            f"--hand: camera {options.camera!r} sees markers; only a wrist camera knows a hand"
        )
    _detect_markers(options, progress)
    return 0


def _detect_markers(options: argparse.Namespace, progress: Callable[[int, int], None]) -> None:
    from slave.offline import detect_recording, save_detections, tag_collector

    tags = tag_collector(options.recording, options.camera, options.calibration)
    windows = options.scan == "windows"
    found = detect_recording(
        options.recording, options.camera, options.calibration, progress, tags, windows_only=windows
    )
    save_detections(options.output, found)
    if tags is not None:
        save_detections(options.output.parent / f"tags_{options.camera}.npz", tags.all())


def _detect_fingers(
    options: argparse.Namespace, progress: Callable[[int, int], None], aside: Callable[[str], None]
) -> None:
    from slave.offline import save_detections
    from slave.wrist.offline import detect_wrist_recording

    done = detect_wrist_recording(
        options.recording, options.camera, options.calibration, options.hand, progress
    )
    aside(f"{options.camera}: {done.summary()}")
    save_detections(options.output, done.detections)
