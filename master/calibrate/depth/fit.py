"""`phalanx calibrate depth`: fits two laws of raw disparity.

Known distances of a target enter; the laws go into the rig file, with date, data and residual. What is made small is
the *relative* error of depth, every distance alike. Two errors add up in a sweep: that of the disparity, s_x, costs
s_x D / a of the depth and grows with the distance; that of the ruler, s_D, costs s_D / D and shrinks with it. They are
equal at D = sqrt(a s_D / s_x): 0.6 m for the published rig (a = 37 m px), 1 mm and 0.1 px, the middle of 20...100 cm.
So equal weights are nearly the best ones; least squares in disparity would give the nearest points 25 times the weight
of the farthest. Simulated, 17 distances, mean error of the affine law over 20...100 cm:

    noise              relative   in disparity
    0.1 px             0.044 %    0.039 %
    0.1 px and 1 mm    0.083 %    0.123 %
    0.1 px and 2 mm    0.140 %    0.237 %

The power law has a third reason: it is not the law of two cameras, and misses a yawed pair by 0.3 % on average; equal
relative weights spread that over all distances (max 0.74 %; in disparity 1.1 %, all of it far away). They also give the
published constants: k = 45.28 m for the pair that the published law describes, against 44.05.
"""

from argparse import Namespace
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import atan
from pathlib import Path

import numpy as np

from common.arrays import Bool, Float
from common.calibration import AffineDisparityCalibration, PowerLawCalibration, RigCalibration
from common.errors import CalibrationError, FitError
from common.geometry.camera_model import CameraModel
from master.calibrate.adjust import Normal
from master.calibrate.depth.session import sweep_live
from master.calibrate.depth.source import Measured, Pair, measured_from, parse_target, refuse_idle
from master.calibrate.depth.sweep import Sweep, check_enough, checked
from master.calibrate.picture import figure_of, save_figure
from master.calibrate.report import Column, Table, finish
from master.calibrate.tree_files import provenance, refusals_named, rig_in_tree, write_into_rig
from master.fabrik.depth import AffineDisparity, DepthLaw, PowerLaw, ideal_law

Fit = Callable[[Float, Float], tuple[DepthLaw, Float]]


def fit_power_law(disparity: Float, distance: Float) -> tuple[PowerLaw, Float]:
    """D = k x^z by least squares in ln D (Kalbfleisch, eq. 12); standard deviations.

    Args:
        disparity: u_left - u_right [px], (N,), positive, at least two different ones.
        distance: Along the first camera's axis [m], (N,).

    Returns:
        The law; standard deviations (2,) of k [m] and z by the residuals, NaN for two points.

    Raises:
        FitError: All disparities are the same.
    """
    (z, log_k), sd = _line(np.log(disparity), np.log(distance), np.ones_like(distance))
    k_m = float(np.exp(log_k))
    return PowerLaw(k_m, z), np.array([k_m * sd[1], sd[0]])


def fit_affine_disparity(disparity: Float, distance: Float) -> tuple[AffineDisparity, Float]:
    """x = a / D + x0 by least squares in relative depth; as `fit_power_law`.

    An error dx of x is dx D / a of D. Standard deviations are of a [m px] and x0 [px].
    """
    (a, x0), sd = _line(1.0 / distance, disparity, distance)
    return AffineDisparity(a, x0), sd


FITS: dict[str, Fit] = {"power_law": fit_power_law, "affine_disparity": fit_affine_disparity}
"""The laws that are fitted, by the name of their key in the rig file."""


def _line(x: Float, y: Float, weight: Float) -> tuple[tuple[float, float], Float]:
    """Slope and offset of y = slope x + offset, and their standard deviations (2,).

    `weight` multiplies the residuals. The equations are linear: one step from nought is the minimum.
    """
    derivatives = np.stack([x, np.ones_like(x)], axis=1) * weight[:, None]
    normal = Normal(2)
    normal.add((-weight * y)[None], derivatives[None])
    step = normal.step(0.0)
    if step is None:
        raise FitError("all places have the same disparity: measure at different distances")
    slope, offset = step[0].tolist()
    left = (slope * x + offset - y) * weight
    variance = float(left @ left) / (x.size - 2) if x.size > 2 else float("nan")
    return (slope, offset), np.sqrt(variance * np.diag(normal.covariance()))


def relative_error(law: DepthLaw, disparity: Float, distance: Float) -> Float:
    """(law's depth - distance) / distance, (N,); NaN: no depth for the disparity."""
    return law.depth(disparity) / distance - 1.0


def leave_one_out(fit: Fit, disparity: Float, distance: Float) -> Float:
    """Relative error (N,) of each point by the law of all others."""
    out = np.empty_like(distance)
    for i in range(distance.size):
        others = np.arange(distance.size) != i
        law, _ = fit(disparity[others], distance[others])
        out[i] = relative_error(law, disparity[i : i + 1], distance[i : i + 1])[0]
    return out


def outliers(disparity: Float, distance: Float) -> Bool:
    """Which points (N,) contradict the others, whichever of the two laws is taken.

    Of the laws through two points each, the one with the least median of squares is taken (Rousseeuw 1984:
    half of the points may be wrong); a point is out beyond three robust deviations and 1 % of depth.
    """
    power = _least_median(np.log(disparity), np.log(distance), np.ones_like(distance))
    affine = _least_median(1.0 / distance, disparity, distance)
    by_power = np.abs(np.log(distance) - power[0] * np.log(disparity) - power[1])
    by_affine = np.abs(distance * (disparity - affine[1]) / affine[0] - 1.0)
    return _beyond(by_power) & _beyond(by_affine)


def ideal_of(left: CameraModel, right: CameraModel) -> AffineDisparity:
    """The law of parallel pinholes of this focal length and baseline (eq. 13)."""
    baseline_m = float(np.linalg.norm(right.centre - left.centre))
    return ideal_law(baseline_m, 2.0 * atan(0.5 * left.width_px / left.matrix[0, 0]), left.width_px)


def _least_median(x: Float, y: Float, weight: Float) -> tuple[float, float]:
    """Slope and offset of the line through two points with least median residual."""
    i, j = np.triu_indices(x.size, 1)
    max_pairs = 5000  # of points, from which robust laws are drawn: all of them for up to 100 points
    some = slice(None, None, -(-i.size // max_pairs))
    i, j = i[some], j[some]
    slope = (y[j] - y[i]) / (x[j] - x[i])
    offset = y[i] - slope * x[i]
    residual = np.abs(y - slope[:, None] * x - offset[:, None]) * weight
    best = int(np.argmin(np.median(residual, axis=1)))
    return float(slope[best]), float(offset[best])


def _beyond(error: Float) -> Bool:
    """Which relative errors (N,) are gross, by the scale of Rousseeuw & Leroy 1987."""
    scale = 1.4826 * (1.0 + 5.0 / max(error.size - 2, 1)) * float(np.median(error))
    gross = 0.01  # error of depth below which a point is never called an outlier: a ruler's, a mount's
    return error > max(3.0 * scale, gross)


@dataclass(frozen=True, slots=True, eq=False)
class DepthReport:
    """The outcome of `calibrate depth`."""

    sweep: Sweep  # what was measured, nearest first
    used: Bool  # (N,) False: contradicts the others and was rejected from the fits
    power_law: PowerLaw
    affine_disparity: AffineDisparity
    sd: Mapping[str, Float]  # fitted law -> standard deviations (2,) of its numbers
    errors: Mapping[str, Float]  # law -> relative error of depth (N,), of the laws before the fit and after
    # fitted law -> relative error (K,) of each used point by the law of the others
    rejected: Mapping[str, Float]

    @property
    def best(self) -> str:
        """The fitted law whose mean error for distances that it has not seen is smaller."""
        return min(self.rejected, key=lambda name: float(np.abs(self.rejected[name]).mean()))

    def mean_max(self, name: str) -> tuple[float, float]:
        """Mean and largest |error| of a law over the used distances, as a share."""
        error = np.abs(self.errors[name][self.used])
        return float(error.mean()), float(error.max())


def fit_depth(sweep: Sweep, before: Mapping[str, DepthLaw]) -> DepthReport:
    """Fit both laws to a sweep that `sweep.checked` let pass.

    `before` are laws to compare with, by name.

    Raises:
        FitError: Too many points contradict the others, too few are left, or their distances are not in metres.
    """
    out = outliers(sweep.disparity_px, sweep.distance_m)
    most_out = 0.2  # of all distances; with more out, it is not single ones that are wrong
    if out.sum() > most_out * sweep.size:
        raise FitError(
            f"{int(out.sum())} of {sweep.size} distances fit no law that the others follow: {sweep.names(out)};"
            " measure these again, and see that the cameras did not move in between"
        )
    kept = sweep.at(~out)
    try:
        check_enough(kept)
    except FitError as error:
        raise FitError(f"{error} (left out, for they contradict the others: {sweep.names(out)})") from error
    power, power_sd = fit_power_law(kept.disparity_px, kept.distance_m)
    affine, affine_sd = fit_affine_disparity(kept.disparity_px, kept.distance_m)
    ideal = before.get("ideal")
    if isinstance(ideal, AffineDisparity) and not 1.0 / 1.5 < (ratio := affine.a_m_px / ideal.a_m_px) < 1.5:
        raise FitError(
            f"the distances are {ratio:.2g} times what focal length and baseline of the rig give for these disparities:"
            " give metres, not feet or decimetres; if they are, camera files or T_rig_camera are of other cameras"
        )
    laws = {**before, "power_law": power, "affine_disparity": affine}
    errors = {name: relative_error(law, sweep.disparity_px, sweep.distance_m) for name, law in laws.items()}
    rejected = {name: leave_one_out(fit, kept.disparity_px, kept.distance_m) for name, fit in FITS.items()}
    sd = {"power_law": power_sd, "affine_disparity": affine_sd}
    return DepthReport(sweep, ~out, power, affine, sd, errors, rejected)


def errors_table(report: DepthReport) -> Table:
    """Relative errors [%] by distance and by law; below, means."""
    sweep = report.sweep
    wrong = "rejected: contradicts the others"
    notes = [
        "" if used else f"{wrong} ({place})" for used, place in zip(report.used, sweep.place, strict=True)
    ]
    in_turn = {name: 100.0 * float(np.abs(error).mean()) for name, error in report.rejected.items()}

    def law(name: str, error: Float) -> Column:
        mean, largest = report.mean_max(name)
        foot = (100.0 * mean, 100.0 * largest, in_turn.get(name, float("nan")))
        return Column(name, 100.0 * error, "+.2f", "%", f"error_percent.{name}", foot)

    return Table(
        (
            Column("distance", sweep.distance_m, "6.3f", "m", "distance_m"),
            Column("disparity", sweep.disparity_px, "8.2f", "px", "disparity_px"),
            *(law(name, error) for name, error in report.errors.items()),
            Column("" if report.used.all() else " ", notes),
            Column("", sweep.place, key="place"),
            Column("", sweep.frames, key="frames"),
            Column("", report.used, key="used"),
        ),
        ("mean |error|", "max |error|", "mean, each left out"),
    )


def report_lines(report: DepthReport) -> list[str]:
    """The errors, the laws, and which is better, for a person."""
    power, affine = report.power_law, report.affine_disparity
    k, z = report.sd["power_law"]
    a, c = report.sd["affine_disparity"]
    x0 = affine.x0_px
    return [
        *errors_table(report).lines(),
        f"power_law         D = k x^z      k = {power.k_m:.4f} ± {k:.4f} m, z = {power.z:.5f} ± {z:.5f}",
        f"affine_disparity  x = a/D + x0   a = {affine.a_m_px:.4f} ± {a:.4f} m px, x0 = {x0:.3f} ± {c:.3f} px",
        f"best for distances it has not seen: {report.best}",
    ]


def residual_of(report: DepthReport, name: str) -> dict[str, float]:
    """Residuals and standard deviations of a fitted law."""
    mean, largest = report.mean_max(name)
    numbers = ("k_sd_m", "z_sd") if name == "power_law" else ("a_sd_m_px", "x0_sd_px")
    return {
        "mean_percent": 100.0 * mean,
        "max_percent": 100.0 * largest,
        "leave_one_out_mean_percent": 100.0 * float(np.abs(report.rejected[name]).mean()),
        **{number: float(sd) for number, sd in zip(numbers, report.sd[name], strict=True)},
    }


def report_json(report: DepthReport) -> dict[str, object]:
    """The same as numbers; errors in per cent."""
    means = {name: report.mean_max(name) for name in report.errors}
    before = {name: {"mean_percent": 100.0 * m, "max_percent": 100.0 * x} for name, (m, x) in means.items()}
    return {
        "power_law": {"k_m": report.power_law.k_m, "z": report.power_law.z},
        "affine_disparity": {
            "a_m_px": report.affine_disparity.a_m_px,
            "x0_px": report.affine_disparity.x0_px,
        },
        "best": report.best,
        "laws": before | {name: residual_of(report, name) for name in report.rejected},
        "points": errors_table(report).json(),
    }


def laws_of(rig: RigCalibration) -> dict[str, DepthLaw]:
    """The laws of raw disparity that the rig file holds, by the name of their key."""
    laws: dict[str, DepthLaw] = {}
    if rig.power_law is not None:
        laws["power_law"] = PowerLaw.of(rig.power_law)
    if rig.affine_disparity is not None:
        laws["affine_disparity"] = AffineDisparity.of(rig.affine_disparity)
    return laws


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
    figure = figure_of((9.0, 7.5))
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
    save_figure(figure, path)


def rig_to_write(pair: Pair, out: Path | None) -> RigCalibration | None:
    """The rig file that receives the new laws: that in `out`, else the one in use.

    Raises:
        CalibrationError: No rig is known, it has not two cameras, or other ones than the file in `out`.
    """
    rig = pair.rig
    if out is None:
        return rig
    if rig is None:
        raise CalibrationError("--out: which rig is this? give --rig NAME (a file of --calibration DIR/rigs)")
    if len(rig.cameras) != 2:
        raise CalibrationError(
            f"rig {rig.name!r} has {len(rig.cameras)} cameras: laws of disparity are for two; it needs"
            " depth_model 'stereo'"
        )
    return rig_in_tree(out, pair.file_name, rig)


def laws_note(report: DepthReport, rig: RigCalibration, use: str | None) -> str:
    """Which depth model the written file uses, and which would be better."""
    model = rig.depth_model if use is None else use
    text = f"power_law, affine_disparity; its depth_model is {model}"
    if use is None and model != report.best:
        text += f"; --use {report.best} would switch it"
        if model == "stereo":
            text += " (stereo, if calibrated, is better off the axis: see `calibrate depth --verify`)"
    return text


def sweep_of(options: Namespace) -> Measured:
    """The sweep that the options name: live, of a recording or of a table."""
    outline = parse_target(options.target)
    if options.live:
        refuse_idle("--live", source=options.source, detections=options.detections)
        return sweep_live(options, outline)
    refuse_idle("a measurement without --live", save=options.save_table)
    return measured_from(options, outline)


def depth(options: Namespace) -> None:
    """Fit depth to disparity from a target at known distances, by two laws."""
    measured = sweep_of(options)
    pair = measured.pair
    base = rig_to_write(pair, options.out)
    with refusals_named(measured.data):
        sweep = checked(measured.sweep, pair.cameras, pair.size_px)
        before: dict[str, DepthLaw] = {} if pair.models is None else {"ideal": ideal_of(*pair.models)}
        for name, law in ({} if base is None else laws_of(base)).items():
            before[f"previous {name.partition('_')[0]}"] = law
        report = fit_depth(sweep, before)
    use: str | None = options.use

    def write(out: Path) -> dict[Path, str]:
        assert base is not None  # `rig_to_write` has refused it
        low, high = float(sweep.distance_m.min()), float(sweep.distance_m.max())
        dropped = "" if report.used.all() else f"; rejected: {sweep.names(~report.used)}"
        note = f"{int(report.used.sum())} distances, {low:.3g} to {high:.3g} m{dropped}"
        data = (measured.data,)
        how = {
            name: provenance("calibrate depth", data, residual_of(report, name), note)
            for name in report.rejected
        }
        power, affine = report.power_law, report.affine_disparity
        written = write_into_rig(
            out,
            pair.file_name,
            base,
            how,
            power_law=PowerLawCalibration(k_m=power.k_m, z=power.z),
            affine_disparity=AffineDisparityCalibration(a_m_px=affine.a_m_px, x0_px=affine.x0_px),
            depth_model=base.depth_model if use is None else use,
        )
        return dict.fromkeys(written, laws_note(report, base, use))

    lines = [measured.about, *report_lines(report)]
    draw = partial(
        draw_errors, title=measured.about, distance_m=sweep.distance_m, errors=report.errors, used=report.used
    )
    finish(options, lines, report_json(report), draw, write)
