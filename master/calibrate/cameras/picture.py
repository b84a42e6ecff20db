"""Plot of a camera calibration.

Where corners were seen, their residuals, and which views fit how well.
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from common.calibration.files import replacing
from common.errors import RecordingError
from master.calibrate.cameras.bundle import rms
from master.calibrate.cameras.coverage import CELLS
from master.calibrate.cameras.fit import CamerasFit

_BLUE, _ORANGE, _GREY = "#2b6cb0", "#c2571a", "#8a8a8a"


def draw_views(path: Path, fit: CamerasFit) -> None:
    """Write the plot as PNG, one row per camera.

    Corners, residuals enlarged, rms of each view.

    Raises:
        RecordingError: The file cannot be written.
    """
    cameras = fit.views.cameras
    figure = Figure(figsize=(15.0, 0.6 + 3.7 * len(cameras)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{fit.views.board}: {len(fit.shots)} images, rms {fit.rms_px:.3f} px")
    axes = figure.subplots(len(cameras), 3, squeeze=False, width_ratios=(1.0, 1.0, 1.1))
    for row, camera in zip(axes, cameras, strict=True):
        _corners(row[0], fit, camera)
        _residuals(row[1], fit, camera)
        _bars(row[2], fit, camera)
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write the picture: {error.strerror}") from error


def _image(axes: Axes, fit: CamerasFit, camera: str, title: str) -> None:
    width, height = fit.views.sizes_px[camera]
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title=f"{camera}: {title}")
    axes.tick_params(labelsize=7)


def _corners(axes: Axes, fit: CamerasFit, camera: str) -> None:
    _image(axes, fit, camera, "corners; shaded: cells without any")
    width, height = fit.views.sizes_px[camera]
    rows, columns = CELLS
    seen = np.zeros(CELLS, dtype=np.bool_)
    for i in fit.of(camera):
        uv = fit.observations[i].uv
        axes.plot(uv[:, 0], uv[:, 1], ".", markersize=3)
        u = np.clip((uv[:, 0] + 0.5) * columns / width, 0, columns - 1).astype(int)
        v = np.clip((uv[:, 1] + 0.5) * rows / height, 0, rows - 1).astype(int)
        seen[v, u] = True
    axes.imshow(~seen, extent=(0, width, height, 0), cmap="Greys", alpha=0.25, vmin=0, vmax=1, aspect="equal")


def _residuals(axes: Axes, fit: CamerasFit, camera: str) -> None:
    own = fit.of(camera)
    uv = np.concatenate([fit.observations[i].uv for i in own])
    off = np.concatenate([fit.solution.residuals[i] for i in own])
    # The usual residual becomes one percent of the image's width.
    times = 0.01 * fit.views.sizes_px[camera][0] / max(rms([off]), 1e-6)
    times = float(f"{times:.0e}")
    _image(axes, fit, camera, f"residuals, {times:g} times enlarged")
    axes.quiver(
        uv[:, 0], uv[:, 1], times * off[:, 0], times * off[:, 1],
        angles="xy", scale_units="xy", scale=1.0, width=0.0018, color=_BLUE,
    )  # fmt: skip


def _bars(axes: Axes, fit: CamerasFit, camera: str) -> None:
    errors = {fit.shots[i].view: rms([fit.solution.residuals[i]]) for i in fit.of(camera)}
    names = [name for name, _ in fit.views.of(camera)]
    noted = {no.view for no in fit.rejected if no.camera in (camera, "")}
    colours = [_ORANGE if name in noted else _BLUE for name in names]
    axes.bar(range(len(names)), [errors.get(name, 0.0) for name in names], color=colours)
    top = max(errors.values(), default=1.0)
    for x, name in enumerate(names):
        if name not in errors:
            axes.text(
                x, 0.02 * top, "left out", rotation=90, ha="center", va="bottom", color=_ORANGE, fontsize=8
            )
        elif name in noted:
            axes.text(
                x, errors[name], "lens only", rotation=90, ha="center", va="top", color="white", fontsize=7
            )
    axes.axhline(rms([fit.solution.residuals[i] for i in fit.of(camera)]), color=_GREY, linewidth=0.8)
    axes.set(title=f"{camera}: rms of each view [px]", ylim=(0, 1.08 * top))
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
