"""Recordings for calibrations, made by the cameras of this machine.

All cameras record at once; the recordings are joined and searched.
"""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from common.errors import CalibrationError
from master.console.setup.commands import Commands, epoch_of
from master.console.setup.fields import Value
from master.console.setup.job import Stage
from master.console.setup.wizards import Wizard


def recording_stages(
    commands: Commands, wizard: Wizard, values: Mapping[str, Value], work: Path
) -> tuple[list[Callable[[], Stage]], dict[str, Value]]:
    """Return the stages that make a wizard's recording, and the form's values.

    The values have the recording's folders filled in.

    Raises:
        CalibrationError: A camera is not on this machine, or the wizard needs no recording of these cameras.
    """
    cameras = commands.plan.cameras
    elsewhere = [camera.name for camera in cameras if camera.kind == "pi"]
    if elsewhere:
        raise CalibrationError(
            f"{', '.join(elsewhere)}: records on its own machine: phalanx-slave record (docs/recording.md); then give"
            " the folder here"
        )
    if wizard.prepared != "markers":
        raise CalibrationError(
            f"{wizard.title}: the recording is of a wrist device: phalanx-slave record (docs/recording.md); then give"
            " the folder here"
        )
    raw, whole, found = work / "raw", work / "recording", work / "found"

    def record() -> Stage:
        epoch_ns = epoch_of(wizard.scene)
        lines = {
            f"camera {camera.name}": commands.record(
                camera, wizard.scene, epoch_ns, wizard.seconds, raw / camera.name
            )
            for camera in cameras
        }
        return Stage(f"recording {wizard.seconds:.0f} s", lines)

    def join() -> Stage:
        folders = [str(raw / camera.name) for camera in cameras]
        line = [sys.executable, "-m", "slave", "record", "--join", *folders, "-o", str(whole)]
        return Stage("joining the recordings", {"join": line})

    def detect() -> Stage:
        found.mkdir(parents=True, exist_ok=True)
        lines = {
            f"detect {camera.name}": [
                *(sys.executable, "-m", "slave", "run", "--name", camera.name, "--camera", f"replay:{whole}"),
                *("--calibration", str(commands.tree)),
                *("-o", str(found / f"detections_{camera.name}.npz")),
            ]
            for camera in cameras
        }
        return Stage("looking for the markers", lines)

    source = "recording" if "recording" in wizard.first else "source"
    return [record, join, detect], {**values, source: str(whole), "detections": str(found)}
