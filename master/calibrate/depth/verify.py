"""Verification of a rig's depth accuracy.

The published table of 20...100 cm for every depth model that the rig has, and the error that was to be expected.

Three things stand side by side and must not be mixed: what a sweep *measured*, at the angles at which the target
stood; what *noise and time* cost by the derivatives of the ideal law (`master.fabrik.depth.error_budget`); and what a
law of raw disparity costs *off the axis*, where it was not fitted, by projecting points with the rig's own cameras.
The last is exact for the model, and as true as the rig's stereo calibration is.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import RigCalibration
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert, transform
from master.calibrate.depth.fit import ideal_of
from master.calibrate.depth.sweep import Sweep
from master.estimator.cameras import CameraArrays
from master.fabrik.depth import AffineDisparity, DepthLaw, ErrorBudget, PowerLaw, error_budget
from master.fabrik.intersection import triangulate

Cameras = tuple[CameraModel, CameraModel]


@dataclass(frozen=True, slots=True)
class Noise:
    """What is assumed of the cameras.

    Attributes:
        sigma_px: Standard deviation of a centroid in one camera, per axis [px].
        speed_m_s: Sideways speed of a marker [m/s].
        skew_s: Time between the two exposures that nobody corrects [s].
    """

    sigma_px: float = 0.1
    speed_m_s: float = 1.0
    skew_s: float = 0.0005


@dataclass(frozen=True, slots=True, eq=False)
class Verified:
    """A sweep held against the depth models of a rig.

    Attributes:
        sweep: What was measured, nearest first.
        off_axis_deg: (N,) angle of the target off the pair's axis, from the middle between both cameras; NaN: not
            known.
        error_m: Depth model -> depth - distance (N,) [m]; NaN: the model gives no depth there.
        expected_m: (N,) standard deviation of the depth by the noise of the centroids [m].
    """

    sweep: Sweep
    off_axis_deg: Float
    error_m: Mapping[str, Float]
    expected_m: Float

    def relative(self, model: str) -> Float:
        """Error as a share of the distance (N,)."""
        return self.error_m[model] / self.sweep.distance_m

    def figures(self, model: str) -> dict[str, float]:
        """Return the mean and largest |error| of a depth model.

        In mm and in per cent of the distance, where the model gives a depth; else NaN.
        """
        known = np.isfinite(self.error_m[model])
        if not known.any():
            return dict.fromkeys(("mean_mm", "max_mm", "mean_percent", "max_percent"), float("nan"))
        mm, percent = 1e3 * np.abs(self.error_m[model][known]), 100.0 * np.abs(self.relative(model)[known])
        return {
            "mean_mm": float(mm.mean()),
            "max_mm": float(mm.max()),
            "mean_percent": float(percent.mean()),
            "max_percent": float(percent.max()),
        }


def laws_of(rig: RigCalibration) -> dict[str, DepthLaw]:
    """The laws of raw disparity that the rig file holds, by the name of their key."""
    laws: dict[str, DepthLaw] = {}
    if rig.power_law is not None:
        laws["power_law"] = PowerLaw.of(rig.power_law)
    if rig.affine_disparity is not None:
        laws["affine_disparity"] = AffineDisparity.of(rig.affine_disparity)
    return laws


def verify(sweep: Sweep, laws: Mapping[str, DepthLaw], cameras: Cameras | None, noise: Noise) -> Verified:
    """Errors of every depth model at every place of a sweep.

    Args:
        sweep: Nearest first.
        laws: Laws of raw disparity.
        cameras: The calibrated pair, for the full stereo model; None: not calibrated.
        noise: Its sigma is taken where the sweep does not report how much its disparities scatter.
    """
    d = sweep.distance_m
    errors = {name: law.depth(sweep.disparity_px) - d for name, law in laws.items()}
    angle = np.full(d.size, np.nan)
    law: DepthLaw | None = next(iter(laws.values()), None)
    if cameras is not None:
        law = ideal_of(*cameras)
        if np.isfinite(sweep.uv).all():
            points = stereo_points(cameras, sweep.uv)
            errors["stereo"] = points[:, 2] - d
            off = points - middle(cameras)
            angle = np.degrees(np.arctan2(np.hypot(off[:, 0], off[:, 1]), off[:, 2]))
    one = np.where(np.isnan(sweep.sigma_px), 2.0**0.5 * noise.sigma_px, sweep.sigma_px)
    slope = np.full(d.size, np.nan) if law is None else law.metres_per_pixel(d)
    return Verified(sweep, angle, errors, slope * one / np.sqrt(sweep.frames))


def stereo_points(cameras: Cameras, uv: Float) -> Float:
    """Triangulate centroids (2, N, 2) [px] in the first camera's frame.

    Returns points (N, 3) [m]; NaN: not determined.
    """
    found = triangulate(CameraArrays.of(cameras), uv)
    return transform(invert(cameras[0].T_rig_camera), found.points_m)


def middle(cameras: Cameras) -> Float:
    """The middle between both optical centres (3,) [m], in the first camera's frame.

    The pair's axis runs through it, parallel to that of the first camera: a target between the cameras is on axis.
    """
    between = 0.5 * (cameras[0].centre + cameras[1].centre)
    return transform(invert(cameras[0].T_rig_camera), between[None])[0]


def off_axis(law: DepthLaw, cameras: Cameras, distance_m: Float, angle_deg: Float) -> Float:
    """Return the relative depth error (A, N) of a law for off-axis targets.

    At angles (A,) to the side and distances (N,).

    The angle is that of `middle`, in the plane of the first camera's rows; the points are noiseless, seen by the
    calibrated pair. NaN: outside an image.
    """
    x, y, z = middle(cameras).tolist()
    side = x + np.tan(np.radians(angle_deg))[:, None] * (distance_m - z)
    point = np.stack([side, np.full_like(side, y), np.broadcast_to(distance_m, side.shape)], axis=-1)
    in_rig = transform(cameras[0].T_rig_camera, point)
    uv = np.stack([camera.project(in_rig) for camera in cameras])
    size = np.array([[camera.width_px - 1.0, camera.height_px - 1.0] for camera in cameras])
    inside = ((uv >= 0.0) & (uv <= size[:, None, None])).all(axis=(0, 3))
    depth = law.depth(uv[0, ..., 0] - uv[1, ..., 0])
    return np.where(inside, depth / distance_m - 1.0, np.nan)


def budget(cameras: Cameras, distance_m: Float, noise: Noise) -> list[ErrorBudget]:
    """What to expect at each distance, from focal length, baseline, noise and time."""
    law = ideal_of(*cameras)
    baseline_m = float(np.linalg.norm(cameras[1].centre - cameras[0].centre))
    return [
        error_budget(
            law,
            d,
            baseline_m,
            sigma_px=noise.sigma_px,
            speed_m_s=noise.speed_m_s,
            skew_s=noise.skew_s,
        )
        for d in distance_m.tolist()
    ]
