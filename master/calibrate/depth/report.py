"""Accuracy of the fitted depth laws.

Every law at every distance, before and after the fit, and which one is best.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.errors import FitError
from master.calibrate.depth.fit import (
    FITS,
    fit_affine_disparity,
    fit_power_law,
    leave_one_out,
    outliers,
    relative_error,
)
from master.calibrate.depth.sweep import Sweep, check_enough
from master.fabrik.depth import AffineDisparity, DepthLaw, PowerLaw


@dataclass(frozen=True, slots=True, eq=False)
class DepthReport:
    """The outcome of `calibrate depth`.

    Attributes:
        sweep: What was measured, nearest first.
        used: (N,) False: contradicts the others and was rejected from the fits.
        power_law, affine_disparity: Fitted.
        errors: Law -> relative error of depth (N,), of the laws before the fit and after.
        rejected: Fitted law -> relative error (K,) of each used point by the law of the others.
    """

    sweep: Sweep
    used: Bool
    power_law: PowerLaw
    affine_disparity: AffineDisparity
    errors: Mapping[str, Float]
    rejected: Mapping[str, Float]

    @property
    def best(self) -> str:
        """The fitted law whose mean error for distances that it has not seen is smaller."""
        return min(self.rejected, key=lambda name: float(np.abs(self.rejected[name]).mean()))

    def mean_max(self, name: str) -> tuple[float, float]:
        """Return the mean and largest |error| of a law over the used distances.

        Errors are a share of the distance.
        """
        error = np.abs(self.errors[name][self.used])
        return float(error.mean()), float(error.max())


def fit_depth(sweep: Sweep, before: Mapping[str, DepthLaw]) -> DepthReport:
    """Fit both laws to a sweep that `depth_sweep.checked` let pass.

    Args:
        sweep: The points.
        before: Laws to compare with, by the name they are shown under.

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
    return DepthReport(
        sweep,
        ~out,
        power,
        affine,
        {name: relative_error(law, sweep.disparity_px, sweep.distance_m) for name, law in laws.items()},
        {name: leave_one_out(fit, kept.disparity_px, kept.distance_m) for name, fit in FITS.items()},
    )


def report_lines(report: DepthReport) -> list[str]:
    """Format a readable table of relative errors by distance and by law.

    Errors are in per cent.
    """
    names = list(report.errors)
    widths = [max(len(name), 9) for name in names]
    lines = [
        "  distance    disparity  " + "  ".join(f"{n:>{w}s}" for n, w in zip(names, widths, strict=True))
    ]
    for i in range(report.sweep.size):
        errors = (f"{_signed(report.errors[n][i]):>{w}s}" for n, w in zip(names, widths, strict=True))
        mark = "" if report.used[i] else f"  left out: contradicts the others ({report.sweep.place[i]})"
        lines.append(
            f"  {report.sweep.distance_m[i]:6.3f} m  {report.sweep.disparity_px[i]:8.2f} px  {'  '.join(errors)}{mark}"
        )
    for title, which in (("mean |error|", 0), ("max |error|", 1)):
        cells = (f"{100 * report.mean_max(n)[which]:.2f} %" for n in names)
        lines.append(f"  {title:21s}  " + "  ".join(f"{c:>{w}s}" for c, w in zip(cells, widths, strict=True)))
    cells = (
        f"{100 * np.abs(report.rejected[n]).mean():.2f} %" if n in report.rejected else "" for n in names
    )
    lines.append(
        f"  {'mean, left out in turn':21s} "
        + "  ".join(f"{c:>{w}s}" for c, w in zip(cells, widths, strict=True))
    )
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
