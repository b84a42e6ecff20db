"""`phalanx calibrate cameras time` measures how late frames of cameras are.

A recording of a moving hand enters, offsets of the cameras' stamps leave. The estimator is that of the
running master (`master.monitor.clocks`), over the whole recording and every frame. It is linear in the
offset, so the recording is measured again, and a third time, with the stamps as they were found before.
"""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from common.calibration import RigCalibration
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections
from master.calibrate.observations import recorded_motion
from master.calibrate.picture import BLUE, GREY, figure_of, save_figure
from master.calibrate.report import Column, Table, finish
from master.calibrate.tree_files import provenance, rig_in_tree, write_into_rig
from master.monitor.clocks import ResidualTiming
from master.monitor.timing_fit import TimeOffset

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
    _refuse_jump(models, frame_rate_hz, messages)
    return tuple(CameraTime(camera, offset) for camera, offset in found.items())


def _refuse_jump(
    models: Mapping[str, CameraModel],
    frame_rate_hz: Mapping[str, float],
    messages: Sequence[MarkerDetections],
) -> None:
    """Refuse stamps whose lateness is another in the second half of the recording."""
    middle = len(messages) // 2
    first, second = (_pass(models, frame_rate_hz, part) for part in (messages[:middle], messages[middle:]))
    for camera in first.keys() & second.keys():
        apart = abs(second[camera].offset_ns - first[camera].offset_ns)
        if apart > max(1e6, 4.0 * float(np.hypot(first[camera].sigma_ns, second[camera].sigma_ns))):
            raise CalibrationError(
                f"camera {camera!r} is late by {1e-6 * first[camera].offset_ns:+.1f} ms in the first half and by"
                f" {1e-6 * second[camera].offset_ns:+.1f} ms in the second: its stamps jumped (was it opened again, did"
                " its machine sleep, or was the clock set?); record once more"
            )


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
    motion = _motion(messages, (reference, camera))
    parts = ", ".join(f"{name}: {seconds:.1f} s, {speed:.0f} px/s" for name, (seconds, speed) in motion)
    text = f"the time of camera {camera!r} cannot be measured{known}; markers seen and their speed: {parts}. {_ADVICE}"
    moving = all(seconds > 3.0 and speed > 100.0 for _, (seconds, speed) in motion)
    if offset is not None or not moving:
        return text
    return (
        f"{text}. Markers moved enough, but no ray of {camera!r} meets those of {reference!r}: are pictures mirrored,"
        " cameras exchanged, or moved since the rig was calibrated?"
    )


def _motion(
    messages: Sequence[MarkerDetections], cameras: tuple[str, str]
) -> list[tuple[str, tuple[float, float]]]:
    """How long each camera saw markers [s], and their rms speed [px/s]."""
    out: list[tuple[str, tuple[float, float]]] = []
    for camera in cameras:
        frames = [one for one in messages if one.camera == camera and np.isfinite(one.uv).any()]
        length = 1e-9 * (frames[-1].t_ns - frames[0].t_ns) if frames else 0.0
        if len(frames) < 2:
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
    motion = recorded_motion(options.recording, options.detections, options.rig, options.calibration)
    rig = motion.rig
    file_name = options.rig or rig.name
    rig_in_tree(options.out, file_name, rig)  # refused before anything is measured
    times = measure_times(motion.models, motion.rates_hz, motion.messages)

    def write(out: Path) -> dict[Path, str]:
        residual = {f"{time.camera}_sigma_us": round(1e-3 * time.offset.sigma_ns, 1) for time in times}
        how = provenance("calibrate cameras time", (motion.data,), residual, f"against {rig.cameras[0]}")
        offsets = {time.camera: time.to_write_us for time in times}
        return write_into_rig(out, file_name, rig, {"stamp_offset_us": how}, stamp_offset_us=offsets)

    lines = offsets_table(rig, times).lines()
    finish(options, lines, report_json(rig, times), partial(draw_times, rig=rig, times=times), write)


def offsets_table(rig: RigCalibration, times: Sequence[CameraTime]) -> Table:
    """Offset of each camera and how surely it is known."""
    right = f"within {SIGNIFICANT:g} standard deviations of 0: its stamps are right"
    notes = ["reference", *("" if time.significant else right for time in times)]
    ms = np.array([[0.0, 0.0], *([time.offset.offset_ns, time.offset.sigma_ns] for time in times)]) * 1e-6
    return Table(
        (
            Column("camera", rig.cameras),
            Column("later than its stamps", ms[:, 0], "+.3f", "ms"),
            Column("standard deviation", ms[:, 1], ".3f", "ms"),
            Column(" ", notes),
        )
    )


def report_json(rig: RigCalibration, times: Sequence[CameraTime]) -> dict[str, object]:
    """The same for programs [us]."""
    return {
        "rig": rig.name,
        "reference": rig.cameras[0],
        "offset_us": {time.camera: round(1e-3 * time.offset.offset_ns, 1) for time in times},
        "sigma_us": {time.camera: round(1e-3 * time.offset.sigma_ns, 1) for time in times},
        "significant": {time.camera: time.significant for time in times},
    }


def draw_times(path: Path, rig: RigCalibration, times: Sequence[CameraTime]) -> None:
    """Draw each camera's offset with its three standard deviations."""
    figure = figure_of((8.0, 1.6 + 0.5 * len(times)))
    axes = figure.subplots()
    for row, time in enumerate(times):
        ms, sigma = 1e-6 * time.offset.offset_ns, 1e-6 * time.offset.sigma_ns
        colour = BLUE if time.significant else GREY
        axes.errorbar(ms, row, xerr=SIGNIFICANT * sigma, fmt="o", capsize=4, color=colour)
    axes.axvline(0.0, color=GREY, linewidth=0.8)
    axes.set_yticks(range(len(times)), [time.camera for time in times])
    axes.set_ylim(-0.8, len(times) - 0.2)
    against = f"later than its stamps, against {rig.cameras[0]} [ms], ± {SIGNIFICANT:g} standard deviations"
    axes.set(xlabel=against, title="blue: corrected; grey: right as it is")
    save_figure(figure, path)
