"""What the pipelines of both sensors, of the marker rig and of the wrist device make of the same messages."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from bench.fusion_kept import Mode, observed
from bench.fusion_scene import Shown
from bench.fusion_score import Figures, Ratios, Sighted, ratios
from bench.fusion_solved import RejectedPeer, Solved, solve
from master.rig.setup import RigSetup

Kind = Literal["fused", "markers", "wrist"]
KINDS: tuple[Kind, ...] = ("fused", "markers", "wrist")


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What the pipelines made of one scene.

    Attributes:
        shown: The scene's messages and truth.
        solved: Each pipeline's poses beside the truth.
        figures: How good they are.
    """

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
        """Fused by the better sensor alone."""
        each = [ratios(self.solved["fused"], self.solved[kind]) for kind in KINDS[1:]]
        return Ratios(*(float(max(pair)) for pair in zip(*each, strict=True)))


def solved(scenes: Sequence[str], seconds: float, seed: int, mode: Mode) -> dict[str, Outcome]:
    """What the three pipelines make of scenes."""
    return {name: Outcome.of(observed(name, seconds, seed, mode)) for name in scenes}


def cut_off(scenes: Sequence[str], seconds: float, seed: int, mode: Mode) -> dict[str, Figures]:
    """How good the fused hand is in scenes while either stream goes and returns."""
    return {
        name: Outcome.of(observed(name, seconds, seed, mode), KINDS[:1], RejectedPeer()).figures["fused"]
        for name in scenes
    }
