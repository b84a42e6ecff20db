"""How good poses are against exact truth: errors, doubt, bits and steps, for one pipeline and against another."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from bench.both.scene import Shown
from bench.both.solved import RejectedPeer, Solved
from bench.report import REGION
from common.arrays import Bool, Float, Int
from common.hand.model import CHAINS

OFF_M = 0.020  # a joint that is tracked may not be farther off
STEP_MM = 5.0
HAND_OVER_S = 0.5
ABOUT_S = 0.04  # a frame and a bit of every sensor: what was in sight then tells of a pose
_TOGETHER_NS = 17_000_000  # poses of two pipelines are compared that are no farther apart
_BACK, _FINGERS = 5, 5
_PALM_JOINTS = np.setdiff1d(np.arange(26), CHAINS)


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """What is truly in sight at the instants of poses (N,).

    Attributes:
        cameras: (N, M) marker cameras that have each marker in sight; none while that stream is away.
        worn: (N, 5) whether the wrist device has laser line or tip of each finger in sight.
        hidden: (N, 5) whether fewer than two cameras have the finger's marker in sight, were no stream away.
        oriented: (N,) whether an IMU tells of the palm.
        strapped: Whether there are no markers: the palm is then where the device's strap has it, and nowhere else.
        hand_over: (N, 5) whether what is in sight of the finger changed within half a second.
    """

    cameras: Int
    worn: Bool
    hidden: Bool
    oriented: Bool
    strapped: bool
    hand_over: Bool

    @classmethod
    def of(cls, shown: Shown, solved: Solved, away: RejectedPeer | None) -> Self:
        """Of a pipeline's poses: what its own sensors have in sight."""
        t_s = solved.t_s
        gone = (np.zeros(len(t_s), np.bool_),) * 2 if away is None else away.at(t_s)
        # A message of a moment ago still tells of a pose: a stream is away once it has been so for that long.
        if away is not None:
            before = away.at(t_s - ABOUT_S)
            gone = (gone[0] & before[0], gone[1] & before[1])
        cameras = shown.line_of_sight.cameras_of(t_s, ABOUT_S, gone[0] | (not solved.markers))
        worn = shown.line_of_sight.worn(t_s, ABOUT_S, gone[1] | (not solved.wrist))
        oriented = ~gone[1] & solved.wrist
        by = np.concatenate([cameras[:, :_FINGERS] >= 2, worn], axis=1)
        changed = np.zeros(by.shape, np.int64)
        changed[1:] = by[1:] != by[:-1]
        total = np.concatenate([np.zeros((1, by.shape[1]), np.int64), np.cumsum(changed, axis=0)])
        first, last = (np.searchsorted(t_s, t_s + way * HAND_OVER_S) for way in (-1.0, 1.0))
        near = total[last] > total[first]
        hidden = shown.line_of_sight.cameras_of(t_s, ABOUT_S)[:, :_FINGERS] < 2
        return cls(
            cameras, worn, hidden, oriented, not solved.markers, near[:, :_FINGERS] | near[:, _FINGERS:]
        )

    @property
    def observed(self) -> Bool:
        """(N, 26) which joints something tells of.

        A finger's chain: its marker is in sight of a camera, or its laser line or tip of the wrist device. The palm's:
        three markers are in sight of a camera, or the one on the back and another, or any and an IMU.
        """
        seen = self.cameras >= 1
        count = seen.sum(axis=1)
        out = np.zeros((len(seen), 26), np.bool_)
        palm = (count >= 3) | (seen[:, _BACK] & (count >= 2)) | ((count >= 1) & self.oriented)
        out[:, _PALM_JOINTS] = palm[:, None] | self.strapped
        out[:, CHAINS] = (seen[:, :_FINGERS] | self.worn)[:, :, None]
        return out


@dataclass(frozen=True, slots=True)
class Figures:
    """What a pipeline reached in a scene.

    Attributes:
        joint_mm: Mean error of all valid joints.
        fingers_mm: Of those beyond the knuckles, were the palm where it truly is.
        pip_deg: Mean error of the PIP of thumb (its MCP) ... little, where valid.
        four_deg: The same of the four fingers together.
        hidden_deg: The same while the finger's marker is in sight of fewer than two cameras.
        valid, tracked: Shares of joints.
        inside, inside_hand_over: Share of valid joints in their 95 % region; of those of fingers near a hand-over.
        step_mm: Largest step beyond the truth's own; over_step: steps of a pose's worst joint above 5 mm, per minute.
        false_tracked: Share of poses with a tracked bit that nothing tells, or that is 20 mm off or more;
            unseen, off: shares of tracked bits, by the reason.
        hz: Poses per second.
    """

    joint_mm: float
    fingers_mm: float
    pip_deg: tuple[float, ...]
    four_deg: float
    hidden_deg: float
    valid: float
    tracked: float
    inside: float
    inside_hand_over: float
    step_mm: float
    over_step: float
    false_tracked: float
    unseen: float
    off: float
    hz: float

    @classmethod
    def of(cls, solved: Solved, sighted: Sighted) -> Self:
        """Reckon them."""
        off, pip, joint_chi2, steps = solved.off_mm, solved.pip_deg, solved.joint_chi2, solved.steps_mm
        tracked = solved.poses.tracked
        unseen = tracked & ~sighted.observed
        far = tracked & (np.linalg.norm(solved.poses.position_m - solved.truth_m, axis=2) > OFF_M)
        bits = max(int(tracked.sum()), 1)
        near = np.zeros(joint_chi2.shape, np.bool_)
        near[:, CHAINS - 1] = sighted.hand_over[:, :, None]
        span_s = float(solved.t_s[-1] - solved.t_s[0])
        worst = _most(steps)
        return cls(
            joint_mm=_mean(off),
            fingers_mm=_mean(solved.fingers_mm),
            pip_deg=tuple(_mean(pip[:, f]) for f in range(_FINGERS)),
            four_deg=_mean(pip[:, 1:]),
            hidden_deg=_mean(np.where(sighted.hidden, pip, np.nan)[:, 1:]),
            valid=float(solved.poses.valid[:, 1:].mean()),
            tracked=float(tracked[:, 1:].mean()),
            inside=_inside(joint_chi2),
            inside_hand_over=_inside(np.where(near, joint_chi2, np.nan)),
            step_mm=float(worst.max(initial=0.0)),
            over_step=60.0 * float((worst > STEP_MM).sum()) / span_s,
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
    """Over the joints, fingers and instants that both call valid."""
    place = np.clip(np.searchsorted(fused.poses.t_ns, alone.poses.t_ns), 1, len(fused.t_s) - 1)
    before = fused.poses.t_ns[place] - alone.poses.t_ns > alone.poses.t_ns - fused.poses.t_ns[place - 1]
    place = place - before
    near = np.abs(fused.poses.t_ns[place] - alone.poses.t_ns) <= _TOGETHER_NS
    return Ratios(
        *(
            _ratio(np.where(near[:, None], ours[place], np.nan), theirs)
            for ours, theirs in (
                (fused.off_mm, alone.off_mm),
                (fused.fingers_mm, alone.fingers_mm),
                (fused.pip_deg[:, 1:], alone.pip_deg[:, 1:]),
            )
        )
    )


def _ratio(ours: Float, theirs: Float) -> float:
    both = np.isfinite(ours) & np.isfinite(theirs)
    return float(ours[both].mean() / theirs[both].mean()) if both.any() else float("nan")
