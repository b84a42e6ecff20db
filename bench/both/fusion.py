"""One hand of markers and wrist device against each sensor alone, on the same messages, by exact truth.

Each scene is rendered, detected and solved by three pipelines: of both sensors, of the marker rig, of the wrist device,
whose hand is put where the wrist joint truly is. *Better* is the sensor with the smaller error (`ratios`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Self

import numpy as np

from bench.both.scene import SCENES, Both, Shown, Solved, solve, watched
from bench.report import REGION, Row
from common.arrays import Bool, Float, Int
from common.hand.model import CHAINS, FINGERS
from master.rig.setup import RigSetup

_FINGERS = 5
_PALM_JOINTS = np.setdiff1d(np.arange(26), CHAINS)


@dataclass(frozen=True, slots=True, eq=False)
class VisibleAt:
    """What is truly in sight at the moments of poses (N,)."""

    cameras: Int  # (N, M) marker cameras that have each marker in sight
    worn: Bool  # (N, 5) whether the wrist device has laser line or tip of each finger in sight
    hidden: Bool  # (N, 5) whether fewer than two cameras have the finger's marker in sight
    oriented: Bool  # (N,) whether an IMU tells of the palm
    strapped: bool  # there are no markers: the palm is where the device's strap has it
    hand_over: Bool  # (N, 5) whether what is in sight of the finger changed within half a second

    @classmethod
    def of(cls, shown: Shown, solved: Solved) -> Self:
        """Of a pipeline's poses: what its own sensors have in sight."""
        t_s, visibility = solved.t_s, shown.visibility
        about_s = 0.04  # a frame and a bit of every sensor: what was in sight then tells of a pose
        seen = visibility.cameras_of(t_s, about_s)
        cameras = seen if solved.markers else np.zeros_like(seen)
        worn = visibility.worn(t_s, about_s) & solved.wrist
        oriented = np.full(len(t_s), solved.wrist)
        by = np.concatenate([cameras[:, :_FINGERS] >= 2, worn], axis=1)
        changed = np.zeros(by.shape, np.int64)
        changed[1:] = by[1:] != by[:-1]
        total = np.concatenate([np.zeros((1, by.shape[1]), np.int64), np.cumsum(changed, axis=0)])
        hand_over_s = 0.5
        first, last = (np.searchsorted(t_s, t_s + way * hand_over_s) for way in (-1.0, 1.0))
        near = total[last] > total[first]
        over = near[:, :_FINGERS] | near[:, _FINGERS:]
        return cls(cameras, worn, seen[:, :_FINGERS] < 2, oriented, not solved.markers, over)

    @property
    def observed(self) -> Bool:
        """(N, 26) which joints something measures.

        A finger's chain: its marker is in sight of a camera, or its laser line or tip of the wrist device. The palm's:
        three markers are in sight of a camera, or the one on the back and another, or any and an IMU.
        """
        seen = self.cameras >= 1
        count = seen.sum(axis=1)
        out = np.zeros((len(seen), 26), np.bool_)
        palm = (count >= 3) | (seen[:, _FINGERS] & (count >= 2)) | ((count >= 1) & self.oriented)
        out[:, _PALM_JOINTS] = palm[:, None] | self.strapped
        out[:, CHAINS] = (seen[:, :_FINGERS] | self.worn)[:, :, None]
        return out


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
    inside_hand_over: float  # the same of fingers near a hand-over
    step_mm: float  # largest step beyond the truth's own
    over_step: float  # steps of a pose's worst joint above 5 mm, per minute
    false_tracked: float  # share of poses with a TRACKED bit that nothing measures, or that is 20 mm off
    unseen: float  # share of tracked bits that nothing measures
    off: float  # share of tracked bits that are 20 mm off
    hz: float  # poses per second

    @classmethod
    def of(cls, solved: Solved, visible_at: VisibleAt) -> Self:
        """Reckon them."""
        off, pip, joint_chi2, steps = solved.off_mm, solved.pip_deg, solved.joint_chi2, solved.steps_mm
        tracked = solved.poses.tracked
        unseen = tracked & ~visible_at.observed
        off_m = 0.020  # a joint that is tracked may not be farther off
        far = tracked & (np.linalg.norm(solved.poses.position_m - solved.truth_m, axis=2) > off_m)
        bits = max(int(tracked.sum()), 1)
        near = np.zeros(joint_chi2.shape, np.bool_)
        near[:, CHAINS - 1] = visible_at.hand_over[:, :, None]
        span_s = float(solved.t_s[-1] - solved.t_s[0])
        worst = _most(steps)
        step_mm = 5.0
        return cls(
            joint_mm=_mean(off),
            fingers_mm=_mean(solved.fingers_mm),
            pip_deg=tuple(_mean(pip[:, f]) for f in range(_FINGERS)),
            four_deg=_mean(pip[:, 1:]),
            hidden_deg=_mean(np.where(visible_at.hidden, pip, np.nan)[:, 1:]),
            valid=float(solved.poses.valid[:, 1:].mean()),
            tracked=float(tracked[:, 1:].mean()),
            inside=_inside(joint_chi2),
            inside_hand_over=_inside(np.where(near, joint_chi2, np.nan)),
            step_mm=float(worst.max(initial=0.0)),
            over_step=60.0 * float((worst > step_mm).sum()) / span_s,
            false_tracked=float((unseen | far).any(axis=1).mean()),
            unseen=float(unseen.sum()) / bits,
            off=float(far.sum()) / bits,
            hz=(len(solved.t_s) - 1) / span_s,
        )


class Ratios(NamedTuple):
    """Mean error of the fused hand by that of a sensor alone: joints, fingers in a true palm, PIP of four fingers."""

    joints: float
    fingers: float
    pip: float


def _mean(values: Float) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _inside(joint_chi2: Float) -> float:
    known = joint_chi2[np.isfinite(joint_chi2)]
    return float((known < REGION).mean()) if known.size else float("nan")


def _most(steps_mm: Float) -> Float:
    """(N,) the worst of each row; 0 where there is none."""
    return np.nan_to_num(steps_mm, nan=0.0).max(axis=1, initial=0.0)


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
            figures[kind] = Figures.of(solved[kind], VisibleAt.of(shown, solved[kind]))
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
    why = f"of its bits {100 * ours.unseen:.3f} % see nothing, {100 * ours.off:.3f} % are off by 20 mm"
    yield row(f"{name}: joints", "joint_mm", "mm")
    yield row("  fingers, palm put where it is", "fingers_mm", "mm")
    yield row("  PIP of four fingers (thumb: MCP)", "four_deg", "deg", fingers)
    yield row("  PIP of fingers hidden from the cameras", "hidden_deg", "deg")
    yield row("  joints valid", "valid", "%", times=100.0)
    yield row("  joints tracked", "tracked", "%", times=100.0)
    yield row("  inside 95 %", "inside", "%", times=100.0)
    yield row("  inside 95 %, about hand-overs", "inside_hand_over", "%", "goal 90 to 98", 100.0)
    steps = f"{ours.over_step:.1f} over 5 mm a minute"
    yield row("  largest step beyond the truth's", "step_mm", "mm", steps)
    yield row("  poses with a false TRACKED bit", "false_tracked", "%", why, 100.0)
