"""Report on a mounting: uncertainty, residuals, refusals and printed lines."""

import numpy as np

from common.arrays import Float
from common.errors import FitError
from master.calibrate.extrinsics.seen import Fit
from master.calibrate.extrinsics.unknown import CAMERA_IMU, CAMERA_LATE, FOREARM_IMU, IMU_LATE, SHIFT

_ROTATION_RAD = np.radians(4.0)  # standard deviations, at most


def sigmas(fit: Fit) -> dict[str, float]:
    """Return standard deviations by quantity with its unit.

    Of vectors, that of the worst direction.
    """
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
    rotation = max(
        sigma["rotation_sigma_deg"], sigma["imu_rotation_sigma_deg"], sigma["camera_imu_sigma_deg"]
    )
    clock = max(sigma["camera_clock_sigma_ms"], sigma["imu_clock_sigma_ms"])
    wanting: list[str] = []
    if np.radians(rotation) > _ROTATION_RAD:
        wanting.append(
            f"its turn is known to {rotation:.1f} deg only: turn the forearm about another axis as well,"
            " and bend the wrist"
        )
    shift_m, clock_s = 4e-3, 8e-3  # standard deviations, at most
    if 1e-3 * sigma["shift_sigma_mm"] > shift_m:
        wanting.append(
            f"its place is known to {sigma['shift_sigma_mm']:.1f} mm only: bend every finger before the device, with"
            " its marker in sight of the cameras"
        )
    if 1e-3 * clock > clock_s:
        wanting.append(f"its clocks are known to {clock:.1f} ms only: move fingers and forearm faster")
    if wanting:
        raise FitError("; ".join(wanting))


def left_of(fit: Fit) -> dict[str, float]:
    """What is left of sights, by quantity with its unit."""
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
    seen = (
        f"{np.isfinite(fit.off[..., 0]).sum()} laser points, {np.isfinite(fit.off[..., 2]).sum()} fingertips"
    )
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
    lines.append(
        "the heading in q_rig_world is of this recording: it begins anywhere when the IMU starts again"
    )
    return tuple(lines)
