"""Device and hand data of a wrist device, from the files of a slave.

Also when the files change while it runs.
"""

from collections.abc import Callable

from common.errors import CalibrationError
from slave.tuning import CameraFiles, Prepare
from slave.wrist.detector import WristDetector, prepared
from slave.wrist.view import WristView


def view_of(files: CameraFiles) -> WristView:
    """The view that camera, rig and hand make together.

    Raises:
        CalibrationError: Something is not calibrated; the text names files and key.
    """
    if files.hand is None:
        raise CalibrationError(
            f"{files.rig_path}: hand: the profile {files.rig.hand!r} of a wrist rig is not loaded"
        )
    try:
        return WristView.of(files.rig, files.camera, files.hand)
    except CalibrationError as error:
        raise CalibrationError(f"{', '.join(map(str, files.paths))}: {error}") from error


def wrist_changes(detector: WristDetector) -> Prepare:
    """Return how changed files reach `detector`: with the next strobe cycle."""

    def prepare(old: CameraFiles, new: CameraFiles) -> Callable[[], None] | None:
        if (old.camera.intrinsics, old.rig, old.hand) == (new.camera.intrinsics, new.rig, new.hand):
            return None
        view = prepared(view_of(new))  # a second or two, and the last thing that may refuse
        return lambda: detector.replace(view)

    return prepare
