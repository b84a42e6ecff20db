"""One hand of markers and wrist device against each sensor alone, on the same messages, by exact truth.

Each scene is rendered, detected and solved by three pipelines: of both sensors, of the marker rig, of the wrist device,
whose hand is put where the wrist joint truly is. *Better* is the sensor with the smaller error (`ratios`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Self

import numpy as np

from bench.both.scene import SCENES, Both, Shown, Solved, Visibility, solve, watched
from bench.report import Row, inside
from common.arrays import Float
from common.hand.model import FINGERS
from master.rig.setup import RigSetup


@dataclass(frozen=True, slots=True)
class Figures:
    """What a pipeline reached in a scene."""

    joint_mm: float  # mean error of all valid joints
    fingers_mm: float  # of those beyond the knuckles, were the palm where it truly is
    pip_deg: tuple[float, ...]  # mean error of the PIP of thumb (its MCP) ... little, where valid
    four_deg: float  # the same of the four fingers together
    hidden_deg: float  # the same while the finger's marker is in sight of fewer than two cameras
    valid: float  # share of joints
    tracked: float  # share of joints
    inside: float  # share of valid joints in their 95 % region
    false_tracked: float  # share of poses with a TRACKED joint that is 20 mm off

    @classmethod
    def of(cls, solved: Solved, visibility: Visibility) -> Self:
        """Compare poses with the truth."""
        about_s = 0.04  # a frame and a bit of every sensor: what was in sight then tells of a pose
        hidden = visibility.cameras_of(solved.t_s, about_s)[:, :5] < 2
        off_mm, pip, chi2 = solved.off_mm, solved.pip_deg, solved.joint_chi2
        known = chi2[np.isfinite(chi2)]
        far = solved.poses.tracked[:, 1:] & (off_mm > 20.0)
        return cls(
            joint_mm=_mean(off_mm),
            fingers_mm=_mean(solved.fingers_mm),
            pip_deg=tuple(_mean(pip[:, f]) for f in range(5)),
            four_deg=_mean(pip[:, 1:]),
            hidden_deg=_mean(np.where(hidden, pip, np.nan)[:, 1:]),
            valid=float(solved.poses.valid[:, 1:].mean()),
            tracked=float(solved.poses.tracked[:, 1:].mean()),
            inside=0.01 * inside(known),
            false_tracked=float(far.any(axis=1).mean()),
        )


class Ratios(NamedTuple):
    """Mean error of the fused hand by that of a sensor alone: joints, fingers in a true palm, PIP of four fingers."""

    joints: float
    fingers: float
    pip: float


def _mean(values: Float) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def ratios(fused: Solved, alone: Solved) -> Ratios:
    """Over the joints, fingers and moments that both call valid."""
    place = np.clip(np.searchsorted(fused.poses.t_ns, alone.poses.t_ns), 1, len(fused.t_s) - 1)
    before = fused.poses.t_ns[place] - alone.poses.t_ns > alone.poses.t_ns - fused.poses.t_ns[place - 1]
    place = place - before
    same_ns = 17_000_000  # poses of two pipelines are compared that are no farther apart
    near = np.abs(fused.poses.t_ns[place] - alone.poses.t_ns) <= same_ns

    def ratio(ours: Float, theirs: Float) -> float:
        ours = np.where(near[:, None], ours[place], np.nan)
        both = np.isfinite(ours) & np.isfinite(theirs)
        return float(ours[both].mean() / theirs[both].mean()) if both.any() else float("nan")

    pips = ratio(fused.pip_deg[:, 1:], alone.pip_deg[:, 1:])
    return Ratios(ratio(fused.off_mm, alone.off_mm), ratio(fused.fingers_mm, alone.fingers_mm), pips)


Kind = Literal["fused", "markers", "wrist"]
KINDS: tuple[Kind, ...] = ("fused", "markers", "wrist")


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Results of the pipelines on one scene: its messages and truth, each pipeline's poses, and their figures."""

    shown: Shown
    solved: dict[Kind, Solved]
    figures: dict[Kind, Figures]

    @classmethod
    def of(cls, shown: Shown) -> "Outcome":
        """Solve and judge the scene with every pipeline."""
        both = shown.both
        setups: dict[Kind, RigSetup] = {"fused": both.fused, "markers": both.markers, "wrist": both.wrist}
        solved: dict[Kind, Solved] = {}
        figures: dict[Kind, Figures] = {}
        for kind in KINDS:
            solved[kind] = Solved.of(both, solve(setups[kind], shown.messages), setups[kind])
            figures[kind] = Figures.of(solved[kind], shown.visibility)
        return cls(shown, solved, figures)

    @property
    def ratios(self) -> Ratios:
        """Errors of the fused hand by those of the better sensor alone."""
        each = [ratios(self.solved["fused"], self.solved[kind]) for kind in KINDS[1:]]
        return Ratios(*(float(max(pair)) for pair in zip(*each, strict=True)))


def rows() -> Iterator[Row]:
    """Measure each scene, and the fused hand against the better sensor."""
    each: dict[str, Ratios] = {}
    seconds, seed = 13.0, 41
    for name in SCENES:
        found = Outcome.of(watched(Both.of(name, seed), seconds))
        each[name] = found.ratios
        yield from _scene(name, found.figures)
    for what, place in (("joints", 0), ("fingers", 1), ("PIP", 2)):
        for name, one in each.items():
            yield Row(f"{name}: fused / better alone, {what}", one[place], "x", "goal 1.05 or less")
        gain = 100.0 * (1.0 - float(np.mean([one[place] for one in each.values()])))
        yield Row(f"fused better than the better alone, {what}, mean", gain, "%", "goal 25 or more")


def _scene(name: str, figures: Mapping[Kind, Figures]) -> Iterator[Row]:
    ours = figures["fused"]

    def row(what: str, field: str, unit: str, note: str = "", times: float = 1.0) -> Row:
        alone = ", ".join(f"{kind} {times * getattr(figures[kind], field):.1f}" for kind in KINDS[1:])
        return Row(what, times * getattr(ours, field), unit, f"{alone}; {note}" if note else alone)

    fingers = ", ".join(f"{f} {d:.1f}" for f, d in zip(FINGERS, ours.pip_deg, strict=True))
    yield row(f"{name}: joints", "joint_mm", "mm")
    yield row("  fingers, palm put where it is", "fingers_mm", "mm")
    yield row("  PIP of four fingers (thumb: MCP)", "four_deg", "deg", fingers)
    yield row("  PIP of fingers hidden from the cameras", "hidden_deg", "deg")
    yield row("  joints valid", "valid", "%", times=100.0)
    yield row("  joints tracked", "tracked", "%", times=100.0)
    yield row("  inside 95 %", "inside", "%", "goal 90 to 98", 100.0)
    yield row("  poses with a TRACKED joint 20 mm off", "false_tracked", "%", times=100.0)
