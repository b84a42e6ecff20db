"""Plot of the study results.

Errors by finger and pose, cells that are not reached, the paper's figures, ICC.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from common.calibration.replacing import replacing
from common.errors import RecordingError
from common.hand.model import FINGERS
from common.sim.motion import POSES
from master.study import paper
from master.study.report import Result
from master.study.statistics import Cell, Repeated
from master.study.trials import LETTERS

_COLOURS = ("#2b6cb0", "#2f855a", "#805ad5", "#b7791f", "#c2571a", "#718096")  # poses A ... F
_GREY, _RED = "#8a8a8a", "#c53030"
_NONE: dict[str, Any] = {"facecolor": "none", "edgecolor": "#cccccc", "hatch": "////", "linewidth": 0.0}
_WIDTH = 0.13  # of a bar; a finger is 1 wide
_TOP_DEG = 45.0  # taller bars are cut, and are marked


def draw_study(path: Path, result: Result) -> None:
    """Write the picture as PNG.

    Raises:
        RecordingError: The file cannot be written.
    """
    figure = Figure(figsize=(14.0, 5.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    people = len({one.participant for one in result.trials[result.judged]})
    figure.suptitle(
        f"{result.title}: {people} participants, {result.judged}; open loop (the paper's was closed)"
    )
    bars, icc = figure.subplots(1, 2, width_ratios=(3.2, 1.0))
    _bars(bars, result.cells())
    _icc(icc, result.repeated())
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror}") from error


def _bars(axes: Axes, cells: list[Cell]) -> None:
    poses = [pose for pose in POSES if any(cell.pose == pose for cell in cells)]
    highest = [cell.mean_deg + np.nan_to_num(cell.sd_deg) for cell in cells if cell.is_reached]
    top = min(_TOP_DEG, max([*highest, paper.MEAN_LIMIT_DEG]) * 1.12)
    for cell in cells:
        place = _WIDTH * (poses.index(cell.pose) - 0.5 * (len(poses) - 1))
        _bar(axes, cell, FINGERS.index(cell.finger) + place, top)
    limit = axes.axhline(paper.MEAN_LIMIT_DEG, color=_RED, linewidth=1.0, linestyle="--")
    limit.set_label(f"paper: every mean below {paper.MEAN_LIMIT_DEG:g}°")
    for finger, (low, high) in paper.MEAN_RANGE_DEG.items():
        x = FINGERS.index(finger)
        axes.fill_between([x - 0.47, x + 0.47], low, high, color=_RED, alpha=0.15, linewidth=0.0)
    axes.set(xticks=range(len(FINGERS)), ylim=(0.0, top), xlim=(-0.5, len(FINGERS) - 0.5))
    axes.set_xticklabels(["thumb (MCP)", *FINGERS[1:]])
    axes.set_ylabel("absolute error of the PIP [°], mean ± sd")
    letters = {pose: letter for letter, pose in LETTERS.items()}
    shown = [Patch(color=_colour(pose), label=f"{letters[pose]}  {pose.replace('_', ' ')}") for pose in poses]
    none = Patch(label="not reached: tracked in fewer than half of the trials", **_NONE)
    band = Patch(color=_RED, alpha=0.15, label="paper: means over its poses")
    axes.legend(
        handles=[*shown, none, limit, band],
        fontsize=7.5,
        ncols=3,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.06),
        frameon=False,
    )


def _bar(axes: Axes, cell: Cell, x: float, top: float) -> None:
    """One cell at x; one that is not reached is hatched over the whole height."""
    width = 0.92 * _WIDTH
    if not cell.is_reached:
        axes.bar(x, top, width, **_NONE)
        text = f"{cell.reached}/{cell.trials}"
        axes.text(x, 0.02 * top, text, rotation=90, ha="center", va="bottom", fontsize=7, color=_GREY)
        return
    colour = _colour(cell.pose)
    axes.bar(x, cell.mean_deg, width, color=colour)
    if not math.isnan(cell.sd_deg):
        axes.errorbar(x, cell.mean_deg, cell.sd_deg, color="#444444", capsize=1.5, linewidth=0.8)
    if cell.mean_deg > top:
        axes.text(x, top, f"{cell.mean_deg:.0f}", ha="center", va="bottom", fontsize=7, color=colour)


def _colour(pose: str) -> str:
    return _COLOURS[list(POSES).index(pose)]


def _icc(axes: Axes, again: list[Repeated]) -> None:
    x = np.arange(len(FINGERS))
    own = np.array([one.icc for one in again])
    axes.bar(x - 0.2, np.nan_to_num(own), 0.36, color="#2b6cb0", label="ours")
    axes.bar(x + 0.2, [paper.ICC[name] for name in FINGERS], 0.36, color="#d9a5a5", label="paper")
    axes.plot(
        x - 0.2, [one.truth_icc for one in again], "_", color="black", markersize=12, label="true poses"
    )
    for at, one in zip(x, again, strict=True):
        if math.isnan(one.icc):
            axes.text(at - 0.2, 0.02, "none", rotation=90, ha="center", va="bottom", fontsize=8, color=_GREY)
    axes.axhline(paper.ICC_GOAL, color=_RED, linewidth=1.0, linestyle="--")
    axes.set(
        xticks=x,
        ylim=(min(0.0, float(np.nanmin(np.append(own, 0.0)))), 1.05),
        title="ICC(1,1) between blocks",
    )
    axes.set_xticklabels(FINGERS, rotation=30)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, frameon=False)
