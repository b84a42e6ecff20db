"""Plots of a sweep: depth error by distance.

One line for each law or model, with the band to be expected.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from common.arrays import Bool, Float
from common.calibration.files import replacing
from common.errors import RecordingError

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
    """Write the plot as PNG.

    All models above, the good ones enlarged below where there are bad ones.

    Args:
        path: The file; replaced only by a complete one.
        title: Heading.
        distance_m: (N,) [m], rising.
        errors: Model -> relative error of depth (N,).
        used: (N,) False: shown hollow, rejected from a fit.
        band: (N,) standard deviation to be expected, relative.

    Raises:
        RecordingError: The file cannot be written.
    """
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
            axes.fill_between(
                100 * distance_m,
                -200 * band,
                200 * band,
                color="black",
                alpha=0.10,
                label="±2σ of the budget",
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
