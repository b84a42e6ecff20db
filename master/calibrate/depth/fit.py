"""A fit finds the laws of raw disparity, and reports their accuracy.

What is made small is the *relative* error of depth, every distance alike. Two errors add up in a sweep: that
of the disparity, s_x, costs s_x D / a of the depth and grows with the distance; that of the ruler, s_D, costs
s_D / D and shrinks with it. They are equal at D = sqrt(a s_D / s_x): 0.6 m for the published rig (a = 37 m
px), 1 mm and 0.1 px, the middle of 20...100 cm. So equal weights are nearly the best ones; least squares in
disparity would give the nearest points 25 times the weight of the farthest. Simulated, 17 distances, mean
error of the affine law over 20...100 cm:

    noise              relative   in disparity
    0.1 px             0.044 %    0.039 %
    0.1 px and 1 mm    0.083 %    0.123 %
    0.1 px and 2 mm    0.140 %    0.237 %

The power law has a third reason: it is not the law of two cameras, and misses a yawed pair by 0.3 % on
average; equal relative weights spread that over all distances (max 0.74 %; in disparity 1.1 %, all of it far
away). They also give the published constants: k = 45.28 m for the pair that the published law describes,
against 44.05.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import atan

import numpy as np

from common.arrays import Bool, Float
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from master.calibrate.depth.sweep import Sweep, check_enough
from master.fabrik.depth import AffineDisparity, DepthLaw, PowerLaw, ideal_law

Fit = Callable[[Float, Float], tuple[DepthLaw, Float]]


def fit_power_law(disparity: Float, distance: Float) -> tuple[PowerLaw, Float]:
    """D = k x^z by least squares in ln D (Kalbfleisch, eq. 12), and relative errors.

    Args:
        disparity: u_left - u_right [px], (N,), positive, at least two different ones.
        distance: Along the first camera's axis [m], (N,).
    """
    slope, offset = _line(np.log(disparity), np.log(distance), np.ones_like(distance))
    law = PowerLaw(float(np.exp(offset)), slope)
    return law, relative_error(law, disparity, distance)


def fit_affine_disparity(disparity: Float, distance: Float) -> tuple[AffineDisparity, Float]:
    """x = a / D + x0 by least squares in relative depth; as `fit_power_law`.

    An error dx of x is dx D / a of D.
    """
    a, x0 = _line(1.0 / distance, disparity, distance)
    law = AffineDisparity(a, x0)
    return law, relative_error(law, disparity, distance)


FITS: dict[str, Fit] = {"power_law": fit_power_law, "affine_disparity": fit_affine_disparity}
"""The laws that are fitted, by the name of their key in the rig file."""


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


def _line(x: Float, y: Float, weight: Float) -> tuple[float, float]:
    """Slope and offset of y = slope x + offset; `weight` multiplies the residuals."""
    rows = np.stack([x, np.ones_like(x)], axis=1) * weight[:, None]
    slope, offset = np.linalg.lstsq(rows, y * weight, rcond=None)[0]
    return float(slope), float(offset)


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
        FitError: Too many points contradict the others, or too few are left.
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
    power, _ = fit_power_law(kept.disparity_px, kept.distance_m)
    affine, _ = fit_affine_disparity(kept.disparity_px, kept.distance_m)
    laws = {**before, "power_law": power, "affine_disparity": affine}
    errors = {name: relative_error(law, sweep.disparity_px, sweep.distance_m) for name, law in laws.items()}
    rejected = {name: leave_one_out(fit, kept.disparity_px, kept.distance_m) for name, fit in FITS.items()}
    return DepthReport(sweep, ~out, power, affine, errors, rejected)


def report_lines(report: DepthReport) -> list[str]:
    """A table of relative errors [%] by distance and by law."""
    names = list(report.errors)
    widths = [max(len(name), 9) for name in names]

    def row(cells: Iterable[str]) -> str:
        return "  ".join(f"{cell:>{w}s}" for cell, w in zip(cells, widths, strict=True))

    lines = [f"  distance    disparity  {row(names)}"]
    for i in range(report.sweep.size):
        errors = row(_signed(report.errors[n][i]) for n in names)
        mark = "" if report.used[i] else f"  left out: contradicts the others ({report.sweep.place[i]})"
        lines.append(
            f"  {report.sweep.distance_m[i]:6.3f} m  {report.sweep.disparity_px[i]:8.2f} px  {errors}{mark}"
        )
    for title, which in (("mean |error|", 0), ("max |error|", 1)):
        lines.append(f"  {title:21s}  " + row(f"{100 * report.mean_max(n)[which]:.2f} %" for n in names))
    in_turn = {n: f"{100 * np.abs(error).mean():.2f} %" for n, error in report.rejected.items()}
    lines.append(f"  {'mean, left out in turn':21s} " + row(in_turn.get(n, "") for n in names))
    power, affine = report.power_law, report.affine_disparity
    return [
        *lines,
        f"power_law         D = k x^z      k = {power.k_m:.4f} m, z = {power.z:.5f}",
        f"affine_disparity  x = a/D + x0   a = {affine.a_m_px:.4f} m px, x0 = {affine.x0_px:.3f} px",
        f"best for distances it has not seen: {report.best}",
    ]


def report_json(report: DepthReport) -> dict[str, object]:
    """The same as numbers; errors in per cent."""
    power, affine = report.power_law, report.affine_disparity

    def law(name: str) -> dict[str, float]:
        mean, largest = report.mean_max(name)
        out = {"mean_percent": 100 * mean, "max_percent": 100 * largest}
        if name in report.rejected:
            out["leave_one_out_mean_percent"] = 100 * float(np.abs(report.rejected[name]).mean())
        return out

    points = [
        {
            "distance_m": float(report.sweep.distance_m[i]),
            "disparity_px": float(report.sweep.disparity_px[i]),
            "place": report.sweep.place[i],
            "frames": int(report.sweep.frames[i]),
            "used": bool(report.used[i]),
            "error_percent": {name: 100 * float(error[i]) for name, error in report.errors.items()},
        }
        for i in range(report.sweep.size)
    ]
    return {
        "power_law": {"k_m": power.k_m, "z": power.z},
        "affine_disparity": {"a_m_px": affine.a_m_px, "x0_px": affine.x0_px},
        "best": report.best,
        "laws": {name: law(name) for name in report.errors},
        "points": points,
    }


def _signed(share: float) -> str:
    return "-" if np.isnan(share) else f"{100 * share:+.2f} %"
