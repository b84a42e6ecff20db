"""Wrist device that is calibrated: its rig and camera.

From the recording or from a calib_json tree.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError, RecordingError
from common.geometry.camera_model import CameraModel
from common.recording.frame_recording import MANIFEST, open_recording
from common.terminal import echo
from master.calibrate.tree_files import rig_in_tree, write_rig


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """A wrist device.

    Attributes:
        rig: Its rig file; the one in the tree of the results where there is one.
        file_name: Of the rig file, without .json.
        camera: Its camera file.
        optics: The same as geometry; its frame is that of the rig.
        source: Name of the folder that is measured, as provenance names it.
    """

    rig: RigCalibration
    file_name: str
    camera: CameraCalibration
    optics: CameraModel
    source: str


def device_of(source: Path, rig_name: str | None, calibration: Path, out: Path | None) -> Device:
    """The device, and the rig file that is to be written.

    Args:
        source: Recording, or folder of images or detections.
        rig_name: A rig of the tree `calibration`; None: the recording's own, with the recording's own camera.
        calibration: calib_json tree.
        out: Tree of the results.

    Raises:
        RecordingError: The recording cannot be read, or has no wrist rig.
        CalibrationError: A file is missing, broken, of another kind, or without intrinsics.
    """
    recorded = open_recording(source).manifest if (source / MANIFEST).is_file() else None
    if rig_name is None and recorded is None:
        raise CalibrationError(f"{source}: is no recording, which would name its rig: give --rig NAME")
    if rig_name is None and recorded is not None:
        try:
            rig = recorded.wrist_rig()
        except RecordingError as error:
            raise RecordingError(f"{source}/{error}: it is no recording of a wrist device") from error
        name, camera = rig.name, recorded.cameras[rig.cameras[0]]
    else:
        name = str(rig_name)
        rig = load(calibration / "rigs" / f"{name}.json", RigCalibration)
        if rig.kind != "wrist":
            raise CalibrationError(
                f"{calibration / 'rigs' / name}.json: kind is {rig.kind!r}; expected a rig of kind 'wrist'"
            )
        camera = load(calibration / "cameras" / f"{rig.cameras[0]}.json", CameraCalibration)
        if recorded is not None and camera.name not in recorded.cameras:
            raise CalibrationError(f"{source}: no camera {camera.name!r}, which rig {name!r} has")
    if camera.intrinsics is None:
        raise CalibrationError(
            f"camera {camera.name!r}: intrinsics is missing; measure it with `phalanx calibrate cameras intrinsics`"
        )
    optics = CameraModel.of(camera, np.eye(4))
    return Device(rig_in_tree(out, name, rig), name, camera, optics, source.resolve().name)


def print_line(lines: Iterable[str]) -> None:
    """Lines for a person."""
    for line in lines:
        echo(line)


def write_device(out: Path | None, device: Device, rig: RigCalibration, keys: str) -> Path | None:
    """Write the rig file with what was measured, and print that.

    None where no tree was given.

    Raises:
        CalibrationError: It cannot be written; the old file is untouched.
    """
    if out is None:
        echo("nothing written: give --out DIR")
        return None
    written = write_rig(out, device.file_name, rig)
    echo(f"wrote {written}: {keys}")
    return written
