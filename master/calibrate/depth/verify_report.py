"""The tables of `calibrate verify`, as lines and as numbers."""

from collections.abc import Mapping, Sequence

import numpy as np

from common.arrays import Float
from master.calibrate.depth.verify import Noise, Verified
from master.fabrik.depth import ErrorBudget


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
    assumed = {
        "sigma_px": noise.sigma_px,
        "speed_m_s": noise.speed_m_s,
        "skew_ms": 1e3 * noise.skew_s,
    }
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
