"""`python -m bench.sync_plot FILE.png`: error of depth against the offset of two cameras, by rate and treatment."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bench.sync import GOAL, RATES_HZ, STRETCH
from bench.sync_rig import MOTIONS, Shooting, Treatment, outcome

OFFSETS_MS = np.linspace(0.0, 16.7, 25)
_SEEDS = range(2)
_LINES: tuple[tuple[str, Treatment, str, str], ...] = (
    ("crossing", "uncorrected", "crossing, frames paired by number", "#b0473a"),
    ("swing 10 cm", "predict", "swing of 10 cm, predict", "#e0a030"),
    ("crossing", "predict", "crossing, predict", "#7a5c00"),
    ("swing 10 cm", "interpolate", "swing of 10 cm, interpolate", "#6fb0d8"),
    ("crossing", "interpolate", "crossing, interpolate (default)", "#14507a"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.sync_plot", description=__doc__)
    parser.add_argument("file", type=Path, help="PNG to write")
    file: Path = parser.parse_args(arguments).file
    figure = Figure(figsize=(11.0, 4.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panels: list[Axes] = []
    for k, rate in enumerate(RATES_HZ):
        panels.append(figure.add_subplot(1, len(RATES_HZ), k + 1, sharey=panels[0] if panels else None))
        _panel(panels[-1], rate)
    panels[0].set_ylabel("error of depth, 95 % of places [%]")
    panels[1].set_xlabel("second camera later by [ms]")
    figure.legend(
        *panels[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=len(_LINES)
    )
    figure.savefig(file)
    print(file)
    return 0


def _panel(axes: Axes, rate_hz: float) -> None:
    for motion, treatment, label, colour in _LINES:
        found = [
            outcome(MOTIONS[motion], Shooting(rate_hz, offset * 1e-3), treatment, _SEEDS)
            for offset in OFFSETS_MS
        ]
        error = [float(np.percentile(np.abs(one.depth), 95)) for one in found]
        axes.plot(OFFSETS_MS, error, color=colour, label=label, linewidth=1.8)
    for value, name in ((GOAL, "goal"), (STRETCH, "stretch")):
        axes.axhline(value, color="#555555", linewidth=0.8, linestyle=":")
        axes.text(3.5, value * 1.04, f"{name} {value:g} %", fontsize=8, color="#555555")
    axes.set_yscale("log")
    axes.set_ylim(0.15, 40.0)
    axes.set_yticks([0.2, 0.5, 1, 2, 5, 10, 20], ["0.2", "0.5", "1", "2", "5", "10", "20"])
    axes.minorticks_off()
    axes.set_title(f"{rate_hz:.0f} Hz", fontsize=10)
    axes.grid(alpha=0.25)
    axes.label_outer()


if __name__ == "__main__":
    sys.exit(main())
