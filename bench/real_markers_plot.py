"""The picture of a ball in real frames, with what is found of it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import cv2
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from bench.marker_evidence import camera_for
from common.arrays import Image
from common.calibration import HsvRange
from slave.markers.detector import MarkerDetector

SHOWN: Final = 6  # frames
AROUND: Final = 1.7  # radii of the ball


def draw(
    file: Path,
    marked: Mapping[str, tuple[float, float, float]],
    images: Mapping[str, Image],
    colour: HsvRange,
) -> None:
    """Draw a PNG.

    Args:
        file: To write.
        marked: Frame -> (u, v, radius) [px] of the ball.
        images: Frame -> (H, W, 3) BGR.
        colour: With which the ball is found.
    """
    figure = Figure(figsize=(7.2, 5.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    names = sorted(marked)[:: max(len(marked) // SHOWN, 1)][:SHOWN]
    for k, name in enumerate(names):
        _show(figure.add_subplot(2, 3, k + 1), name, marked[name], images[name], colour)
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file)


def _show(axes: Axes, name: str, circle: tuple[float, float, float], image: Image, colour: HsvRange) -> None:
    """One frame of the ball: the circle marked by eye in white, what is found with two sigma in red."""
    u, v, radius = circle
    found = MarkerDetector(camera_for(image, {"ball": colour}), ("ball",)).push(image, 0)
    axes.imshow(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    axes.add_patch(Circle((u, v), radius, fill=False, color="white", linewidth=1.0))
    axes.plot([u], [v], "+", color="white")
    x, y = found.uv[0]
    axes.plot([x], [y], "x", color="#e02020")
    axes.add_patch(Circle((x, y), 2.0 * float(found.sigma_px[0]), fill=False, color="#e02020", linewidth=1.0))
    axes.set_xlim(u - AROUND * radius, u + AROUND * radius)
    axes.set_ylim(v + AROUND * radius, v - AROUND * radius)
    axes.set_title(f"{name}: quality {found.quality[0]:.2f}", fontsize=8)
    axes.set_axis_off()
