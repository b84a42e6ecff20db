"""Finger tips that no two cameras see, in the six poses of the Digits study: one pair, and a second pair aside.

A tip is *unseen* when fewer than two cameras see it: nothing triangulates it then (Kalbfleisch, section X). Counted
twice: by exact visibility in the renderer, and by what the line from image to point delivers within a centimetre.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from bench.played import shown_by, solve, times_of, times_of_poses, watch
from bench.report import CALIBRATION, Row
from common.arrays import Bool, Float, Int
from common.calibration import HandProfile, load
from common.hand.model import HandModel
from common.sim.scene import Scene
from common.sim.scenes import scene_by_name
from master.rig.setup import RigSetup, load_setup

PAIR, FOUR = ("left", "right"), ("left", "right", "left2", "right2")
SEEN = 0.15
"""Discs of its cap's radius that a tip must show to be seen: there the detector finds nine of ten."""
_PERIOD_S, _FRAME_HZ = 60.0, 30.0
_EXACT = (("right", 7), ("right", 21), ("left", 7), ("left", 21))
_PLAYED = (("right", 7), ("left", 21))


@dataclass(frozen=True, slots=True)
class Unseen:
    """Shares: tips unseen, of all tips at all moments; moments with any tip unseen; tips by no, by one camera seen."""

    tips: float
    moments: float
    none: float
    one: float

    @classmethod
    def of(cls, cameras: Int) -> "Unseen":
        """Count, from the number of cameras (T, 5) that see each tip."""
        lost, none, one = cameras < 2, cameras == 0, cameras == 1
        return cls(*(float(share.mean()) for share in (lost, lost.any(axis=1), none, one)))


@dataclass(frozen=True, slots=True)
class Delivered:
    """The line's result in a scene."""

    missing: Bool  # (T, 5) tips without a point, or with one more than a centimetre off
    joint_mm: Float  # (T, 25) error of every joint, seen or not; NaN before the first pose
    found: float  # found of the tips that show `SEEN` or more, in all cameras


def rows() -> Iterator[Row]:
    """Measure exact visibility and the whole line, with one pair and with two."""
    ratios: list[float] = []
    for side, seed in _EXACT:
        scene, _ = _scene_of(side, seed)
        seen = _seen(scene, FOUR, 4.0)
        pair, four = Unseen.of(seen[:2].sum(axis=0)), Unseen.of(seen.sum(axis=0))
        ratios.append(four.tips / pair.tips)
        note = (
            f"one pair {100 * pair.tips:.1f}; no camera {100 * four.none:.1f} ({100 * pair.none:.1f}), "
            f"one {100 * four.one:.1f} ({100 * pair.one:.1f})"
        )
        yield Row(f"{side} hand, seed {seed}: tips unseen, by visibility", 100.0 * four.tips, "%", note)
        yield Row(
            "  moments with any tip unseen", 100.0 * four.moments, "%", f"one pair {100 * pair.moments:.1f}"
        )
    yield Row("two pairs / one, tips unseen, worst of these", max(ratios), "x", "goal 0.5")
    for side, seed in _PLAYED:
        pair, four = play(side, seed)
        (kept, any4), (lost, any2) = (_shares(one.missing) for one in (four, pair))
        yield Row(
            f"{side} hand, seed {seed}: tips not placed within 10 mm", kept, "%", f"one pair {lost:.1f}"
        )
        yield Row("  two pairs / one", kept / lost, "x", "goal 0.5")
        yield Row("  moments with any such tip", any4, "%", f"one pair {any2:.1f}")
        note = (
            f"one pair {np.nanmean(pair.joint_mm):.1f}; 95 %: {np.nanpercentile(four.joint_mm, 95):.1f}, "
            f"one pair {np.nanpercentile(pair.joint_mm, 95):.1f}"
        )
        yield Row("  joint error, all joints", float(np.nanmean(four.joint_mm)), "mm", note)
        yield Row(f"  found of tips that show {SEEN} discs or more", 100.0 * four.found, "%")


def _shares(missing: Bool) -> tuple[float, float]:
    """Of tips, and of moments with any [%]."""
    return 100.0 * float(missing.mean()), 100.0 * float(missing.any(axis=1).mean())


def _scene_of(side: str, seed: int) -> tuple[Scene, RigSetup]:
    """The scene `poses` of one hand before the rig desk4, all its cameras at one rate."""
    file = CALIBRATION / f"hands/default-{side}.json"
    setup, hand = load_setup(CALIBRATION, "desk4", file), load(file, HandProfile)
    cameras = {n: msgspec.structs.replace(c, frame_rate_hz=_FRAME_HZ) for n, c in setup.cameras.items()}
    scene = scene_by_name("poses", setup.rig, cameras, hand, seed)
    return scene, RigSetup.of(setup.rig, cameras, HandModel.of(hand))


def _seen(scene: Scene, cameras: tuple[str, ...], rate_hz: float) -> Bool:
    """(C, T, 5) whether each camera sees each tip, at moments through the whole scene."""
    times = (np.arange(_PERIOD_S * rate_hz) + 0.5) / rate_hz
    return np.array([shown_by(scene, name, times)[:, :5] >= SEEN for name in cameras])


def play(side: str, seed: int, seconds: float = _PERIOD_S) -> tuple[Delivered, Delivered]:
    """Render, detect and solve the scene: with one pair, and with two."""
    scene, setup = _scene_of(side, seed)
    watched = {name: watch(scene, name, times_of(scene, name, seconds, _FRAME_HZ)) for name in FOUR}
    shown = np.concatenate([one.shown[:, :5] >= SEEN for one in watched.values()])
    found = np.concatenate([[m.uv[:5, 0] for m in one.messages] for one in watched.values()])
    share = float(np.isfinite(found)[shown].mean())
    out: list[Delivered] = []
    for names in (PAIR, FOUR):
        some = RigSetup.of(msgspec.structs.replace(setup.rig, cameras=names), setup.cameras, setup.hand)
        poses, _ = solve(some, [watched[name] for name in names])
        truth = [scene.truth(float(t)) for t in times_of_poses(poses)]
        tips = np.array([pose.markers_raw_m[:5] for pose in poses])
        off = np.linalg.norm(tips - np.array([now.markers_m[:5] for now in truth]), axis=2)
        joints = np.array([pose.position_m for pose in poses])
        error = np.linalg.norm(joints - np.array([now.joints.position_m for now in truth]), axis=2)
        out.append(Delivered(~(off <= 0.010), 1e3 * error[:, 1:], share))
    return out[0], out[1]
