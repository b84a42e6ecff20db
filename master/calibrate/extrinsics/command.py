"""`phalanx calibrate wrist extrinsics`: how a wrist device sits.

A motion that marker rig and device both see enters; the device's pose, its IMU's and both latencies leave.
"""

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from common.command_line import echo
from common.errors import CalibrationError, FitError
from common.imu.csv_table import IMU, read_imu
from common.imu.fusion import OrientationFilter
from common.messages import HandPose, ImuSample
from common.recording.frame_recording import FrameRecording, open_recording
from master.calibrate.extrinsics.extrinsics import Extrinsics, calibrate_extrinsics, left_of
from master.calibrate.observations import detections_of
from master.calibrate.tree_files import print_lines, refusals_named, write_report
from master.calibrate.wrist.device import device_of, write_device
from master.replay.recorded import recorded_cycles
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup, load_hand
from master.run.app import StageTimes


def extrinsics(options: Namespace) -> None:
    """Measure the mounting of a wrist device and its IMU, and their latencies."""
    device = device_of(options.recording, options.rig, options.calibration, options.out)
    if device.rig.T_camera_palm is None:
        raise CalibrationError(
            f"rig {device.file_name!r}: T_camera_palm: a first guess is needed, such as from the drawing of the device"
        )
    if device.rig.imu is None:
        raise CalibrationError(
            f"rig {device.file_name!r}: imu: missing; only the IMU measures the bend of the wrist"
        )
    opened = open_recording(options.recording)
    markers = opened.manifest.marker_rig()
    setup = RigSetup.of(
        markers, dict(opened.manifest.cameras), load_hand(options.calibration, markers.hand, options.hand)
    )
    poses = marker_poses(setup, options.detections)
    samples = imu_samples(opened, device.rig.imu.name, device.rig.imu.rate_hz)
    cycles = list(recorded_cycles(options.detections, device.camera.name))
    with refusals_named(options.recording):
        found = calibrate_extrinsics(
            poses, setup.markers, setup.hand, cycles, samples, device.rig, device.camera, device.source
        )
    print_lines(found.report)
    if options.picture is not None:
        from master.calibrate.picture import draw_extrinsics

        draw_extrinsics(options.picture, found, device.optics)
        echo(f"drew {options.picture}")
    written = write_device(options.out, device, found.rig, "T_camera_palm, imu, stamp_offset_us")
    write_report(options.json_file, summary(found), written)


def marker_poses(setup: RigSetup, detections: Path) -> list[HandPose]:
    """The poses that a marker rig's pipeline makes of recorded detections.

    Raises:
        RecordingError: A file of detections is missing or broken.
    """
    pipeline = build_pipeline(setup, StageTimes())
    messages = detections_of(setup.rig, detections)
    solved = [one for message in messages for one in pipeline.push(message)]
    return [one.pose for one in [*solved, *pipeline.flush()]]


def imu_samples(recording: FrameRecording, name: str, rate_hz: float) -> Sequence[ImuSample]:
    """The IMU samples with orientations, by a slave's filter where the file has none.

    Raises:
        RecordingError: imu.csv is broken.
        FitError: There is none.
    """
    if not (recording.folder / IMU).exists():
        raise FitError(f"{recording.folder}: no {IMU}: record the IMU of the device as well")
    samples = read_imu(recording.folder, name)
    if any(np.isfinite(one.orientation_wxyz).all() for one in samples):
        return samples
    fusion = OrientationFilter(rate_hz)
    return [fusion.push(one) for one in samples]


def summary(found: Extrinsics) -> dict[str, object]:
    """What was measured, as numbers."""
    imu, angles = found.rig.imu, np.degrees(found.fit.wrist_angles_rad)
    return {
        "T_camera_palm": [list(row) for row in found.rig.T_camera_palm or ()],
        "q_palm_imu": None if imu is None else imu.q_palm_imu,
        "q_rig_world": None if imu is None else imu.q_rig_world,
        "camera_late_ms": 1e3 * found.fit.unknown.camera_late_s,
        "imu_late_ms": 1e3 * found.fit.unknown.imu_late_s,
        "sigma": found.sigma,
        "residual": left_of(found.fit),
        "cycles": len(found.cycles.t_s),
        "wrist_deg": [[round(float(v), 2) for v in row] for row in (angles.min(axis=0), angles.max(axis=0))],
    }
