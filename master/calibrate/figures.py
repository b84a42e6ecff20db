"""Figures of calibrations, written as PNG."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from common.calibration.files import replacing
from common.errors import RecordingError


def figure_of(size: tuple[float, float]) -> Figure:
    """An empty figure of a size [inches]."""
    figure = Figure(figsize=size, dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG.

    Raises:
        RecordingError: The file cannot be written.
    """
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write the picture: {error.strerror}") from error
