"""Plot of a measured hand.

Lengths against the scaled ones with their uncertainty, and the residuals of each marker.
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from common.calibration.files import replacing
from common.errors import RecordingError
from master.calibrate.hand.measure import CERTAIN, WITHIN_M, HandMeasurement

_BLUE, _GREY = "#2b6cb0", "#9a9a9a"


def draw_hand(path: Path, measurement: HandMeasurement) -> None:
    """Write the picture as PNG.

    Raises:
        RecordingError: The file cannot be written.
    """
    figure = Figure(figsize=(13.0, 6.0), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    _lengths(left, measurement)
    _residuals(right, measurement)
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write the picture: {error.strerror}") from error


def _lengths(axes: Axes, measurement: HandMeasurement) -> None:
    lengths = [
        length
        for length in measurement.lengths
        if len(length.bones) == 1 or length in measurement.parted(length.finger)
    ]
    for row, length in enumerate(lengths):
        axes.errorbar(
            1e3 * (length.length_m - length.scaled_m),
            row,
            xerr=1e3 * CERTAIN * length.sigma_m,
            fmt="o",
            markersize=5,
            capsize=3,
            color=_BLUE if length.measured else _GREY,
        )
    axes.axvspan(-1e3 * WITHIN_M, 1e3 * WITHIN_M, color="#dde7f3", zorder=0)
    axes.axvline(0.0, color=_GREY, linewidth=0.8)
    axes.set_yticks(range(len(lengths)), [length.name for length in lengths], fontsize=8)
    axes.invert_yaxis()
    axes.set(
        xlabel="longer than scaled from the hand length [mm], with 99 %; band: 1 mm",
        title="blue: measured; grey: not determined by the markers",
    )


def _residuals(axes: Axes, measurement: HandMeasurement) -> None:
    observed, off = measurement.observed, measurement.fit.residual_m
    for m, name in enumerate(observed.names):
        axes.plot(
            observed.t_s, 1e3 * np.linalg.norm(off[:, m], axis=-1), ".", markersize=2, label=name, alpha=0.6
        )
    axes.set(
        xlabel="time [s]",
        ylabel="distance of the marker from the fitted hand [mm]",
        title=f"residuals, {1e3 * measurement.rms_m:.2f} mm rms per axis",
    )
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, markerscale=4)
