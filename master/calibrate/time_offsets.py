"""The command `phalanx calibrate time` measures how late camera frames are.

A recording of a moving hand enters, offsets of the cameras' stamps leave. The estimator is that of the
running master (`master.monitor.clocks`), over the whole recording and every frame. It is linear in the
offset, so the recording is measured again, and a third time, with the stamps as they were found before.
"""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from common.calibration import CameraCalibration, RigCalibration, load
from common.command_line import echo
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections
from common.recording.frame_recording import FrameRecording, open_recording
from master.calibrate.tree_files import (
    load_marker_rig,
    print_lines,
    provenance,
    rig_in_tree,
    write_report,
    write_rig,
)
from master.monitor.clocks import ResidualTiming
from master.monitor.timing_fit import TimeOffset
from master.replay.recorded import recorded_detections

SIGNIFICANT = 3.0  # standard deviations
_ADVICE = (
    "record ten seconds of an open hand that all cameras see, swung to and fro about twice a second, up and down as "
    "well as sideways, half a metre from the cameras, with the fingers kept still"
)


@dataclass(frozen=True, slots=True)
class CameraTime:
    """Lag of one camera's frames behind its stamps, against the reference camera."""

    camera: str
    offset: TimeOffset

    @property
    def significant(self) -> bool:
        """Whether the offset is distinct from noise."""
        return abs(self.offset.offset_ns) > SIGNIFICANT * self.offset.sigma_ns

    @property
    def to_write_us(self) -> float:
        """The offset for the rig file [us]; 0 where it may be noise."""
        return round(1e-3 * self.offset.offset_ns, 1) if self.significant else 0.0


def measure_times(
    models: Mapping[str, CameraModel],
    frame_rate_hz: Mapping[str, float],
    messages: Sequence[MarkerDetections],
) -> tuple[CameraTime, ...]:
    """Offsets of all cameras but the reference, which is the first.

    Models and nominal rates are by camera, in the rig's order; detections by their stamps, uncorrected.

    Raises:
        CalibrationError: There is too little motion, or too little of it is seen by both cameras.
    """
    found = _pass(models, frame_rate_hz, messages)
    for _ in range(2):
        before = {camera: offset.offset_ns for camera, offset in found.items()}
        rest = _pass(models, frame_rate_hz, shifted(messages, before))
        found = {
            camera: replace(of, offset_ns=of.offset_ns + before.get(camera, 0.0))
            for camera, of in rest.items()
        }
    for camera in tuple(models)[1:]:  # 1.5 ms are 2 % of depth at half a metre and 1 m/s (B = 75 mm)
        if camera not in found or found[camera].sigma_ns > 1e6:
            raise CalibrationError(_refusal(next(iter(models)), camera, found.get(camera), messages))
    return tuple(CameraTime(camera, offset) for camera, offset in found.items())


def _pass(
    models: Mapping[str, CameraModel],
    frame_rate_hz: Mapping[str, float],
    messages: Sequence[MarkerDetections],
) -> dict[str, TimeOffset]:
    """Time offsets of the cameras for which they can be estimated."""
    machine = ResidualTiming(models, frame_rate_hz, kept_blocks=3600, rate_hz=np.inf)  # an hour of motion
    for message in messages:
        machine.push(message)
    machine.flush()
    offsets = {camera: machine.offset_of(camera) for camera in models}
    return {camera: offset for camera, offset in offsets.items() if offset is not None}


def shifted(messages: Sequence[MarkerDetections], late_ns: Mapping[str, float]) -> list[MarkerDetections]:
    """The messages at their true times, for frames `late_ns` later than their stamps."""
    late = {camera: round(ns) for camera, ns in late_ns.items()}
    moved = [msgspec.structs.replace(one, t_ns=one.t_ns + late.get(one.camera, 0)) for one in messages]
    return sorted(moved, key=lambda message: message.t_ns)


def _refusal(
    reference: str, camera: str, offset: TimeOffset | None, messages: Sequence[MarkerDetections]
) -> str:
    known = "" if offset is None else f", only to {1e-6 * offset.sigma_ns:.1f} ms (standard deviation)"
    parts = ", ".join(
        f"{name}: {seconds:.1f} s, {speed:.0f} px/s"
        for name, (seconds, speed) in _motion(messages, (reference, camera))
    )
    return f"the time of camera {camera!r} cannot be measured{known}; markers seen and their speed: {parts}. {_ADVICE}"


def _motion(
    messages: Sequence[MarkerDetections], cameras: tuple[str, str]
) -> list[tuple[str, tuple[float, float]]]:
    """How long each camera saw markers [s], and their rms speed [px/s]."""
    out: list[tuple[str, tuple[float, float]]] = []
    for camera in cameras:
        frames = [message for message in messages if message.camera == camera]
        seen = [frame.t_ns for frame in frames if np.isfinite(frame.uv).any()]
        length = 1e-9 * (max(seen) - min(seen)) if seen else 0.0
        if len(frames) < 2 or not seen:
            out.append((camera, (length, 0.0)))
            continue
        t_s = 1e-9 * np.array([frame.t_ns - frames[0].t_ns for frame in frames])
        steps = np.diff(np.array([frame.uv for frame in frames]), axis=0) / np.diff(t_s)[:, None, None]
        squares = (steps * steps).sum(axis=-1)
        squares = squares[np.isfinite(squares)]
        out.append((camera, (length, float(np.sqrt(squares.mean())) if len(squares) else 0.0)))
    return out


def time_command(options: Namespace) -> None:
    """Measure how much later frames are than their stamps, from a moving hand."""
    opened = open_recording(options.recording)
    used, cameras = geometry_of(opened, options.rig, options.calibration)
    base = rig_in_tree(options.out, options.rig or used.name, used)
    times = measure(opened, used, cameras, options.detections)
    print_lines(report_lines(used, times))
    written: Path | None = None
    if options.out is None:
        echo("nothing written: give --out DIR")
    else:
        written = write_offsets(
            options.out, options.rig or used.name, base, times, options.recording.resolve().name
        )
        echo(f"wrote {written}: stamp_offset_us")
    write_report(options.json_file, report_json(used, times), written)


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
    recording: FrameRecording, rig: RigCalibration, cameras: Mapping[str, CameraCalibration], detections: Path
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
    rates = {name: cameras[name].frame_rate_hz for name in rig.cameras}
    return measure_times(models, rates, detections_of(rig, detections))


def detections_of(rig: RigCalibration, detections: Path) -> list[MarkerDetections]:
    """Recorded detections of a rig's cameras, by their stamps.

    Raises:
        RecordingError: A detections file is missing or broken.
    """
    messages = [
        message for name in rig.cameras for message in recorded_detections(detections, name, len(rig.markers))
    ]
    return sorted(messages, key=lambda message: message.t_ns)


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
    """Write rigs/<file_name>.json with the offsets (noise as 0) and their provenance.

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
