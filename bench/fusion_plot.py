"""The figure of fusion: errors of PIP and joints by scene, fused and alone, and a grasp in time."""

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bench.fusion_outcome import KINDS, Kind, Outcome
from bench.fusion_score import ABOUT_S
from common.arrays import Float

_COLOURS: dict[Kind, str] = {"fused": "#14507a", "markers": "#b0473a", "wrist": "#e0a030"}
_NAMES: dict[Kind, str] = {"fused": "fused", "markers": "marker rig alone", "wrist": "wrist device alone"}
_GRASP, _ROUND_S = "grasp", 14.0


def draw(found: Mapping[str, Outcome], file: Path) -> None:
    """Draw the outcomes of scenes, `grasp` among them, into a PNG."""
    figure = Figure(figsize=(11.0, 6.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2)
    _bars(
        figure.add_subplot(grid[0, 0]),
        {n: _of(one, "four_deg") for n, one in found.items()},
        "mean PIP error [°]",
    )
    _bars(
        figure.add_subplot(grid[0, 1]),
        {n: _of(one, "joint_mm") for n, one in found.items()},
        "mean joint error [mm]; wrist device: placed by the truth",
    )
    below = figure.add_subplot(grid[1, :])
    _timeline(below, found[_GRASP])
    figure.legend(*below.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)
    figure.savefig(file)


def _of(found: Outcome, field: str) -> dict[Kind, float]:
    return {kind: cast(float, getattr(found.figures[kind], field)) for kind in KINDS}


def _bars(axes: Axes, scenes: dict[str, dict[Kind, float]], title: str) -> None:
    for k, kind in enumerate(KINDS):
        place = np.arange(len(scenes)) + 0.27 * (k - 1)
        bars = axes.bar(place, [each[kind] for each in scenes.values()], 0.25, color=_COLOURS[kind])
        axes.bar_label(bars, fmt="%.1f", fontsize=7)
    axes.set_xticks(np.arange(len(scenes)), list(scenes), fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)


def _timeline(axes: Axes, found: Outcome) -> None:
    """Mean PIP error of the four fingers through the first round, and when no two cameras see them."""
    until_s = min(_ROUND_S, found.shown.seconds)
    for kind in reversed(KINDS):
        one = found.solved[kind]
        early = one.t_s < until_s
        four = one.pip_deg[early, 1:]
        known = np.isfinite(four)
        mean = np.where(known, four, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        mean = np.where(known.any(axis=1), mean, np.nan)
        axes.plot(one.t_s[early], mean, color=_COLOURS[kind], linewidth=1.4, label=_NAMES[kind])
    t_s: Float = np.arange(0.0, until_s, 0.02)
    hidden = (found.shown.line_of_sight.cameras_of(t_s, ABOUT_S)[:, 1:5] < 2).mean(axis=1)
    shade = axes.twinx()
    shade.fill_between(t_s, hidden, step="mid", color="#bbbbbb", alpha=0.4, linewidth=0.0)
    shade.set_ylim(0.0, 1.0)
    shade.set_yticks([0.0, 1.0], ["0", "all"], fontsize=8)
    shade.set_ylabel("fingers that no two cameras see", fontsize=8)
    axes.fill_between([], [], color="#bbbbbb", alpha=0.4, label="hidden from the cameras")
    axes.set_zorder(shade.get_zorder() + 1)
    axes.patch.set_visible(False)
    axes.set_xlim(1.0, until_s)
    axes.set_ylim(0.0, None)
    axes.set_xlabel("grasp: reach, close, lift, turn, put back, release [s]", fontsize=9)
    axes.set_ylabel("PIP error, mean of four fingers [°]", fontsize=8)
    axes.grid(alpha=0.25)
