"""Plots beside the hand in the picture of a run.

Angles, latency or marker noise, error or what was seen.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.arrays import Float
from common.hand.model import FINGERS, HandModel
from master.outputs.drawing import Rgb, series_rgb
from master.outputs.poses import Poses, PosesTruth, distance_m, mean_known

Colour = tuple[float, float, float]

PAPER: Colour = (0.075, 0.09, 0.115)
INK: Colour = (0.90, 0.92, 0.94)
_PANEL: Colour = (0.105, 0.125, 0.155)
_BOTTOMS = (0.63, 0.345, 0.06)


def unit(rgb: Rgb) -> Colour:
    """A colour with parts in 0..1, as matplotlib takes it."""
    return (rgb[0] / 255, rgb[1] / 255, rgb[2] / 255)


def style(axes: Axes, title: str) -> None:
    """Dark panel with a title; all panels look alike."""
    axes.set_facecolor(_PANEL)
    axes.set_title(title, color=INK, size=12, loc="left", pad=6)
    axes.tick_params(colors=INK, labelsize=10, length=3)
    axes.grid(visible=True, color=INK, alpha=0.10, lw=0.8)
    for spine in axes.spines.values():
        spine.set_color(INK)
        spine.set_alpha(0.25)


def draw_panels(figure: Figure, poses: Poses, row: int, model: HandModel, truth: PosesTruth | None) -> None:
    """Draw three panels down the right side.

    A thin line marks the row that is shown as a hand.
    """
    left, width, height = 0.655, 0.33, 0.205
    boxes = [figure.add_axes((left, bottom, width, height)) for bottom in _BOTTOMS]
    seconds = (poses.t_ns - poses.t_ns[0]).astype(np.float64) * 1e-9
    _angles(boxes[0], poses, seconds, model)
    if truth is not None:
        _errors(boxes[1], poses, seconds, truth)
    else:
        _seen(boxes[1], poses, seconds)
    for axes in boxes[:2]:
        axes.axvline(float(seconds[row]), color=INK, lw=1.0, alpha=0.7)
        axes.set_xlim(0.0, float(seconds[-1]) if len(seconds) > 1 else 1.0)
        axes.set_xlabel("time [s]", color=INK, size=10, labelpad=1)
    if poses.latency_ns.any():
        _histogram(boxes[2], poses.latency_ns.astype(np.float64) * 1e-6, "Latency of a pose", "ms")
    else:
        step = distance_m(poses.markers_raw_m, poses.markers_m).ravel() * 1e3
        _histogram(boxes[2], step[~np.isnan(step)], "Marker: raw to filtered", "mm")


def _angles(axes: Axes, poses: Poses, seconds: Float, model: HandModel) -> None:
    style(axes, "PIP angle [deg]")
    pip = 2
    degrees = np.rad2deg(poses.angles_rad[:, :, pip])
    for finger, name in enumerate(FINGERS):
        axes.plot(seconds, degrees[:, finger], color=unit(series_rgb(finger)), lw=1.5, label=name)
    top = float(np.rad2deg(model.limits_rad[1, pip, 1]))
    axes.set_ylim(-15.0, top + 22.0)
    axes.axhline(top, color=INK, lw=0.9, ls=":", alpha=0.7)
    axes.text(0.995, top + 1.5, "limit", color=INK, size=9, ha="right", va="bottom", alpha=0.8,
              transform=axes.get_yaxis_transform())  # fmt: skip
    _legend_above(axes)


def _errors(axes: Axes, poses: Poses, seconds: Float, truth: PosesTruth) -> None:
    style(axes, "Mean error to the truth [mm]")
    errors = {name: mean_known(error) * 1e3 for name, error in truth.errors_m(poses).items()}
    for (name, error), (colour, width) in zip(errors.items(), ((1, 1.5), (0, 1.2)), strict=True):
        label = "markers, unfiltered" if name == "markers" else name
        axes.plot(seconds, error, color=unit(series_rgb(colour)), lw=width, label=label)
    known = np.concatenate(list(errors.values()))
    known = known[~np.isnan(known)]
    # One gap in tracking must not flatten the rest of the curve.
    top = float(np.percentile(known, 99)) * 1.25 if len(known) else 1.0
    axes.set_ylim(0.0, max(top, 0.5))
    _legend_above(axes)


def _seen(axes: Axes, poses: Poses, seconds: Float) -> None:
    style(axes, "What was seen")
    name, points = ("markers", poses.markers_raw_m) if poses.marker_count else ("laser points", poses.laser_m)
    seen = (~np.isnan(points).any(axis=-1)).sum(axis=1)
    axes.plot(seconds, seen, color=unit(series_rgb(0)), lw=1.3, drawstyle="steps-mid", label=name)
    tracked = poses.tracked.sum(axis=1)
    axes.plot(
        seconds, tracked, color=unit(series_rgb(2)), lw=1.3, drawstyle="steps-mid", label="joints tracked"
    )
    axes.set_ylim(0.0, 27.0)
    _legend_above(axes)


def _histogram(axes: Axes, values: Float, title: str, what: str) -> None:
    style(axes, title)
    axes.set_xlabel(what, color=INK, size=10, labelpad=1)
    axes.set_ylabel("poses" if what == "ms" else "count", color=INK, size=10)
    if not len(values):
        axes.text(0.5, 0.5, "nothing measured", color=INK, ha="center", va="center", transform=axes.transAxes)
        return
    middle, tail = np.percentile(values, [50, 99])
    top = max(float(tail) * 1.35, 1e-3)
    bins = int(np.clip(2 * np.sqrt(len(values)), 12, 60))
    shown = np.minimum(values, top)  # the rare rest stands in the last bar
    heights = axes.hist(shown, bins=bins, range=(0.0, top), color=unit(series_rgb(1)), alpha=0.85)[0]
    axes.set_ylim(0.0, 1.2 * float(np.max(heights)))
    axes.set_xlim(0.0, top)
    label_width = 0.22  # of a panel
    # Near the axis there is no room on the left; on the right the two would meet, so one stands lower.
    side, height = ("right", 0.97) if middle > label_width * top else ("left", 0.86)
    for value, name, ha, y in ((middle, "p50", side, height), (tail, "p99", "left", 0.97)):
        axes.axvline(float(value), color=unit(series_rgb(0)), lw=1.4)
        gap = 4 if ha == "left" else -4
        axes.annotate(f"{name} {value:.1f} {what}", (float(value), y), (gap, 0), xycoords=axes.get_xaxis_transform(),
                      textcoords="offset points", color=INK, size=10, ha=ha, va="top")  # fmt: skip


def _legend_above(axes: Axes) -> None:
    legend = axes.legend(loc="lower right", bbox_to_anchor=(1.01, 0.98), ncols=5, frameon=False, fontsize=9.5,
                         handlelength=1.2, columnspacing=1.0, borderpad=0.2)  # fmt: skip
    for text in legend.get_texts():
        text.set_color(INK)
