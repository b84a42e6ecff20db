"""The picture of a soak: memory, latency, poses, clocks, over the minutes."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bench.soak_monitor import SoakHistory
from bench.soak_steps import steps_of
from bench.soak_verdict import memory_slope, slope, warm_up_s

_COLOURS = ("#14507a", "#b0473a", "#e0a030", "#3f8f5b", "#7a5ca8")
_GREY = "#777777"


def draw(history: SoakHistory, title: str, file: Path) -> None:
    """Write the PNG.

    Raises:
        OSError: The file cannot be written.
    """
    figure = Figure(figsize=(11.0, 8.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 2, sharex=True)
    _memory(axes[0, 0], history)
    _growth(axes[0, 1], history)
    _latency(axes[1, 0], history)
    _poses(axes[1, 1], history)
    _clocks(axes[2, 0], history)
    _cores(axes[2, 1], history)
    warm = warm_up_s(history.times_s[-1]) / 60.0 if history.times_s else 0.0
    for panel in axes.flat:
        panel.axvspan(0.0, warm, color="#000000", alpha=0.05, linewidth=0)
        panel.grid(alpha=0.25)
        panel.margins(x=0.01)
    for panel in axes[2]:
        panel.set_xlabel("minutes (grey: warm-up, not judged)")
    figure.suptitle(title, fontsize=11)
    figure.savefig(file)


def _memory(axes: Axes, history: SoakHistory) -> None:
    minutes = np.array(history.times_s) / 60.0
    for colour, name in zip(_COLOURS, history.footprints, strict=False):
        axes.plot(minutes, history.series(name, "rss_mb"), color=colour, label=name, linewidth=1.5)
        axes.plot(minutes, history.series(name, "uss_mb"), color=colour, linewidth=0.9, linestyle=":")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("memory [MB]\nresident; dotted: not shared")
    axes.legend(fontsize=8, ncols=3, loc="lower right")


def _growth(axes: Axes, history: SoakHistory) -> None:
    times = np.array(history.times_s)
    late = times >= (warm_up_s(times[-1]) if len(times) else 0.0)
    for colour, name in zip(_COLOURS, history.footprints, strict=False):
        values = np.array(history.series(name, "rss_mb"))
        found = memory_slope(history, name).per_h
        if late.any():
            label = f"{name} {found:+.2f} MB/h"
            axes.plot(
                times / 60.0, values - np.median(values[late][:12]), color=colour, label=label, linewidth=1.2
            )
        for step in steps_of(history.times_s, values) or []:
            axes.axvline(step.minute, color=colour, linewidth=1.0, linestyle="--")
            axes.text(step.minute, 2.6, f" +{step.mb:.0f} MB", color=colour, fontsize=8)
    axes.axhline(1.0, color=_GREY, linewidth=0.8, linestyle=":")
    axes.set_ylim(-3.0, 3.0)
    axes.set_ylabel("resident memory since\nthe warm-up [MB]")
    axes.legend(fontsize=8, ncols=2, loc="lower right")


def _latency(axes: Axes, history: SoakHistory) -> None:
    minutes = [one.t_s / 60.0 for one in history.minutes]
    axes.plot(minutes, [one.p50_ms for one in history.minutes], color=_COLOURS[0], label="p50")
    axes.plot(minutes, [one.p99_ms for one in history.minutes], color=_COLOURS[1], label="p99")
    axes.set_yscale("log")
    axes.set_ylabel("latency of poses [ms]")
    axes.legend(fontsize=8, loc="upper left")
    right_axes = axes.twinx()
    right_axes.plot(minutes, [one.load for one in history.minutes], color=_GREY, linewidth=0.9, linestyle=":")
    right_axes.set_ylim(bottom=0.0)
    right_axes.set_ylabel("load of the machine (dotted)", color=_GREY, fontsize=8)


def _poses(axes: Axes, history: SoakHistory) -> None:
    minutes = [one.t_s / 60.0 for one in history.minutes]
    axes.plot(minutes, [one.poses_hz for one in history.minutes], color=_COLOURS[0], label="poses [1/s]")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("poses a second")
    right_axes = axes.twinx()
    for colour, name in zip(_COLOURS[1:], ("lost", "dropped", "skipped"), strict=False):
        totals = [one.counts.get(name, 0) for one in history.minutes]
        right_axes.plot(
            minutes, totals, color=colour, linewidth=1.2, label=f"{name}: {totals[-1] if totals else 0}"
        )
    right_axes.set_ylabel("since the start", fontsize=8)
    right_axes.legend(fontsize=8, loc="lower right")


def _clocks(axes: Axes, history: SoakHistory) -> None:
    """What is left of each clock's offset after the straight line that its quartz is."""
    late = [one for one in history.minutes if one.t_s > warm_up_s(history.minutes[-1].t_s)]
    names = sorted({name for one in late for name in one.clock_offset_us})
    for colour, name in zip(_COLOURS, names, strict=False):
        known = [(one.t_s, one.clock_offset_us[name]) for one in late if name in one.clock_offset_us]
        if len(known) > 2:
            times, offsets = np.array(known).T
            ppm = slope(times, offsets).per_h / 3600.0
            left = offsets - ppm * times
            label = f"{name} {ppm:+.2f} ppm"
            axes.plot(times / 60.0, left - np.median(left), color=colour, linewidth=1.0, label=label)
    axes.set_ylabel("clock, without its\nstraight line [us]")
    if axes.lines:
        axes.legend(fontsize=8, ncols=2, loc="lower right")


def _cores(axes: Axes, history: SoakHistory) -> None:
    minutes = [one.t_s / 60.0 for one in history.minutes]
    for colour, name in zip(_COLOURS, history.footprints, strict=False):
        axes.plot(minutes, [one.cores.get(name, 0.0) for one in history.minutes], color=colour, label=name)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("processor [cores]")
    axes.legend(fontsize=8, ncols=3, loc="upper right")
