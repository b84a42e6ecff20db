"""`phalanx calibrate time`: offsets of the cameras' time stamps.

From a recording of a moving hand.
"""

from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path

import msgspec

from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.recording.frame_recording import FrameRecording, open_recording
from common.terminal import echo
from master.calibrate.time.fit import SIGNIFICANT, CameraTime, measure_times
from master.calibrate.tree_files import load_marker_rig, provenance, rig_in_tree, write_rig
from master.commands.summary import write_summary
from master.replay.recorded import recorded_detections


def time_command(options: Namespace) -> None:
    """Measure how much later a camera's frames are than its time stamps.

    From a hand that moves.
    """
    opened = open_recording(options.recording)
    used, cameras = geometry_of(opened, options.rig, options.calibration)
    base = rig_in_tree(options.out, options.rig or used.name, used)
    times = measure(opened, used, cameras, options.detections)
    for line in report_lines(used, times):
        echo(line)
    written: Path | None = None
    if options.out is None:
        echo("nothing written: give --out DIR")
    else:
        written = write_offsets(
            options.out, options.rig or used.name, base, times, options.recording.resolve().name
        )
        echo(f"wrote {written}: stamp_offset_us")
    if options.json_file is not None:
        write_summary(
            options.json_file,
            report_json(used, times) | {"written": None if written is None else str(written)},
        )


def geometry_of(
    recording: FrameRecording, rig: str | None, calibration: Path
) -> tuple[RigCalibration, dict[str, CameraCalibration]]:
    """Rig and cameras: the recording's own, or those of a calibration tree.

    Raises:
        RecordingError: The recording has no marker rig.
        CalibrationError: A file of the tree is missing or broken, or the recording lacks one of its cameras.
    """
    if rig is None:
        own = recording.manifest.marker_rig()
        return own, {name: recording.manifest.cameras[name] for name in own.cameras}
    named = load_marker_rig(calibration, rig)
    for name in named.cameras:
        if name not in recording.manifest.cameras:
            raise CalibrationError(f"{recording.folder}: no camera {name!r}, which rig {rig!r} has")
    return named, {
        name: load(calibration / "cameras" / f"{name}.json", CameraCalibration) for name in named.cameras
    }


def measure(
    recording: FrameRecording,
    rig: RigCalibration,
    cameras: Mapping[str, CameraCalibration],
    detections: Path,
) -> tuple[CameraTime, ...]:
    """Offsets of the cameras of a recording, by their stamps as they were recorded.

    Raises:
        RecordingError: A detections file is missing or broken.
        CalibrationError: A camera has no intrinsics, it is not one motion, or there is too little of it.
    """
    if not recording.manifest.continuous:
        raise CalibrationError(
            f"{recording.folder}: its frames are unrelated poses (continuous is false): a time offset needs motion"
        )
    if len(rig.cameras) < 2:
        raise CalibrationError(f"rig {rig.name!r}: cameras: two or more are needed")
    models = {name: CameraModel.of(cameras[name], rig.camera_pose(name)) for name in rig.cameras}
    messages = [
        message for name in rig.cameras for message in recorded_detections(detections, name, len(rig.markers))
    ]
    messages.sort(key=lambda message: message.t_ns)
    return measure_times(models, {name: cameras[name].frame_rate_hz for name in rig.cameras}, messages)


def report_lines(rig: RigCalibration, times: tuple[CameraTime, ...]) -> list[str]:
    """The table for a person."""
    width = max(len("camera"), *(len(name) for name in rig.cameras))
    lines = [
        f"{'camera':{width}}  later than its stamps   standard deviation",
        f"{rig.cameras[0]:{width}}  reference",
    ]
    for time in times:
        offset, sigma = 1e-6 * time.offset.offset_ns, 1e-6 * time.offset.sigma_ns
        note = (
            ""
            if time.significant
            else f"   within {SIGNIFICANT:g} standard deviations of 0: its stamps are right"
        )
        lines.append(f"{time.camera:{width}}  {offset:+18.3f} ms   {sigma:15.3f} ms{note}")
    return lines


def report_json(rig: RigCalibration, times: tuple[CameraTime, ...]) -> dict[str, object]:
    """The same for programs [us]."""
    return {
        "rig": rig.name,
        "reference": rig.cameras[0],
        "offset_us": {time.camera: round(1e-3 * time.offset.offset_ns, 1) for time in times},
        "sigma_us": {time.camera: round(1e-3 * time.offset.sigma_ns, 1) for time in times},
        "significant": {time.camera: time.significant for time in times},
    }


def write_offsets(
    out: Path, file_name: str, rig: RigCalibration, times: tuple[CameraTime, ...], data: str
) -> Path:
    """Write rigs/<file_name>.json with the offsets and their provenance.

    Offsets within noise are written as 0.

    Raises:
        CalibrationError: The file cannot be written; the old one is untouched.
    """
    residual = {f"{time.camera}_sigma_us": round(1e-3 * time.offset.sigma_ns, 1) for time in times}
    how = provenance("calibrate time", (data,), residual, f"against {rig.cameras[0]}")
    new = msgspec.structs.replace(
        rig,
        stamp_offset_us={time.camera: time.to_write_us for time in times},
        provenance=rig.provenance | {"stamp_offset_us": how},
    )
    return write_rig(out, file_name, new)
