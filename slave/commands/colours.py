"""`phalanx-slave colours`: marker colours of a camera from a recording."""

import argparse
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

from common.terminal import echo, remark


def run(options: argparse.Namespace) -> int:
    """Find the colours, write the camera file and print which colours collide.

    Raises:
        PhalanxError: The recording or a file is missing or broken, or the colours cannot be distinguished.
    """
    from slave.markers.colours import report
    from slave.offline import calibrate_colours

    cv2.setNumThreads(1)
    with _recording(options) as folder:
        table = calibrate_colours(
            folder,
            options.camera,
            options.output,
            clicks=dict(options.click),
            auto=options.auto,
            like=options.like,
            hand=options.hand,
            notify=remark,
        )
    echo(report(table))
    return 0


@contextmanager
def _recording(options: argparse.Namespace) -> Generator[Path]:
    """The recording; of a video or pictures one that lasts as long as it is needed.

    Raises:
        PhalanxError: They cannot be read, or are not those of the camera.
    """
    from common.errors import RecordingError
    from common.recording.frame_recording import MANIFEST
    from slave.foreign.importing import Wish, import_pictures

    if (options.recording / MANIFEST).is_file():
        if options.calibration is not None or options.rig is not None:
            raise RecordingError(
                f"--calibration, --rig: {options.recording} is a recording, which has its own"
            )
        yield options.recording
        return
    if options.calibration is None:
        raise RecordingError(
            f"{options.recording}: no {MANIFEST} in it; of a video or pictures give --calibration DIR, whose"
            f" cameras/{options.camera}.json they are of"
        )
    with TemporaryDirectory() as folder:
        wish = Wish(
            named={options.camera: options.recording}, calibration=options.calibration, rig=options.rig
        )
        import_pictures(wish, Path(folder) / "recording", remark)
        yield Path(folder) / "recording"
