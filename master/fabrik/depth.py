"""Depth from the raw disparity of a parallel pair.

Kalbfleisch measures u_left - u_right [px] on the images as they are, not rectified. Three laws:

    ideal     D = f B / x, f = width / (2 tan(fov / 2))   pinhole, perfectly parallel cameras
    power     D = k x^z                                   fitted; holds on the axis only
    affine    x = a / D + x0                              fitted; a = f B, x0 = yaw misalignment as disparity

Every law maps both ways and gives its own sensitivity |dD/dx|, of which the error budget is made. The full
stereo model is `master.fabrik.rays`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import isfinite, pi, sqrt, tan
from typing import TypeAlias

import numpy as np

from common.arrays import Float
from common.calibration import AffineDisparityCalibration, PowerLawCalibration, RigCalibration, Volume
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from master.fabrik.settings import DEPTH


def _positive(values: Float) -> Float:
    values = np.asarray(values, dtype=np.float64)
    return np.where(values > 0.0, values, np.nan)


@dataclass(frozen=True, slots=True)
class PowerLaw:
    """D = k x^z (Kalbfleisch; the published pair is k = 45.433 m, z = -1.035)."""

    k_m: float
    z: float

    @classmethod
    def of(cls, calibration: PowerLawCalibration) -> "PowerLaw":
        """From the rig file's `power_law`."""
        return cls(calibration.k_m, calibration.z)

    def depth(self, disparity: Float) -> Float:
        """Depth [m]; NaN where the disparity is NaN or not positive."""
        return self.k_m * _positive(disparity) ** self.z

    def disparity(self, depth: Float) -> Float:
        """Disparity [px]; NaN where the depth is NaN or not positive."""
        return (_positive(depth) / self.k_m) ** (1.0 / self.z)

    def metres_per_pixel(self, depth: Float) -> Float:
        """|dD/dx| = |z| D / x [m/px]."""
        return -self.z * _positive(depth) / self.disparity(depth)


@dataclass(frozen=True, slots=True)
class AffineDisparity:
    """Affine law x = a / D + x0: a is f B, x0 the disparity at infinity."""

    a_m_px: float
    x0_px: float

    @classmethod
    def of(cls, calibration: AffineDisparityCalibration) -> "AffineDisparity":
        """From the rig file's `affine_disparity`."""
        return cls(calibration.a_m_px, calibration.x0_px)

    def depth(self, disparity: Float) -> Float:
        """Depth [m]; NaN where the disparity is NaN or not above x0."""
        return self.a_m_px / _positive(np.asarray(disparity, dtype=np.float64) - self.x0_px)

    def disparity(self, depth: Float) -> Float:
        """Disparity [px]; NaN where the depth is NaN or not positive."""
        return self.a_m_px / _positive(depth) + self.x0_px

    def metres_per_pixel(self, depth: Float) -> Float:
        """|dD/dx| = D^2 / a [m/px]."""
        return _positive(depth) ** 2 / self.a_m_px


# depth <-> disparity; arrays of any shape, NaN where not seen or impossible
DepthLaw: TypeAlias = PowerLaw | AffineDisparity


def ideal_law(baseline_m: float, fov_rad: float, width_px: int) -> AffineDisparity:
    """The law of perfectly parallel pinhole cameras: affine with a = f B and x0 = 0.

    `baseline_m`: of the optical centres; `fov_rad`: horizontal, over the whole width.

    Raises:
        ValueError: Not a camera.
    """
    if not (isfinite(baseline_m) and baseline_m > 0.0 and 0.0 < fov_rad < pi and width_px > 0):
        raise ValueError(f"not a stereo pair: baseline {baseline_m} m, view {fov_rad} rad, {width_px} px")
    return AffineDisparity(baseline_m * width_px / (2.0 * tan(fov_rad / 2.0)), 0.0)


def depth_law(rig: RigCalibration, cameras: Sequence[CameraModel]) -> DepthLaw | None:
    """The law the rig file asks for; None when it asks for full stereo triangulation.

    Raises:
        CalibrationError: The named law has no numbers, or the rig is not one pair of parallel cameras.
    """
    model = rig.depth_model
    if model == "stereo":
        return None
    if len(rig.cameras) != 2:
        raise CalibrationError(
            f"rig {rig.name!r}: depth_model {model!r} needs two cameras, cameras has {len(rig.cameras)}: use 'stereo'"
        )
    law: DepthLaw | None = None
    if model == "power_law" and rig.power_law is not None:
        law = PowerLaw.of(rig.power_law)
    if model == "affine_disparity" and rig.affine_disparity is not None:
        law = AffineDisparity.of(rig.affine_disparity)
    if law is None:
        raise CalibrationError(
            f"rig {rig.name!r}: depth_model is {model!r} but the key {model!r} is missing: fit it with"
            " `phalanx calibrate depth`, or use 'stereo'"
        )
    if crooked := _crooked(*cameras[:2]):
        raise CalibrationError(
            f"rig {rig.name!r}: depth_model {model!r} needs parallel cameras side by side, but {crooked}: turn them,"
            " or use 'stereo'"
        )
    return law


def law_contradicts(rig: RigCalibration, cameras: Sequence[CameraModel]) -> str:
    """Return how the rig's depth law contradicts its camera poses; empty: not.

    Raises:
        CalibrationError: As `depth_law`.
    """
    law = depth_law(rig, cameras)
    if law is None or rig.solver == "fabrik":
        return ""
    off, depth_m = law_residual(law, cameras, rig.volume)
    if off <= DEPTH.law_residual:
        return ""
    return (
        f"depth_model {rig.depth_model!r} is {1e2 * off:.1f} % off the cameras' places at {depth_m:.2f} m, and solver"
        f" 'estimator' needs both to agree within {1e2 * DEPTH.law_residual:.0f} %"
    )


def _crooked(left: CameraModel, right: CameraModel) -> str:
    """What keeps raw disparity from being a measure of depth; empty: nothing.

    Beyond these bounds the disparity of one depth changes by more over the image than a law fitted on the
    axis and the correction off it (`master.fabrik.triangulate`) take.
    """
    R = left.T_rig_camera[:3, :3].T
    rotation = R @ right.T_rig_camera[:3, :3]
    x, y, z = R @ (right.centre - left.centre)
    angle = float(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))
    focal = left.matrix[1, 1] / right.matrix[1, 1]
    if angle > DEPTH.parallel_rad:
        return (
            f"the second is turned by {np.degrees(angle):.1f} degrees against the first,"
            f" at most {np.degrees(DEPTH.parallel_rad):.0f} are allowed"
        )
    if x <= 0.0:
        return "the second is not to the right of the first: name the left one first in 'cameras'"
    if max(abs(y), abs(z)) > DEPTH.alike * x:
        off_mm = 1e3 * max(abs(y), abs(z))
        return (
            f"their baseline of {1e3 * x:.0f} mm is off the image rows by {off_mm:.0f} mm,"
            f" at most {1e2 * DEPTH.alike:.0f} % are allowed"
        )
    if abs(focal - 1.0) > DEPTH.alike or left.height_px != right.height_px:
        return f"their focal lengths differ by {1e2 * abs(focal - 1.0):.0f} %, or their heights do"
    return ""


def disparity_on_axis(cameras: Sequence[CameraModel], depth_m: Float) -> Float:
    """Return disparities (N,) [px] at depths (N,) [m] before the cameras' midpoint."""
    left, right = cameras[:2]
    axis = left.T_rig_camera[:3, 2]
    middle = 0.5 * (right.centre - left.centre)
    foot = left.centre + middle - (middle @ axis) * axis
    points = foot + depth_m[:, None] * axis
    return (left.project(points) - right.project(points))[:, 0]


def law_residual(law: DepthLaw, cameras: Sequence[CameraModel], volume: Volume | None) -> tuple[float, float]:
    """Return the largest relative error of the law on the axis, and its depth [m].

    Against the geometry of the first two cameras; `volume`: whose depths are asked; None: usual ones.
    """
    left = cameras[0]
    low_m, high_m = DEPTH.usual_m
    if volume is not None:
        corners = np.array(list(product(*zip(volume.low_m, volume.high_m, strict=True))))
        ahead = (corners - left.centre) @ left.T_rig_camera[:3, 2]
        low_m, high_m = max(float(ahead.min()), DEPTH.nearest * float(ahead.max())), float(ahead.max())
    depth = np.linspace(low_m, high_m, DEPTH.compared)
    off = np.abs(law.depth(disparity_on_axis(cameras, depth)) / depth - 1.0)
    worst = int(np.nan_to_num(off, nan=np.inf).argmax())
    return float(np.nan_to_num(off[worst], nan=np.inf)), float(depth[worst])


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """What spoils a depth [m], one standard cause each, at one distance."""

    per_pixel_m: float  # one whole pixel of disparity, D^2 / (f B) for the ideal law
    centroid_m: float  # both centroids' noise, sqrt(2) sigma |dD/dx|
    sync_m: float  # sideways motion between the two exposures, D v dt / B


def error_budget(
    law: DepthLaw, depth_m: float, baseline_m: float, *, sigma_px: float, speed_m_s: float, skew_s: float
) -> ErrorBudget:
    """Depth errors to expect at `depth_m`, from the derivatives of the ideal law.

    Args:
        sigma_px: Centroid noise of one camera, per axis [px].
        speed_m_s: Sideways speed of the marker [m/s].
        skew_s: Time between the two exposures that nobody corrects [s].
    """
    step = float(law.metres_per_pixel(np.array(depth_m)))
    return ErrorBudget(
        per_pixel_m=step,
        centroid_m=2.0**0.5 * sigma_px * step,
        sync_m=depth_m * speed_m_s * abs(skew_s) / baseline_m,
    )


def tolerable_skew_s(share: float, baseline_m: float, speed_m_s: float) -> float:
    """Return the exposure skew [s] that costs `share` of any depth: share B / v."""
    return share * baseline_m / speed_m_s


@dataclass(frozen=True, slots=True)
class CalibrationResidual:
    """Residual errors that a calibration is known to leave, by its provenance.

    `rays_px`: RMS reprojection error of the cameras together: a bound on what lens and pose are wrong by at
    one place. How much of it was the noise of the corners cannot be separated afterwards.
    """

    rays_px: float = 0.0  # [px]
    law: float = 0.0  # relative error of the depth law, standard deviation

    @classmethod
    def of(cls, rig: RigCalibration) -> "CalibrationResidual":
        """Return the residuals of the rig's file; 0: none stated, it was typed in."""
        rays = rig.provenance.get("T_rig_camera")
        law = None if rig.depth_model == "stereo" else rig.provenance.get(rig.depth_model)
        left = {} if law is None else law.residual
        mean_percent = left.get("leave_one_out_mean_percent", left.get("mean_percent", 0.0))
        # of a mean of absolute errors that are normally distributed
        return cls(
            rays_px=0.0 if rays is None else rays.residual.get("rms_px", 0.0),
            law=mean_percent / 1e2 * sqrt(pi / 2),
        )


EXACT = CalibrationResidual()
