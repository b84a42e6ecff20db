"""Plots of a wrist device's calibration.

Lines on boards, light of the LEDs, curls of the fingers.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from common.calibration.flat_field import field_at
from common.calibration.replacing import replacing
from common.errors import RecordingError
from common.geometry.camera_model import CameraModel
from master.calibrate.wrist.curl import FingerCurl
from master.calibrate.wrist.flat_field import FlatFit, WhiteSamples
from master.calibrate.wrist.plane import PlaneFit, ViewLine

FINGER_COLOURS = ("#c2571a", "#2b6cb0", "#2f855a", "#805ad5", "#b7791f")
BLUE, ORANGE, GREY = "#2b6cb0", "#c2571a", "#8a8a8a"


def draw_plane(path: Path, fit: PlaneFit, lines: Sequence[ViewLine], optics: CameraModel) -> None:
    """Draw the laser lines and each view's distance from the plane, as PNG.

    Lines in the image; from above, in the plane.

    Raises:
        RecordingError: The file cannot be written.
    """
    figure = figure_of((15.0, 4.6))
    figure.suptitle(
        f"laser plane: normal ± {np.degrees(fit.normal_sigma_rad):.3f} deg,"
        f" offset {1e3 * fit.plane.offset_m:.2f} ± {1e3 * fit.offset_sigma_m:.3f} mm, rms {1e3 * fit.rms_m:.3f} mm"
    )
    image, above, bars = figure.subplots(1, 3)
    framed(image, optics, "lines in the image")
    normal = np.array(fit.plane.normal)
    for line, own in zip(lines, fit.used, strict=True):
        colour = BLUE if own else ORANGE
        uv = optics.project(line.points_m)
        image.plot(uv[:, 0], uv[:, 1], ".", markersize=2, color=colour)
        above.plot(1e3 * line.points_m[:, 0], 1e3 * line.points_m[:, 2], ".", markersize=2, color=colour)
    above.set(title="lines from above [mm]; camera at 0, 0", xlabel="x", ylabel="z", aspect="equal")
    above.plot([0.0], [0.0], "^", color=GREY)
    off = [1e3 * float(np.mean(line.points_m @ normal - fit.plane.offset_m)) for line in lines]
    bars.bar(range(len(lines)), off, color=[BLUE if own else ORANGE for own in fit.used])
    bars.axhline(0.0, color=GREY, linewidth=0.8)
    bars.set(title="views off the plane [mm]; orange: left out", xlabel="view")
    bars.set_xticks(range(len(lines)), [line.name for line in lines], rotation=90, fontsize=7)
    saved(figure, path)


def draw_flat_field(path: Path, fit: FlatFit, samples: WhiteSamples, optics: CameraModel) -> None:
    """Draw the flat field over the image and its residuals, as PNG.

    Shown where white paper was seen.

    Raises:
        RecordingError: The file cannot be written.
    """
    figure = figure_of((15.0, 4.2))
    figure.suptitle(
        f"flat field: residual {100 * fit.rms:.2f} %, cross-validated {100 * fit.cross_validated_rms:.2f} %"
    )
    field, left, law = figure.subplots(1, 3)
    u, v = np.meshgrid(np.arange(0, optics.width_px, 8.0), np.arange(0, optics.height_px, 8.0))
    xy = optics.undistort(np.stack([u, v], axis=-1)).reshape(-1, 2)
    values = field_at(fit.field, xy).reshape(u.shape)
    framed(field, optics, "flat field, 1 on the axis; dots: samples")
    drawn = field.contourf(u, v, values, levels=20, cmap="viridis")
    field.plot(samples.uv[:, 0], samples.uv[:, 1], ".", markersize=1, color="white", alpha=0.5)
    figure.colorbar(drawn, ax=field)
    framed(left, optics, "residual [%]")
    limit = max(300.0 * fit.rms, 1.0)
    dots = left.scatter(
        samples.uv[:, 0],
        samples.uv[:, 1],
        c=100 * fit.residual,
        s=6,
        cmap="coolwarm",
        vmin=-limit,
        vmax=limit,
    )
    figure.colorbar(dots, ax=left)
    law.plot(np.linalg.norm(samples.xy, axis=1), 100 * fit.residual, ".", markersize=2, color=BLUE)
    law.axhline(0.0, color=GREY, linewidth=0.8)
    law.set(
        title="residual [%] by distance from the axis", xlabel="tangent of the angle", ylim=(-limit, limit)
    )
    saved(figure, path)


def draw_curls(path: Path, curls: Sequence[FingerCurl]) -> None:
    """Draw the fingers' laser points from above, and their lines, as PNG.

    Lines from straight (o) to bent (x).

    Raises:
        RecordingError: The file cannot be written.
    """
    figure = figure_of((8.0, 6.5))
    axes = figure.subplots()
    for found, colour in zip(curls, FINGER_COLOURS, strict=True):
        axes.plot(
            1e3 * found.points_m[:, 0], 1e3 * found.points_m[:, 2], ".", markersize=3, color=colour, alpha=0.5
        )
        if found.line is None:
            continue
        origin, way = np.array(found.line.origin_m), np.array(found.line.direction)
        ends = 1e3 * np.stack([origin + t * way for t in found.line.range_m])
        axes.plot(
            ends[:, 0], ends[:, 2], color=colour,
            label=f"{found.finger}: {1e3 * found.line.range_m[1]:.0f} mm, rms {1e3 * found.line.residual_m:.2f} mm",
        )  # fmt: skip
        axes.plot(ends[:1, 0], ends[:1, 2], "o", color=colour)
        axes.plot(ends[1:, 0], ends[1:, 2], "x", color=colour)
    axes.set(title="laser points from above [mm]: o straight, x bent", xlabel="x", ylabel="z", aspect="equal")
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)  # not on the fingers
    saved(figure, path)


def figure_of(size: tuple[float, float]) -> Figure:
    """An empty figure of a size [inches]."""
    figure = Figure(figsize=size, dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def framed(axes: Axes, optics: CameraModel, title: str) -> None:
    """Give axes the frame of the camera's image."""
    axes.set(xlim=(0, optics.width_px), ylim=(optics.height_px, 0), aspect="equal", title=title)


def saved(figure: Figure, path: Path) -> None:
    """Write a figure.

    Raises:
        RecordingError: The file cannot be written.
    """
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write the picture: {error.strerror}") from error
