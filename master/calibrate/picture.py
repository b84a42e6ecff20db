"""Draw the result of a calibration, and save it as one picture.

One PNG shows what was seen, and what was fitted to it. Every `draw_...` raises RecordingError where the file cannot be
written.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from common.arrays import Bool, Float
from common.calibration.files import replacing
from common.calibration.rig import field_at
from common.errors import RecordingError
from common.geometry.camera_model import CameraModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from master.calibrate.extrinsics.extrinsics import Extrinsics
    from master.calibrate.wrist.curl import FingerCurl
    from master.calibrate.wrist.flat_field import FlatFit, WhiteSamples
    from master.calibrate.wrist.laser_plane import PlaneFit, ViewLine
    from master.calibrate.wrist.subject import Subject


def figure_of(size: tuple[float, float]) -> "Figure":
    """An empty figure of a size [inches].

    It loads matplotlib, which nothing but a picture needs.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG.

    Raises:
        RecordingError: The file cannot be written.
    """
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write the picture: {error.strerror}") from error


FINGER_COLOURS = ("#c2571a", "#2b6cb0", "#2f855a", "#805ad5", "#b7791f")
BLUE, ORANGE, GREEN, GREY = "#2b6cb0", "#c2571a", "#2f855a", "#8a8a8a"


def draw_plane(path: Path, fit: "PlaneFit", lines: "Sequence[ViewLine]", optics: CameraModel) -> None:
    """Draw laser lines in the image and from above, and each view's plane distance."""
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
    save_figure(figure, path)


def draw_cloud(path: Path, fit: "PlaneFit", points_m: Float, used: Bool) -> None:
    """Draw a cloud (N, 3) [m] from above, and its distances from the plane."""
    figure = figure_of((11.0, 4.6))
    figure.suptitle(
        f"laser plane: normal ± {np.degrees(fit.normal_sigma_rad):.3f} deg, rms {1e3 * fit.rms_m:.3f} mm"
    )
    above, side = figure.subplots(1, 2)
    off = points_m @ np.array(fit.plane.normal) - fit.plane.offset_m
    for own, colour in ((used, BLUE), (~used, ORANGE)):
        above.plot(*(1e3 * points_m[own][:, [0, 2]]).T, ".", markersize=2, color=colour)
        side.plot(np.flatnonzero(own), 1e3 * off[own], ".", markersize=2, color=colour)
    above.set(title="points from above [mm]", xlabel="x", ylabel="z", aspect="equal")
    side.set(title="points off the plane [mm]; orange: left out", xlabel="point of the file")
    save_figure(figure, path)


def draw_flat_field(path: Path, fit: "FlatFit", samples: "WhiteSamples", optics: CameraModel) -> None:
    """Draw the flat field over the image, and its residuals where paper was seen."""
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
    dots = left.scatter(*samples.uv.T, c=100 * fit.residual, s=6, cmap="coolwarm", vmin=-limit, vmax=limit)
    figure.colorbar(dots, ax=left)
    law.plot(np.linalg.norm(samples.xy, axis=1), 100 * fit.residual, ".", markersize=2, color=BLUE)
    law.axhline(0.0, color=GREY, linewidth=0.8)
    law.set(
        title="residual [%] by distance from the axis", xlabel="tangent of the angle", ylim=(-limit, limit)
    )
    save_figure(figure, path)


def draw_curls(path: Path, curls: "Sequence[FingerCurl]") -> None:
    """Draw the laser points from above, with lines from straight (o) to bent (x)."""
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
    save_figure(figure, path)


def framed(axes: "Axes", optics: CameraModel, title: str) -> None:
    """Give axes the frame of the camera's image."""
    axes.set(xlim=(0, optics.width_px), ylim=(optics.height_px, 0), aspect="equal", title=title)


def _dots_and_rings(axes: "Axes", seen: Float, fitted: Float, colour: str) -> None:
    axes.plot(*seen.T, ".", color=colour, markersize=5)
    axes.plot(*fitted.T, "o", color=colour, markerfacecolor="none", markersize=8)


def draw_subject(path: Path, found: "Subject", optics: CameraModel) -> None:
    """Draw laser points, fingertips and knuckles, seen (dots) and fitted (rings)."""
    model, fit, seen = found.model, found.fit, found.seen
    shown = model(fit.x, fit.angles_rad)
    used = np.isfinite(fit.off[..., 0])
    figure = figure_of((13.0, 5.6))
    figure.suptitle(found.report[0] + "; " + found.report[1])
    above, image = figure.subplots(1, 2)
    framed(image, optics, "fingertips (dots), as fitted (rings); knuckles, before (+) and after (x)")
    for f, colour in enumerate(FINGER_COLOURS[1:]):
        own = used[:, f]
        _dots_and_rings(above, 1e3 * seen.laser_m[own, f], 1e3 * shown[own, f, :2], colour)
        tips = own & np.isfinite(seen.tip_uv[:, f, 0])
        _dots_and_rings(image, seen.tip_uv[tips, f], shown[tips, f, 2:], colour)
    image.plot(*optics.project(model.knuckles(model.none)).T, "+", color=GREY, markersize=12)
    image.plot(*optics.project(model.knuckles(found.unknown)).T, "x", color=BLUE, markersize=10)
    above.set(title="laser points from above [mm]: dots seen, rings fitted", xlabel="across", ylabel="along")
    above.set_aspect("equal")
    save_figure(figure, path)


def draw_over_time(
    axes: "Axes",
    t_s: Float,
    values: Float,
    outlier: Bool,
    names: Sequence[str],
    colours: Sequence[str] = FINGER_COLOURS,
) -> None:
    """Draw series (T, N) over time [s]; outliers (T,) or (T, N) are crosses."""
    beyond = np.broadcast_to(outlier.reshape(len(t_s), -1), values.shape)
    for column, name in enumerate(names):
        colour, off = colours[column % len(colours)], beyond[:, column]
        axes.plot(t_s[~off], values[~off, column], ".", markersize=3, color=colour, label=name)
        axes.plot(t_s[off], values[off, column], "x", markersize=4, color=GREY)
    axes.set(xlabel="time [s]")
    axes.legend(fontsize=8, markerscale=3)


def draw_extrinsics(path: Path, found: "Extrinsics", optics: CameraModel) -> None:
    """Draw laser points and tips, seen (dots) and fitted (rings), and the wrist."""
    fit, cycles = found.fit, found.cycles
    seen = fit.shown + fit.off * fit.sigma  # tips as they were when the laser shone
    figure = figure_of((17.0, 5.4))
    figure.suptitle(found.report[0] + "; " + found.report[1])
    above, image, wrist = figure.subplots(1, 3)
    framed(image, optics, "fingertips (dots), as fitted (rings)")
    for f, colour in enumerate(FINGER_COLOURS[1:]):
        lit, tipped = (np.isfinite(fit.off[:, f, k]) for k in (0, 2))
        _dots_and_rings(above, 1e3 * seen[lit, f, :2], 1e3 * fit.shown[lit, f, :2], colour)
        _dots_and_rings(image, seen[tipped, f, 2:], fit.shown[tipped, f, 2:], colour)
    above.set(title="laser points from above [mm]: dots seen, rings fitted", xlabel="across", ylabel="along")
    above.set_aspect("equal")
    for values, colour, name in (
        (fit.wrist_angles_rad[:, 0], BLUE, "flexion"),
        (fit.wrist_angles_rad[:, 1], ORANGE, "deviation"),
        (fit.twist_rad, GREY, "twist, which no wrist has"),
    ):
        wrist.plot(cycles.t_s, np.degrees(values), ".", color=colour, label=name)
    wrist.set(title="the wrist [deg]", xlabel="time [s]")
    wrist.legend(fontsize=8)
    save_figure(figure, path)
