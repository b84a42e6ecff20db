"""One hand of markers and wrist device against each sensor alone, and with either stream gone and back; exact truth.

The same messages go to three pipelines: of both, of the marker rig, of the wrist device. The latter knows no place: its
hand is put where the wrist joint truly is, turned as the palm truly is. *Better* is the sensor with the smaller error,
each compared over what it and the fused hand call valid (`bench.both.score`).

    python -m bench fusion                              every scene, rendered and detected
    python -m bench fusion grasp --seconds 13 --quick   some scenes, with messages made of truth
    python -m bench fusion --picture docs/images/fusion.png
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
from matplotlib.axes import Axes

from bench.both.scene import SCENES, Both, Shown
from bench.both.score import ABOUT_S, Figures, Ratios, Sighted, ratios
from bench.both.shown import shown_of
from bench.both.solved import RejectedPeer, Solved, solve
from bench.both.watched import watched
from bench.report import Row, figure, show
from common.arrays import Float
from common.hand.model import FINGERS
from master.rig.setup import RigSetup

Kind = Literal["fused", "markers", "wrist"]
KINDS: tuple[Kind, ...] = ("fused", "markers", "wrist")
_SECONDS, _CUT_SECONDS, _SEED = 24.0, 60.0, 41
_CUT = ("both-travel", "both-poses")
_WORSE, _GAIN = 1.05, 0.25  # never worse than the better by more, and in the mean better by at least so much
_COLOURS: dict[Kind, str] = {"fused": "#14507a", "markers": "#b0473a", "wrist": "#e0a030"}
_ROUND_S = 14.0


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Results of the pipelines on one scene: its messages and truth, each pipeline's poses, and their figures."""

    shown: Shown
    solved: dict[Kind, Solved]
    figures: dict[Kind, Figures]

    @classmethod
    def of(cls, shown: Shown, kinds: Sequence[Kind] = KINDS, away: RejectedPeer | None = None) -> "Outcome":
        """Solve and judge the scene with these pipelines, with streams cut off if asked."""
        both = shown.both
        setups: dict[Kind, RigSetup] = {"fused": both.fused, "markers": both.markers, "wrist": both.wrist}
        messages = shown.messages if away is None else away.left(shown.messages)
        solved: dict[Kind, Solved] = {}
        figures: dict[Kind, Figures] = {}
        for kind in kinds:
            solved[kind] = Solved.of(both, solve(setups[kind], messages), setups[kind])
            figures[kind] = Figures.of(solved[kind], Sighted.of(shown, solved[kind], away))
        return cls(shown, solved, figures)

    @property
    def ratios(self) -> Ratios:
        """Errors of the fused hand by those of the better sensor alone."""
        each = [ratios(self.solved["fused"], self.solved[kind]) for kind in KINDS[1:]]
        return Ratios(*(float(max(pair)) for pair in zip(*each, strict=True)))


def rows(
    scenes: Sequence[str] = SCENES,
    cut: Sequence[str] = _CUT,
    seconds: float = _SECONDS,
    seed: int = _SEED,
    *,
    quick: bool = False,
) -> Iterator[Row]:
    """Measure scenes, their comparison, and some with streams cut off."""
    make = shown_of if quick else watched
    each: dict[str, Ratios] = {}
    for name in scenes:
        found = Outcome.of(make(Both.of(name, seed), seconds))
        each[name] = found.ratios
        yield from _scene(name, found.figures)
    for what, field in (("joints", "joints"), ("fingers", "fingers"), ("PIP", "pip")):
        values = {name: cast(float, getattr(one, field)) for name, one in each.items()}
        for name, value in values.items():
            yield Row(f"{name}: fused / better alone, {what}", value, "x", f"goal {_WORSE} or less")
        if values:
            gain = 100.0 * (1.0 - float(np.mean(list(values.values()))))
            note = f"goal {100 * _GAIN:.0f} or more"
            yield Row(f"fused better than the better alone, {what}, mean", gain, "%", note)
    for name in cut:
        figures = Outcome.of(make(Both.of(name, seed), _CUT_SECONDS), KINDS[:1], RejectedPeer()).figures
        yield from _scene(f"{name}, one of both cut off for a second, every two", figures)


def _scene(name: str, figures: Mapping[Kind, Figures]) -> Iterator[Row]:
    ours = figures["fused"]

    def row(what: str, field: str, unit: str, note: str = "", times: float = 1.0) -> Row:
        alone = (
            f"{kind} {times * getattr(figures[kind], field):.1f}" for kind in KINDS[1:] if kind in figures
        )
        return Row(
            what, times * getattr(ours, field), unit, "; ".join(filter(None, (", ".join(alone), note)))
        )

    fingers = ", ".join(f"{f} {d:.1f}" for f, d in zip(FINGERS, ours.pip_deg, strict=True))
    why = f"of its bits {100 * ours.unseen:.3f} % see nothing, {100 * ours.off:.3f} % are off by 20 mm"
    yield row(f"{name}: joints", "joint_mm", "mm")
    yield row("  fingers, palm put where it is", "fingers_mm", "mm")
    yield row("  PIP of four fingers (thumb: MCP)", "four_deg", "deg", fingers)
    yield row("  PIP of fingers hidden from the cameras", "hidden_deg", "deg")
    yield row("  joints valid", "valid", "%", times=100.0)
    yield row("  joints tracked", "tracked", "%", times=100.0)
    yield row("  inside 95 %", "inside", "%", times=100.0)
    yield row(
        "  inside 95 %, half a second about hand-overs", "inside_hand_over", "%", "goal 90 to 98", 100.0
    )
    yield row(
        "  largest step beyond the truth's", "step_mm", "mm", f"{ours.over_step:.1f} over 5 mm a minute"
    )
    yield row("  poses with a false TRACKED bit", "false_tracked", "%", why, 100.0)


def picture(file: Path, seconds: float = _SECONDS) -> None:
    """Draw errors of PIP and joints by scene, fused and alone, and a grasp in time."""
    found = {name: Outcome.of(watched(Both.of(name, _SEED), seconds)) for name in SCENES}
    made = figure(11.0, 6.4)
    grid = made.add_gridspec(2, 2)
    titles = {
        "four_deg": "mean PIP error [°]",
        "joint_mm": "mean joint error [mm]; wrist: placed by the truth",
    }
    for column, (field, title) in enumerate(titles.items()):
        axes = made.add_subplot(grid[0, column])
        for k, kind in enumerate(KINDS):
            values = [cast(float, getattr(one.figures[kind], field)) for one in found.values()]
            bars = axes.bar(np.arange(len(found)) + 0.27 * (k - 1), values, 0.25, color=_COLOURS[kind])
            axes.bar_label(bars, fmt="%.1f", fontsize=7)
        axes.set_xticks(np.arange(len(found)), list(found), fontsize=8)
        axes.set_title(title, fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    below = made.add_subplot(grid[1, :])
    _course(below, found["grasp"])
    made.legend(*below.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)
    made.savefig(file)


def _course(axes: Axes, found: Outcome) -> None:
    """Mean PIP error of the four fingers through the first round, and when no two cameras see them."""
    until_s = min(_ROUND_S, found.shown.seconds)
    for kind in reversed(KINDS):
        one = found.solved[kind]
        early = one.t_s < until_s
        four = one.pip_deg[early, 1:]
        known = np.isfinite(four)
        mean = np.where(known, four, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        mean = np.where(known.any(axis=1), mean, np.nan)
        name = kind if kind == "fused" else f"{kind} alone"
        axes.plot(one.t_s[early], mean, color=_COLOURS[kind], linewidth=1.4, label=name)
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


def main(arguments: Sequence[str]) -> None:
    """Print the rows of some scenes."""
    keep = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m bench fusion", description=__doc__, formatter_class=keep)
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help=f"default: {' '.join(SCENES)}, and both cuts"
    )
    parser.add_argument(
        "--cut", nargs="*", default=[], metavar="SCENE", help="these with streams cut off as well"
    )
    parser.add_argument(
        "--seconds", type=float, default=_SECONDS, help="of the scenes; those cut off last a minute"
    )
    parser.add_argument("--seed", type=int, default=_SEED)
    parser.add_argument(
        "--quick", action="store_true", help="messages made of truth instead of rendered frames"
    )
    given = parser.parse_args(arguments)
    scenes = given.scenes or (() if given.cut else SCENES)
    show(
        rows(
            scenes, given.cut or (() if given.scenes else _CUT), given.seconds, given.seed, quick=given.quick
        )
    )
