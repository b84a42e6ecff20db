"""One hand of markers and wrist device against each sensor alone, and with either stream gone and back; exact truth.

The same messages go to three pipelines: of both, of the marker rig, of the wrist device. The latter knows no place: its
hand is put where the wrist joint truly is, turned as the palm truly is. *Better* is the sensor with the smaller error,
each compared over what it and the fused hand call valid. What else is meant by the figures is in `fusion_score`.

`python -m bench.fusion --mode quick grasp` does it for some scenes without rendering (`fusion_shown`).
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import cast

import numpy as np

from bench.fusion_kept import Mode
from bench.fusion_outcome import KINDS, Outcome, cut_off, solved
from bench.fusion_scene import SCENES
from bench.fusion_score import Figures, Ratios
from bench.row import Row
from common.hand.model import FINGERS

SECONDS, CUT_SECONDS, SEED = 24.0, 60.0, 41
CUT = ("both-travel", "both-poses")
WORSE, GAIN = 1.05, 0.25  # never worse than the better by more, and in the mean better by at least so much


def rows() -> Iterator[Row]:
    """All scenes, and two of them with streams cut off."""
    yield from table(solved(SCENES, SECONDS, SEED, "rendered"), cut_off(CUT, CUT_SECONDS, SEED, "rendered"))


def table(found: Mapping[str, Outcome], cut: Mapping[str, Figures]) -> Iterator[Row]:
    """The rows of scenes, the comparison of all of them, and of some with streams cut off."""
    for name, one in found.items():
        yield from _scene(name, one)
    yield from _compared({name: one.ratios for name, one in found.items()})
    for name, figures in cut.items():
        yield from _cut(name, figures)


def _scene(name: str, found: Outcome) -> Iterator[Row]:
    ours, markers, wrist = (found.figures[kind] for kind in KINDS)

    def alone(a: float, b: float, digits: int = 1) -> str:
        return f"markers {a:.{digits}f}, wrist {b:.{digits}f}"

    yield Row(f"{name}: joints", ours.joint_mm, "mm", alone(markers.joint_mm, wrist.joint_mm))
    yield Row(
        "  fingers, palm put where it is", ours.fingers_mm, "mm", alone(markers.fingers_mm, wrist.fingers_mm)
    )
    fingers = ", ".join(f"{f} {d:.1f}" for f, d in zip(FINGERS[1:], ours.pip_deg[1:], strict=True))
    yield Row("  PIP", ours.four_deg, "deg", f"{alone(markers.four_deg, wrist.four_deg)}; {fingers}")
    yield Row(
        "  PIP of fingers hidden from the cameras",
        ours.hidden_deg,
        "deg",
        alone(markers.hidden_deg, wrist.hidden_deg),
    )
    yield Row("  thumb's MCP", ours.pip_deg[0], "deg", alone(markers.pip_deg[0], wrist.pip_deg[0]))
    yield Row("  joints valid", 100 * ours.valid, "%", alone(100 * markers.valid, 100 * wrist.valid))
    yield Row("  joints tracked", 100 * ours.tracked, "%", alone(100 * markers.tracked, 100 * wrist.tracked))
    yield from _coverage(ours, alone(100 * markers.inside, 100 * wrist.inside))
    yield from _steps(ours, alone(markers.step_mm, wrist.step_mm))
    yield from _bits(ours, alone(100 * markers.false_tracked, 100 * wrist.false_tracked))


def _coverage(ours: Figures, note: str) -> Iterator[Row]:
    yield Row("  inside 95 %", 100 * ours.inside, "%", note)
    yield Row(
        "  inside 95 %, half a second about hand-overs", 100 * ours.inside_hand_over, "%", "goal 90 to 98"
    )


def _steps(ours: Figures, note: str) -> Iterator[Row]:
    yield Row(
        "  largest step beyond the truth's",
        ours.step_mm,
        "mm",
        f"{note}; {ours.over_step:.1f} over 5 mm a minute",
    )


def _bits(ours: Figures, note: str) -> Iterator[Row]:
    why = f"of its bits {100 * ours.unseen:.3f} % see nothing, {100 * ours.off:.3f} % are off by 20 mm"
    yield Row("  poses with a false TRACKED bit", 100 * ours.false_tracked, "%", f"{note}; {why}")


def _compared(each: Mapping[str, Ratios]) -> Iterator[Row]:
    for what, field in (("joints", "joints"), ("fingers", "fingers"), ("PIP", "pip")):
        values = {name: cast(float, getattr(one, field)) for name, one in each.items()}
        for name, value in values.items():
            note = f"goal {WORSE} or less: {_met(value <= WORSE)}"
            yield Row(f"{name}: fused / better alone, {what}", value, "x", note)
        if values:
            gain = 1.0 - float(np.mean(list(values.values())))
            note = f"goal {100 * GAIN:.0f} or more: {_met(gain >= GAIN)}"
            yield Row(f"fused better than the better alone, {what}, mean", 100 * gain, "%", note)


def _cut(name: str, ours: Figures) -> Iterator[Row]:
    yield Row(
        f"{name}, streams cut off in turn: joints", ours.joint_mm, "mm", "one of both for a second, every two"
    )
    yield Row("  PIP", ours.four_deg, "deg", "")
    yield Row("  joints valid", 100 * ours.valid, "%", f"tracked {100 * ours.tracked:.0f}")
    yield from _coverage(ours, "")
    yield from _steps(ours, "goal 5")
    yield from _bits(ours, "goal 0")


def _met(there: bool) -> str:
    return "met" if there else "NOT MET"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the rows of some scenes; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.fusion", description=__doc__)
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help=f"by default {' '.join(SCENES)}, and both cuts"
    )
    parser.add_argument("--cut", nargs="*", metavar="SCENE", help="these with streams cut off as well")
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, help="of the scenes; those cut off last a minute"
    )
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--mode", choices=("rendered", "quick"), default="rendered")
    options = parser.parse_args(arguments)
    scenes = cast(list[str], options.scenes) or list(SCENES)
    asked = cast(list[str] | None, options.cut)
    cut = (() if options.scenes else CUT) if asked is None else asked
    mode = cast(Mode, options.mode)
    found = solved(scenes, options.seconds, options.seed, mode)
    for row in table(found, cut_off(cut, CUT_SECONDS, options.seed, mode)):
        print(f"{row.name:58s} {row.value:10.4g} {row.unit:5s} {row.note}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
