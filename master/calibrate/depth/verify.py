"""`calibrate depth --verify`: measured depth errors against the error budget.

It gives the published table of 20...100 cm for every depth model that the rig has, as lines, numbers and a plot. Three
things stand side by side and must not be mixed: what a sweep *measured*, at the angles at which the target stood; what
*noise and time* cost by the derivatives of the ideal law (`master.fabrik.depth.error_budget`); and what a law of raw
disparity costs *off the axis*, where it was not fitted, by projecting points with the rig's own cameras. The last is
exact for the model, and as true as the rig's stereo calibration is.
"""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert, transform
from master.calibrate.depth.fit import depth, draw_errors, ideal_of, laws_of, sweep_of
from master.calibrate.depth.source import Measured, Pair, load_pair, refuse_idle
from master.calibrate.depth.sweep import Sweep, check_places, parse_distances, parse_numbers
from master.calibrate.report import Column, Table, finish, plain
from master.calibrate.tree_files import refusals_named
from master.estimator.sensors import CameraArrays
from master.fabrik.depth import DepthLaw, ErrorBudget, error_budget, tolerable_skew_s
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
            points = stereo_points(cameras, np.moveaxis(sweep.uv, 1, 0))
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


def measured_table(found: Verified) -> Table:
    """Errors by distance and model, and their means; beside them what noise explains."""
    models: list[Column] = []
    for name, error in found.error_m.items():
        own = found.figures(name)
        mm, percent = ([own[f"{which}_{unit}"] for which in ("mean", "max")] for unit in ("mm", "percent"))
        models += [
            Column(name, 1e3 * error, "+.2f", "mm", f"error_mm.{name}", mm),
            Column(" ", 100.0 * found.relative(name), "+.2f", "%", f"error_percent.{name}", percent),
        ]
    return Table(
        (
            Column("measured at", found.sweep.distance_m, ".3f", "m", "distance_m"),
            Column("off axis", found.off_axis_deg, ".1f", "°", "off_axis_deg"),
            *models,
            Column("noise, 1 sigma", 1e3 * found.expected_m, ".2f", "mm", "expected_sigma_mm"),
            Column("", found.sweep.frames, key="frames"),
        ),
        ("mean |error|", "max |error|"),
    )


def budget_table(distance_m: Float, expected: Sequence[ErrorBudget], noise: Noise) -> Table:
    """What one pixel, the noise and the time cost at each distance."""
    pixel, centroid, sync = 1e3 * np.array([(e.per_pixel_m, e.centroid_m, e.sync_m) for e in expected]).T
    apart = f"{noise.speed_m_s:g} m/s, {1e3 * noise.skew_s:g} ms apart"

    def cost(title: str, mm: Float, key: str) -> tuple[Column, Column]:
        return Column(title, mm, ".2f", "mm", key), Column(" ", 0.1 * mm / distance_m, ".2f", "%")

    return Table(
        (
            Column("budget at", distance_m, ".3f", "m", "distance_m"),
            Column("one pixel", pixel, ".2f", "mm", "one_pixel_mm"),
            *cost(f"{noise.sigma_px:g} px noise", centroid, "noise_mm"),
            *cost(apart, sync, "sync_mm"),
            *cost("both", np.hypot(centroid, sync), "both_mm"),
        )
    )


def off_axis_lines(distance_m: Float, angle_deg: Float, errors: Mapping[str, Float]) -> list[str]:
    """What each law costs to the side, by angle and distance."""
    lines: list[str] = []
    for name, error in errors.items():
        cells = (
            Column(f"{d:.2f} m", 100.0 * e, "+.2f", "%")
            for d, e in zip(distance_m.tolist(), error.T, strict=True)
        )
        lines.append(
            f"off axis, {name}: error of depth with the rig's own cameras; stereo has none by construction"
        )
        lines += Table((Column("angle", angle_deg, "+.0f", "°"), *cells)).lines()
    return lines


def verified_json(found: Verified) -> dict[str, object]:
    """The measured part as numbers."""
    models = {
        name: {figure: plain(value) for figure, value in found.figures(name).items()}
        for name in found.error_m
    }
    return {"models": models, "rows": measured_table(found).json()}


def expected_json(
    distance_m: Float,
    expected: Sequence[ErrorBudget],
    noise: Noise,
    angle_deg: Float,
    errors: Mapping[str, Float],
) -> dict[str, object]:
    """Budget and off-axis table as numbers."""
    assumed = {"sigma_px": noise.sigma_px, "speed_m_s": noise.speed_m_s, "skew_ms": 1e3 * noise.skew_s}
    off = {
        "distance_m": distance_m.tolist(),
        "angle_deg": angle_deg.tolist(),
        "error_percent": {name: plain(100.0 * error) for name, error in errors.items()},
    }
    rows = budget_table(distance_m, expected, noise).json()
    return {"budget": {"assumed": assumed, "rows": rows}, "off_axis": off}


_TABLE = "0.20:1.00:0.10"  # where the budget is printed


def depth_command(options: Namespace) -> None:
    """Fit the laws of depth, or with --verify report how right the depth of a rig is."""
    if options.verify:
        verify_rig(options)
    else:
        depth(options)


def verify_rig(options: Namespace) -> None:
    """Report each depth model's error at known distances, and the error budget."""
    refuse_idle("--verify", out=options.out, use=options.use)
    for option in ("sigma_px", "speed_m_s", "skew_ms"):
        if not 0.0 <= (value := float(vars(options)[option])) < np.inf:
            name = option.replace("_", "-")
            raise CalibrationError(f"--{name} {value:g}: expected a number that is not negative")
    noise = Noise(options.sigma_px, options.speed_m_s, 1e-3 * options.skew_ms)
    lines, numbers, draw = list[str](), dict[str, object](), None
    if options.source is None and not options.live:
        pair = load_pair(options.calibration, options.rig or "desk", options.fov_deg)
        distance = parse_distances(options.distances or _TABLE)
        if options.picture is not None:
            raise CalibrationError(
                "--picture: there are no measured errors to draw; give a recording or a .csv"
            )
    else:
        measured = sweep_of(options)
        pair, distance = measured.pair, parse_distances(_TABLE)
        found = _verified(measured, noise)
        lines += _measured_lines(measured, found)
        numbers |= verified_json(found)
        d, title = found.sweep.distance_m, f"Depth of rig {pair.rig.name if pair.rig is not None else ''!r}"
        errors = {name: found.relative(name) for name in found.error_m}
        draw = partial(draw_errors, title=title, distance_m=d, errors=errors, band=found.expected_m / d)
    expected = _expected(pair, distance, _angles(options.angles), noise)
    finish(options, lines + expected[0], numbers | expected[1], draw)


def _verified(measured: Measured, noise: Noise) -> Verified:
    """Compare a sweep with its rig.

    Raises:
        CalibrationError: There is no depth model to compare with.
    """
    pair = measured.pair
    laws = {} if pair.rig is None else laws_of(pair.rig)
    if not laws and pair.models is None:
        raise CalibrationError(
            "there is nothing to verify: give --rig NAME, a rig with power_law, affine_disparity or calibrated cameras"
        )
    with refusals_named(measured.data):
        sweep = check_places(measured.sweep, pair.cameras, pair.size_px)
    found = verify(sweep, laws, pair.models, noise)
    if not found.error_m:
        raise CalibrationError(
            "the stereo model needs the columns v_left_px and v_right_px, and the rig has no law of disparity"
        )
    return found


def _measured_lines(measured: Measured, found: Verified) -> list[str]:
    pair = measured.pair
    rates = ", ".join(f"{file.name} {file.frame_rate_hz:g} Hz" for file in pair.files) or "unknown"
    lines = [
        measured.about,
        f"camera rate: {rates}; processed: {int(found.sweep.frames.sum())} frame pairs",
    ]
    for name, known in ({} if pair.rig is None else pair.rig.provenance).items():
        if name in found.error_m and measured.data in known.data:
            lines.append(
                f"{name} was fitted to this very sweep ({known.date}): its error for other places is larger"
            )
    return lines + measured_table(found).lines()


def _expected(pair: Pair, distance: Float, angle: Float, noise: Noise) -> tuple[list[str], dict[str, object]]:
    """Budget and off-axis table where the cameras are known, as lines and numbers."""
    if pair.models is None or pair.rig is None:
        return [
            "no budget: focal length and baseline are not known (--rig NAME; --fov-deg without intrinsics)"
        ], {}
    errors = {name: off_axis(law, pair.models, distance, angle) for name, law in laws_of(pair.rig).items()}
    baseline_m = float(np.linalg.norm(pair.models[1].centre - pair.models[0].centre))
    assumed = {"sigma_px": noise.sigma_px, "speed_m_s": noise.speed_m_s, "skew_s": noise.skew_s}
    ideal = ideal_of(*pair.models)
    expected = [error_budget(ideal, d, baseline_m, **assumed) for d in distance.tolist()]
    wanted = 0.02  # of the depth, as the published rig
    apart_ms = 1e3 * tolerable_skew_s(wanted, baseline_m, 1.0)
    optics = (
        f"f = {pair.models[0].matrix[0, 0]:.1f} px, B = {1e3 * baseline_m:.1f} mm (lenses of {pair.origin});"
        f" {100 * wanted:g} % at 1 m/s sideways needs exposures within {apart_ms:.2f} ms of each other"
    )
    lines = [
        optics,
        *budget_table(distance, expected, noise).lines(),
        *off_axis_lines(distance, angle, errors),
    ]
    return lines, expected_json(distance, expected, noise, angle, errors)


def _angles(text: str) -> Float:
    """Angles [deg] of --angles, in front of the cameras."""
    angles = parse_numbers(
        text, "--angles", "FIRST:LAST:STEP in degrees, such as -20:20:10, or a list -20,0,20"
    )
    if not (np.abs(angles) < 90.0).all():
        raise CalibrationError(f"--angles {text!r}: expected angles between -90 and 90 degrees")
    return angles
