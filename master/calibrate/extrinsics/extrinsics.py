"""A calibration finds how a wrist device is mounted, and reports on it.

Ten seconds that marker rig and device see together enter. `unknown` gives the first guess, `problem` the fit;
here is what goes in and out: checks, refusals, uncertainty, printed lines.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace as replaced
from functools import partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.calibration import CameraCalibration, ImuCalibration, RigCalibration
from common.errors import CalibrationError, FitError
from common.geometry.transforms import cross, matrix_to_quaternion, transform
from common.hand.model import CHAINS, FINGERS, HandModel
from common.imu.csv_table import IMU, read_imu
from common.imu.fusion import OrientationFilter
from common.messages import HandPose, ImuSample, WristDetections
from common.recording.frame_recording import FrameRecording, open_recording
from master.calibrate.extrinsics.problem import fit_extrinsics
from master.calibrate.extrinsics.tracks import FINGERS as LASER_FINGERS
from master.calibrate.extrinsics.tracks import HandTrack, ImuTrack, LinesOfSight
from master.calibrate.extrinsics.unknown import (
    CAMERA_IMU,
    CAMERA_LATE,
    FOREARM_IMU,
    IMU_LATE,
    SHIFT,
    Fit,
    StrobeCycles,
    started,
)
from master.calibrate.observations import GAP_S, detections_of, thinned
from master.calibrate.picture import draw_extrinsics
from master.calibrate.report import finish
from master.calibrate.tree_files import matrix_of, provenance, refusals_named
from master.calibrate.wrist.device import device_of, writes_rig
from master.estimator.sensors import in_image, laser_points
from master.replay.recorded import recorded_cycles
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup, WristSetup, load_hand
from master.run.app import StageTimes

_SHIFT_M, _ROTATION_RAD, _CLOCK_S = 4e-3, np.radians(4.0), 8e-3  # standard deviations, at most


def sigmas(fit: Fit) -> dict[str, float]:
    """Standard deviations by quantity with its unit; of vectors, the worst direction."""
    unknown, cov = fit.unknown, fit.covariance
    by = np.zeros((3, len(cov)))  # turn of the straight palm, camera axes
    by[:, CAMERA_IMU], by[:, FOREARM_IMU] = np.eye(3), -unknown.T_camera_palm[:3, :3]

    def worst(of: Float) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(of)[-1]))

    return {
        "rotation_sigma_deg": float(np.degrees(worst(by @ cov @ by.T))),
        "shift_sigma_mm": 1e3 * worst(cov[SHIFT, SHIFT]),
        "imu_rotation_sigma_deg": float(np.degrees(worst(cov[FOREARM_IMU, FOREARM_IMU]))),
        "camera_imu_sigma_deg": float(np.degrees(worst(cov[CAMERA_IMU, CAMERA_IMU]))),
        "camera_clock_sigma_ms": 1e3 * float(np.sqrt(cov[CAMERA_LATE, CAMERA_LATE])),
        "imu_clock_sigma_ms": 1e3 * float(np.sqrt(cov[IMU_LATE, IMU_LATE])),
    }


def refuse(fit: Fit, sigma: dict[str, float]) -> None:
    """Refuse what the motion does not constrain, and what no mounting explains.

    Raises:
        FitError: With what to do.
    """
    most_rms, most_outliers = 1.8, 0.35
    if fit.rms > most_rms or fit.outlier_share > most_outliers:
        raise FitError(
            f"no mounting explains what was seen: it is {fit.rms:.1f} times farther off than noise, and"
            f" {100 * fit.outlier_share:.0f} % outliers. Is the hand file that of this hand and side, the laser plane"
            " measured, the first T_camera_palm right to a centimetre and ten degrees, and are both on one clock?"
        )
    rotation = max(sigma[f"{of}_sigma_deg"] for of in ("rotation", "imu_rotation", "camera_imu"))
    clock = max(sigma["camera_clock_sigma_ms"], sigma["imu_clock_sigma_ms"])
    wanting: list[str] = []
    if np.radians(rotation) > _ROTATION_RAD:
        wanting.append(
            f"its turn is known to {rotation:.1f} deg only: turn the forearm about another axis as well,"
            " and bend the wrist"
        )
    if 1e-3 * sigma["shift_sigma_mm"] > _SHIFT_M:
        wanting.append(
            f"its place is known to {sigma['shift_sigma_mm']:.1f} mm only: bend every finger before the device, with"
            " its marker in sight of the cameras"
        )
    if 1e-3 * clock > _CLOCK_S:
        wanting.append(f"its clocks are known to {clock:.1f} ms only: move fingers and forearm faster")
    if wanting:
        raise FitError("; ".join(wanting))


def left_of(fit: Fit) -> dict[str, float]:
    """Residuals by quantity with its unit."""
    off = fit.off * fit.sigma
    laser, tip = (np.sqrt((part**2).sum(axis=-1)) for part in (off[..., :2], off[..., 2:]))
    return {
        "laser_mm": 1e3 * float(np.nanmedian(laser)),
        "tip_px": float(np.nanmedian(tip)),
        "marker_mm": 1e3 * fit.marker_m,
        "outlier_share": fit.outlier_share,
    }


def report_lines(fit: Fit, sigma: dict[str, float], count: int) -> tuple[str, ...]:
    """The result for a person."""
    unknown, left = fit.unknown, left_of(fit)
    wrist_angles = np.degrees(np.quantile(fit.wrist_angles_rad, [0.02, 0.98], axis=0))
    x, y, z = 1e3 * unknown.shift_m
    points, tips = (np.isfinite(fit.off[..., k]).sum() for k in (0, 2))
    seen = f"{points} laser points, {tips} fingertips"
    what = (
        f"laser {left['laser_mm']:.2f} mm, tips {left['tip_px']:.1f} px, markers {left['marker_mm']:.2f} mm"
    )
    flexed, aside = (f"{low:+.0f} ... {high:+.0f} deg" for low, high in wrist_angles.T)
    lines = [
        f"extrinsics from {len(fit.wrist_angles_rad)} of {count} strobe cycles, {seen}",
        f"left: {what}; {100 * fit.outlier_share:.0f} % outliers",
        f"wrist bent {flexed}, aside {aside}; its mean is called straight",
        f"{'':24} {'found':>22} {'standard deviation':>20}",
    ]
    for name, value, key in (
        ("wrist joint, camera", f"{x:.1f} {y:.1f} {z:.1f} mm", "shift_sigma_mm"),
        ("turn of the palm", "", "rotation_sigma_deg"),
        ("turn of the IMU", "", "imu_rotation_sigma_deg"),
        ("IMU against camera", "", "camera_imu_sigma_deg"),
        ("camera later by", f"{1e3 * unknown.camera_late_s:+.2f} ms", "camera_clock_sigma_ms"),
        ("IMU later by", f"{1e3 * unknown.imu_late_s:+.2f} ms", "imu_clock_sigma_ms"),
    ):
        lines.append(f"{name:24} {value:>22} {sigma[key]:16.2f} {key.rsplit('_', 1)[1]}")
    heading = "the heading in q_rig_world is of this recording: it begins anywhere when the IMU starts again"
    return (*lines, heading)


TOOL = "calibrate wrist extrinsics"
MOTION = (
    "for ten seconds bend fingers one by one and together, bend the wrist as far one way as the other, and turn the"
    " forearm about all its axes, before the marker cameras"
)


@dataclass(frozen=True, slots=True, eq=False)
class Extrinsics:
    """A mounting that explains what was seen."""

    rig: RigCalibration  # the wrist rig with its new keys: T_camera_palm, imu, stamp_offset_us
    report: tuple[str, ...]  # lines for a person
    fit: Fit
    cycles: StrobeCycles  # what was fitted to
    sigma: dict[str, float]  # quantity with its unit -> standard deviation


def calibrate_extrinsics(
    poses: Sequence[HandPose],
    markers: tuple[str, ...],
    model: HandModel,
    cycles: Sequence[WristDetections],
    samples: Sequence[ImuSample],
    rig: RigCalibration,
    camera: CameraCalibration,
    source: str = "a joint motion",
) -> Extrinsics:
    """Fit the mounting of a wrist device to one motion.

    Args:
        poses: By the marker rig's pipeline alone.
        markers: Names of their markers, in order.
        cycles: What the slave of the device saw, in order.
        samples: What its IMU measured, in order, with the orientation of its filter.
        rig: The device: laser plane, a palm pose that is right to a centimetre and ten degrees, an IMU.
        source: Name of the data, for the provenance.

    Raises:
        FitError: The motion was not done or seen, or does not fix the mounting; the message states what to
            do.
        CalibrationError: The rig lacks its laser plane, palm pose or IMU.
    """
    if rig.imu is None:
        raise _without_imu(rig.name)
    if not (poses and cycles and samples):
        missing = "the markers" if not poses else "the wrist camera" if not cycles else "the IMU"
        raise FitError(f"{missing} saw nothing: {MOTION}")
    setup = WristSetup.of(rig, camera, model)
    lines_of_sight, zero_ns = LinesOfSight(setup), cycles[0].t_ns
    hand, imu = HandTrack.of(poses, model, zero_ns), ImuTrack(samples, zero_ns)
    seen = _cycles(setup, lines_of_sight, camera, cycles, zero_ns)
    chosen = _chosen(hand, imu, seen)
    tips = hand.points_m[:, [_marker_of(model, markers, finger) for finger in FINGERS[LASER_FINGERS]]]
    start = started(hand, tips, imu, setup.optics, setup.T_camera_palm, seen)
    if start is None:
        raise FitError(f"hand and IMU were hardly seen at the same time: {MOTION}")
    knuckles = model.rest_position_m[CHAINS[1:, 0]].mean(axis=0)
    distance = np.linalg.norm(transform(setup.T_camera_palm, knuckles))
    px_per_m = float(setup.optics.matrix[0, 0] / distance)
    firsts = [replaced(start, camera_late_s=late_s).unknown for late_s in (start.camera_late_s, 0.0)]
    fit = fit_extrinsics(lines_of_sight, model, markers, hand, imu, seen.of(chosen), px_per_m, firsts)
    sigma = sigmas(fit)
    refuse(fit, sigma)
    new = _documented(rig, camera, rig.imu, fit, imu, sigma, source)
    return Extrinsics(new, report_lines(fit, sigma, len(cycles)), fit, seen.of(chosen), sigma)


def _without_imu(rig: str) -> CalibrationError:
    return CalibrationError(f"rig {rig!r}: imu: missing; nothing else measures the bend of the wrist")


def _marker_of(model: HandModel, markers: tuple[str, ...], finger: str) -> int:
    """The marker at the tip of a finger."""
    wanted = CHAINS[FINGERS.index(finger), 3]
    for number, name in enumerate(markers):
        if model.mount(name).joint == wanted:
            return number
    raise FitError(f"no marker sits on the tip of the {finger} finger, which the mounting is found by")


def _cycles(
    setup: WristSetup,
    lines_of_sight: LinesOfSight,
    camera: CameraCalibration,
    messages: Sequence[WristDetections],
    zero_ns: int,
) -> StrobeCycles:
    """Observations of index ... little, on the laser plane and in the image."""
    laser, sigma, tips, tip_sigma = (list[Float]() for _ in range(4))
    for one in messages:
        shown = in_image(setup, one.laser_uv, one.laser_sigma_px)
        found = laser_points(setup, np.where(shown[:, None], one.laser_uv, np.nan), one.laser_sigma_px)
        laser.append(lines_of_sight.axes.flat(found.point_m))
        sigma.append(np.sqrt(np.einsum("fii->fi", lines_of_sight.axes.flat_cov(found.cov_m2))))
        shown = in_image(setup, one.tip_uv, one.tip_sigma_px)
        tips.append(np.where(shown[:, None], one.tip_uv, np.nan))
        tip_sigma.append(one.tip_sigma_px)
    t_s = np.array([1e-9 * (one.t_ns - zero_ns) for one in messages])
    laser_m, sigma_m, uv, uv_sigma = (
        np.array(part)[:, LASER_FINGERS] for part in (laser, sigma, tips, tip_sigma)
    )
    late_s = 1.0 / camera.frame_rate_hz  # the frame with the LEDs follows that with the laser
    return StrobeCycles(t_s, laser_m, sigma_m, uv, uv_sigma, late_s)


def _chosen(hand: HandTrack, imu: ImuTrack, seen: StrobeCycles) -> Bool:
    """The strobe cycles (T,) whose hand both sensors see, at most 200; or refuse."""
    fewest, least_s = 60, 5.0
    if len(hand.t_s) < fewest or len(imu) < fewest:
        raise FitError(
            f"markers gave {len(hand.t_s)} hands, the IMU {len(imu)} orientations with rates; at least {fewest} of"
            f" each are needed: {MOTION}"
        )
    fingers = (np.isfinite(seen.laser_m[..., 0]) | np.isfinite(seen.tip_uv[..., 0])).sum(axis=1)
    near = hand.nearest(seen.t_s)
    marked = np.isfinite(hand.points_m[near, :, 0]).sum(axis=1) >= 4
    lines_of_sight = 2  # fingers with a laser point or a tip
    both = (fingers >= lines_of_sight) & marked & (np.abs(hand.t_s[near] - seen.t_s) < GAP_S)
    both &= (seen.t_s > imu.t_s[0]) & (seen.t_s < imu.t_s[-1])
    rows = np.flatnonzero(both)
    if len(rows) < fewest or np.ptp(seen.t_s[rows]) < least_s:
        raise FitError(
            f"marker cameras and wrist device saw the hand together in {len(rows)} cycles, at least {fewest} of"
            f" {least_s:.0f} s are needed: {MOTION}"
        )
    if imu.gap_s > GAP_S:
        raise FitError(
            f"the IMU was silent for {imu.gap_s:.2f} s: its turns cannot be summed up; record again"
        )
    out = np.zeros(len(seen.t_s), np.bool_)
    out[thinned(rows, 200)] = True  # strobe cycles: more of the same motion add time, not information
    return out


def _documented(
    rig: RigCalibration,
    camera: CameraCalibration,
    old: ImuCalibration,
    fit: Fit,
    imu: ImuTrack,
    sigma: dict[str, float],
    source: str,
) -> RigCalibration:
    unknown = fit.unknown
    place = replace(
        old,
        q_palm_imu=_quaternion(unknown.R_forearm_imu),
        q_rig_world=_quaternion(_rig_world(fit, imu)),
        stamp_offset_us=round(1e6 * unknown.imu_late_s, 1),
    )
    residual = {name: round(value, 4) for name, value in (sigma | left_of(fit)).items()}
    how = provenance(TOOL, (source,), residual, "the wrist is called straight in the middle of its bends")
    world = provenance(TOOL, (source,), residual, "heading: of this recording only")
    return replace(
        rig,
        T_camera_palm=matrix_of(unknown.T_camera_palm),
        imu=place,
        stamp_offset_us=rig.stamp_offset_us | {camera.name: round(1e6 * unknown.camera_late_s, 1)},
        provenance=rig.provenance | {"T_camera_palm": how, "stamp_offset_us": how, "imu": world},
    )


def _rig_world(fit: Fit, imu: ImuTrack) -> Float:
    """R_rig_world (3, 3) of the IMU samples' world: mean vertical, first heading."""
    orientations = imu.mended(fit.unknown.gyro).at(imu.t_s)
    rig_world = fit.unknown.R_rig_world @ orientations.R_world_imu @ np.swapaxes(imu.held_at(imu.t_s), 1, 2)
    known = np.isfinite(rig_world[:, 0, 0])
    rig_world = rig_world[known]
    up: Float = rig_world[..., 2].mean(axis=0)
    first: Float = rig_world[0, :, 0]
    ahead: Float = first - (first @ up) / (up @ up) * up
    ahead, up = ahead / np.linalg.norm(ahead), up / np.linalg.norm(up)
    return np.stack([ahead, cross(up, ahead), up], axis=1)


def _quaternion(R: Float) -> tuple[float, float, float, float]:
    w, x, y, z = (round(float(value), 8) for value in matrix_to_quaternion(R))
    return w, x, y, z


def extrinsics(options: Namespace) -> None:
    """Measure the mounting of a wrist device and its IMU, and their latencies."""
    device = device_of(options.recording, options.rig, options.calibration, options.out)
    if device.rig.T_camera_palm is None:
        raise CalibrationError(
            f"rig {device.file_name!r}: T_camera_palm: a first guess is needed, such as from the drawing of the device"
        )
    if device.rig.imu is None:
        raise _without_imu(device.file_name)
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
    write = writes_rig(device, found.rig, "T_camera_palm, imu, stamp_offset_us")
    draw = partial(draw_extrinsics, found=found, optics=device.optics)
    finish(options, found.report, summary(found), draw, write)


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
