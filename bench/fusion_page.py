"""`python -m bench.fusion_page FILE.png`: tables and figure of docs/fusion.md, rendered, detected and solved."""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from math import isnan
from pathlib import Path

import numpy as np

from bench.fusion import CUT, CUT_SECONDS, GAIN, SECONDS, SEED, WORSE
from bench.fusion_outcome import KINDS, Outcome, cut_off, solved
from bench.fusion_plot import draw
from bench.fusion_scene import SCENES
from bench.fusion_score import Figures


def main(arguments: Sequence[str] | None = None) -> int:
    """Print and draw; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.fusion_page", description=__doc__)
    parser.add_argument("file", type=Path, help="PNG to write")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each scene")
    parser.add_argument(
        "--cut-seconds", type=float, default=CUT_SECONDS, help="of those with streams cut off"
    )
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args(arguments)
    found = solved(SCENES, options.seconds, options.seed, "rendered")
    draw(found, options.file)
    for line in [*errors(found), *bars(found), *trust(found)]:
        print(line, flush=True)
    for line in away(cut_off(CUT, options.cut_seconds, options.seed, "rendered")):
        print(line)
    return 0


def errors(found: Mapping[str, Outcome]) -> Iterator[str]:
    """Mean errors, fused / markers / wrist."""
    yield "| scene | joints, mm | fingers in a true palm, mm | PIP, ° | PIP of hidden fingers, ° | thumb's MCP, ° |"
    yield "|---|--:|--:|--:|--:|--:|"
    for name, one in found.items():
        each = [one.figures[kind] for kind in KINDS]
        columns = (
            [f.joint_mm for f in each],
            [f.fingers_mm for f in each],
            [f.four_deg for f in each],
            [f.hidden_deg for f in each],
            [f.pip_deg[0] for f in each],
        )
        yield _line(name, *(_three(values) for values in columns))
    yield ""


def bars(found: Mapping[str, Outcome]) -> Iterator[str]:
    """Fused by the better sensor alone, and whether that is as it should be."""
    yield "| fused / better alone | joints | fingers in a true palm | PIP |"
    yield "|---|--:|--:|--:|"
    every = np.array([one.ratios for one in found.values()])
    for name, row in zip(found, every.tolist(), strict=True):
        yield _line(name, *(f"{value:.2f} {_met(value <= WORSE)}" for value in row))
    gains = (1.0 - every.mean(axis=0)).tolist()
    yield _line("better in the mean by", *(f"{100 * gain:.0f} % {_met(gain >= GAIN)}" for gain in gains))
    yield ""


def trust(found: Mapping[str, Outcome]) -> Iterator[str]:
    """Doubt, bits and steps, fused / markers / wrist."""
    yield (
        "| scene | valid, % | tracked, % | inside 95 % | about hand-overs | largest step, mm "
        "| steps > 5 mm a minute | poses with a false TRACKED, % |"
    )
    yield "|---|--:|--:|--:|--:|--:|--:|--:|"
    for name, one in found.items():
        each = [one.figures[kind] for kind in KINDS]
        columns = (
            [100 * f.valid for f in each],
            [100 * f.tracked for f in each],
            [100 * f.inside for f in each],
            [100 * f.inside_hand_over for f in each],
            [f.step_mm for f in each],
            [f.over_step for f in each],
            [100 * f.false_tracked for f in each],
        )
        yield _line(name, *(_three(values, 0 if k < 2 else 1) for k, values in enumerate(columns)))
    yield ""


def away(cut: Mapping[str, Figures]) -> Iterator[str]:
    """The fused hand while either stream goes and returns."""
    yield (
        "| scene | joints, mm | PIP, ° | valid, % | tracked, % | inside 95 % | about hand-overs | largest step, mm "
        "| steps > 5 mm a minute | poses with a false TRACKED, % (bits that see nothing, that are 20 mm off) |"
    )
    yield "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
    for name, f in cut.items():
        shares = (f"{100 * value:.1f}" for value in (f.valid, f.tracked, f.inside, f.inside_hand_over))
        false = f"{100 * f.false_tracked:.1f} ({100 * f.unseen:.2f}, {100 * f.off:.2f})"
        yield _line(
            name,
            f"{f.joint_mm:.1f}",
            f"{f.four_deg:.1f}",
            *shares,
            f"{f.step_mm:.1f}",
            f"{f.over_step:.0f}",
            false,
        )


def _three(values: Sequence[float], digits: int = 1) -> str:
    first, *others = ("–" if isnan(value) else f"{value:.{digits}f}" for value in values)
    return " / ".join([f"**{first}**", *others])


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _met(there: bool) -> str:
    return "met" if there else "**not met**"


if __name__ == "__main__":
    sys.exit(main())
