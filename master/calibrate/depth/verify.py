"""A verification compares the measured depth error with the error budget.

It gives the published table of 20...100 cm for every depth model that the rig has, as lines, numbers and a
plot. Three things stand side by side and must not be mixed: what a sweep *measured*, at the angles at which
the target stood; what *noise and time* cost by the derivatives of the ideal law
(`master.fabrik.depth.error_budget`); and what a law of raw disparity costs *off the axis*, where it was not
fitted, by projecting points with the rig's own cameras. The last is exact for the model, and as true as the
rig's stereo calibration is.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Bool, Float
from common.calibration import RigCalibration
from common.calibration.files import replacing
from common.errors import RecordingError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert, transform
from master.calibrate.depth.fit import ideal_of
from master.calibrate.depth.sweep import Sweep
from master.estimator.sensors import CameraArrays
from master.fabrik.depth import AffineDisparity, DepthLaw, ErrorBudget, PowerLaw, error_budget
from master.fabrik.intersection import triangulate

Cameras = tuple[CameraModel, CameraModel]


@dataclass(frozen=True, slots=True)
class Noise:
    """What is assumed of the cameras."""

    sigma_px: float = 0.1  # standard deviation of a centroid in one camera, per axis [px]
    speed_m_s: float = 1.0  # sideways speed of a marker [m/s]
    skew_s: float = 0.0005  # time between the two exposures that nobody corrects [s]


@dataclass(frozen=True, slots=True, eq=False)
class Verified:
    """A sweep compared with the depth models of a rig."""

    sweep: Sweep  # what was measured, nearest first
    # (N,) angle of the target off the pair's axis, from the middle between both cameras; NaN: not known
    off_axis_deg: Float
    # depth model -> depth - distance (N,) [m]; NaN: the model gives no depth there
    error_m: Mapping[str, Float]
    expected_m: Float  # (N,) standard deviation of the depth by the noise of the centroids [m]

    def relative(self, model: str) -> Float:
        """Error as a share of the distance (N,)."""
        return self.error_m[model] / self.sweep.distance_m

    def figures(self, model: str) -> dict[str, float]:
        """Mean and largest |error| of a depth model [mm, %]; NaN: it gives no depth."""
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
    """Errors of every depth model at every place of a sweep, nearest first.

    By laws of raw disparity, and by the full stereo model of calibrated cameras. `noise` gives the sigma
    where the sweep does not report how much its disparities scatter.
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
    """Points (N, 3) [m] of centroids (2, N, 2) [px], first camera's frame.

    NaN: not determined.
    """
    found = triangulate(CameraArrays.of(cameras), uv)
    return transform(invert(cameras[0].T_rig_camera), found.points_m)


def middle(cameras: Cameras) -> Float:
    """The middle between both optical centres (3,) [m], in the first camera's frame.

    The pair's axis runs through it, parallel to the first camera's: a target between the cameras is on axis.
    """
    between = 0.5 * (cameras[0].centre + cameras[1].centre)
    return transform(invert(cameras[0].T_rig_camera), between[None])[0]


def off_axis(law: DepthLaw, cameras: Cameras, distance_m: Float, angle_deg: Float) -> Float:
    """Relative depth error (A, N) of a law off the axis; NaN: outside an image.

    At angles (A,) to the side, those of `middle` in the plane of the first camera's rows, and distances (N,);
    the points are noiseless, seen by the calibrated pair.
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
            law, d, baseline_m, sigma_px=noise.sigma_px, speed_m_s=noise.speed_m_s, skew_s=noise.skew_s
        )
        for d in distance_m.tolist()
    ]


def measured_lines(found: Verified) -> list[str]:
    """Errors by distance and model, and their means; beside them what noise explains."""
    names = list(found.error_m)
    lines = [
        "measured  distance  off axis  " + "  ".join(f"{name:>20s}" for name in names) + "   noise, 1 sigma"
    ]
    for i in range(found.sweep.size):
        cells = "  ".join(
            f"{_mm(found.error_m[name][i])} {_percent(found.relative(name)[i])}" for name in names
        )
        angle = found.off_axis_deg[i]
        lines.append(
            f"          {found.sweep.distance_m[i]:6.3f} m  {'   -   ' if np.isnan(angle) else f'{angle:5.1f}°'}  "
            f"  {cells}   {1e3 * found.expected_m[i]:6.2f} mm"
        )
    for which in ("mean", "max"):
        cells = "  ".join(
            f"{found.figures(n)[f'{which}_mm']:8.2f} mm {found.figures(n)[f'{which}_percent']:6.2f} %"
            for n in names
        )
        lines.append(f"          {which + ' |error|':18s}  {cells}")
    return lines


def budget_lines(distance_m: Float, expected: Sequence[ErrorBudget], noise: Noise) -> list[str]:
    """What one pixel, the noise and the time cost at each distance."""
    apart = f"{noise.speed_m_s:g} m/s, {1e3 * noise.skew_s:g} ms apart"
    lines = [
        f"budget    distance   one pixel  {f'{noise.sigma_px:g} px noise':>18s}  {apart:>22s}  {'both':>18s}"
    ]
    for d, e in zip(distance_m.tolist(), expected, strict=True):
        both = float(np.hypot(e.centroid_m, e.sync_m))
        lines.append(
            f"          {d:6.3f} m {1e3 * e.per_pixel_m:8.2f} mm  {_cost(e.centroid_m, d)}      {_cost(e.sync_m, d)}"
            f"  {_cost(both, d)}"
        )
    return lines


def off_axis_lines(distance_m: Float, angle_deg: Float, errors: Mapping[str, Float]) -> list[str]:
    """What each law costs to the side, by angle and distance."""
    lines: list[str] = []
    for name, error in errors.items():
        lines.append(
            f"off axis, {name}: error of depth with the rig's own cameras; stereo has none by construction"
        )
        lines.append("          angle   " + "".join(f"{d:8.2f} m" for d in distance_m.tolist()))
        lines += [
            f"          {angle:+5.0f}°  " + "".join(f"  {_percent(e)}" for e in row.tolist())
            for angle, row in zip(angle_deg.tolist(), error, strict=True)
        ]
    return lines


def verified_json(found: Verified) -> dict[str, object]:
    """The measured part as numbers."""
    rows = [
        {
            "distance_m": float(found.sweep.distance_m[i]),
            "off_axis_deg": _number(found.off_axis_deg[i]),
            "frames": int(found.sweep.frames[i]),
            "error_mm": {name: _number(1e3 * error[i]) for name, error in found.error_m.items()},
            "error_percent": {name: _number(100 * found.relative(name)[i]) for name in found.error_m},
            "expected_sigma_mm": _number(1e3 * found.expected_m[i]),
        }
        for i in range(found.sweep.size)
    ]
    models = {
        name: {figure: _number(value) for figure, value in found.figures(name).items()}
        for name in found.error_m
    }
    return {"models": models, "rows": rows}


def expected_json(
    distance_m: Float,
    expected: Sequence[ErrorBudget],
    noise: Noise,
    angle_deg: Float,
    errors: Mapping[str, Float],
) -> dict[str, object]:
    """Budget and off-axis table as numbers."""
    rows = [
        {
            "distance_m": d,
            "one_pixel_mm": 1e3 * e.per_pixel_m,
            "noise_mm": 1e3 * e.centroid_m,
            "sync_mm": 1e3 * e.sync_m,
        }
        for d, e in zip(distance_m.tolist(), expected, strict=True)
    ]
    assumed = {"sigma_px": noise.sigma_px, "speed_m_s": noise.speed_m_s, "skew_ms": 1e3 * noise.skew_s}
    off = {
        "distance_m": distance_m.tolist(),
        "angle_deg": angle_deg.tolist(),
        "error_percent": {
            name: [[_number(100 * e) for e in row] for row in error.tolist()]
            for name, error in errors.items()
        },
    }
    return {"budget": {"assumed": assumed, "rows": rows}, "off_axis": off}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _mm(metres: float) -> str:
    return f"{'-':>11s}" if np.isnan(metres) else f"{1e3 * metres:+8.2f} mm"


def _percent(share: float) -> str:
    return f"{'-':>8s}" if np.isnan(share) else f"{100 * share:+6.2f} %"


def _cost(metres: float, distance_m: float) -> str:
    return f"{1e3 * metres:6.2f} mm {100 * metres / distance_m:6.2f} %"


_LOOK = {
    "ideal": ("#8a8a8a", "s"),
    "power_law": ("#c2571a", "o"),
    "affine_disparity": ("#2b6cb0", "^"),
    "stereo": ("#2f855a", "D"),
}


def draw_errors(
    path: Path,
    title: str,
    distance_m: Float,
    errors: Mapping[str, Float],
    *,
    used: Bool | None = None,
    band: Float | None = None,
) -> None:
    """Write the plot as PNG: all models above, the good ones enlarged below.

    Args:
        distance_m: (N,) [m], rising.
        errors: Model -> relative error of depth (N,).
        used: (N,) False: shown hollow, rejected from a fit.
        band: (N,) standard deviation to be expected, relative.

    Raises:
        RecordingError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # takes half a second, for a picture alone
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 7.5), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    largest = {name: 100.0 * float(np.nanmax(np.abs(error))) for name, error in errors.items()}
    near = min(largest.values())
    fine = {name: error for name, error in errors.items() if largest[name] <= max(2.0, 4.0 * near)}
    panels = [errors] if len(fine) == len(errors) else [errors, fine]
    drawn = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0].tolist()
    for axes, shown in zip(drawn, panels, strict=True):
        axes.axhline(0.0, color="black", linewidth=0.8)
        for name, error in shown.items():
            colour, marker = _LOOK.get(name, ("#805ad5", "v"))
            axes.plot(100 * distance_m, 100 * error, color=colour, marker=marker, markersize=4, label=name)
            if used is not None and not used.all():
                axes.plot(
                    100 * distance_m[~used], 100 * error[~used], "o", markersize=11, mfc="none", color="red"
                )
        if band is not None:
            noise = "±2σ of the budget"
            axes.fill_between(
                100 * distance_m, -200 * band, 200 * band, color="black", alpha=0.1, label=noise
            )
        axes.set_ylabel("error of depth [%]")
        axes.grid(visible=True, alpha=0.3)
        axes.legend(loc="best", fontsize=8)
    drawn[-1].set_xlabel("distance along the first camera's axis [cm]")
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror}") from error
