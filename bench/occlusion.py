"""Finger tips that no two cameras see, in the six poses of the Digits study: one pair, and a second pair aside.

Occlusion is the stereo rig's own weakness, and a further pair of cameras its authors' remedy (Kalbfleisch, section X).
A tip is *unseen* at a moment when fewer than two cameras see it, for then nothing places it. Counted twice: by the
exact visibility in the renderer, and by what the line from image to point delivers within a centimetre.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from bench.played import shown_by, solve, times_of, times_of_poses, watch
from bench.row import Row
from common.arrays import Bool, Float, Int
from common.calibration import HandProfile, load
from common.hand.model import HandModel
from common.sim.scene import Scene
from common.sim.scenes import scene_by_name
from master.rig.files import load_setup
from master.rig.setup import RigSetup

CALIBRATION = Path(__file__).parent.parent / "calib_json"
PAIR, FOUR = ("left", "right"), ("left", "right", "left2", "right2")
SEEN = 0.15
"""Discs of its cap's radius that a tip must show to be seen: there the detector finds nine of ten."""
RIGHT_M = 0.010
PERIOD_S, SAMPLE_HZ, FRAME_HZ = 60.0, 4.0, 30.0
EXACT = (("right", 7), ("right", 21), ("left", 7), ("left", 21))
PLAYED = (("right", 7), ("left", 21))


@dataclass(frozen=True, slots=True)
class Unseen:
    """Shares: tips unseen, of all tips at all moments; moments with any tip unseen; tips by no, by one camera seen."""

    tips: float
    moments: float
    none: float
    one: float

    @classmethod
    def of(cls, cameras: Int) -> "Unseen":
        """From the number of cameras (T, 5) that see each tip."""
        lost = cameras < 2
        return cls(
            float(lost.mean()),
            float(lost.any(axis=1).mean()),
            float((cameras == 0).mean()),
            float((cameras == 1).mean()),
        )


@dataclass(frozen=True, slots=True)
class Delivered:
    """What the line made of a scene.

    Attributes:
        missing: (T, 5) tips without a point, or with one more than a centimetre off.
        joint_mm: (T, 25) error of every joint, seen or not; NaN before the first pose.
        found: Found of the tips that show `SEEN` or more, in all cameras.
    """

    missing: Bool
    joint_mm: Float
    found: float


def rows() -> list[Row]:
    """Exact visibility and the whole line, with one pair and with two."""
    return [*_exact(), *_played()]


def scene_of(side: str, seed: int, rate_hz: float) -> tuple[Scene, RigSetup]:
    """The scene `poses` of one hand before the rig desk4, all its cameras at one rate."""
    setup = load_setup(CALIBRATION, "desk4", CALIBRATION / "hands" / f"default-{side}.json")
    cameras = {
        name: msgspec.structs.replace(camera, frame_rate_hz=rate_hz) for name, camera in setup.cameras.items()
    }
    hand = load(CALIBRATION / "hands" / f"default-{side}.json", HandProfile)
    scene = scene_by_name("poses", setup.rig, cameras, hand, seed)
    return scene, RigSetup.of(setup.rig, cameras, HandModel.of(hand))


def only(setup: RigSetup, names: tuple[str, ...]) -> RigSetup:
    """The same rig with some of its cameras."""
    rig = msgspec.structs.replace(setup.rig, cameras=names)
    return RigSetup.of(rig, setup.cameras, setup.hand)


def seen_exactly(scene: Scene, cameras: tuple[str, ...]) -> Bool:
    """(C, T, 5) whether each camera sees each tip, at moments through the whole scene."""
    times = (np.arange(PERIOD_S * SAMPLE_HZ) + 0.5) / SAMPLE_HZ
    return np.array([shown_by(scene, name, times)[:, :5] >= SEEN for name in cameras])


def _exact() -> Iterator[Row]:
    ratios: list[tuple[float, float]] = []
    for side, seed in EXACT:
        scene, _ = scene_of(side, seed, FRAME_HZ)
        seen = seen_exactly(scene, FOUR)
        pair, four = Unseen.of(seen[:2].sum(axis=0)), Unseen.of(seen.sum(axis=0))
        ratios.append((four.tips / pair.tips, four.moments / pair.moments))
        yield Row(
            f"{side} hand, seed {seed}: tips unseen, by visibility",
            100.0 * four.tips,
            "%",
            f"one pair {100 * pair.tips:.1f}; no camera {100 * four.none:.1f} ({100 * pair.none:.1f}), "
            f"one {100 * four.one:.1f} ({100 * pair.one:.1f})",
        )
        yield Row(
            "  moments with any tip unseen", 100.0 * four.moments, "%", f"one pair {100 * pair.moments:.1f}"
        )
    tips, moments = np.max(ratios, axis=0)
    yield Row("two pairs / one, tips unseen, worst of these", float(tips), "x", "goal 0.5")
    yield Row("  moments with any tip unseen", float(moments), "x", "")


def _played() -> Iterator[Row]:
    for side, seed in PLAYED:
        pair, four = play(side, seed)
        kept, lost = 100.0 * four.missing.mean(), 100.0 * pair.missing.mean()
        any4, any2 = 100.0 * four.missing.any(axis=1).mean(), 100.0 * pair.missing.any(axis=1).mean()
        yield Row(
            f"{side} hand, seed {seed}: tips not placed within 10 mm",
            float(kept),
            "%",
            f"one pair {lost:.1f}",
        )
        yield Row("  two pairs / one", float(kept / lost), "x", "goal 0.5")
        yield Row("  moments with any such tip", float(any4), "%", f"one pair {any2:.1f}")
        yield Row(
            "  joint error, all joints",
            float(np.nanmean(four.joint_mm)),
            "mm",
            f"one pair {np.nanmean(pair.joint_mm):.1f}; 95 %: {np.nanpercentile(four.joint_mm, 95):.1f}, "
            f"one pair {np.nanpercentile(pair.joint_mm, 95):.1f}",
        )
        yield Row(f"  found of tips that show {SEEN} discs or more", 100.0 * four.found, "%", "")


def play(side: str, seed: int, seconds: float = PERIOD_S) -> tuple[Delivered, Delivered]:
    """Render, detect and solve the scene: with one pair, and with two."""
    scene, setup = scene_of(side, seed, FRAME_HZ)
    watched = {name: watch(scene, name, times_of(scene, name, seconds, FRAME_HZ)) for name in FOUR}
    shown = np.concatenate([one.shown[:, :5] >= SEEN for one in watched.values()])
    found = np.concatenate([[m.uv[:5, 0] for m in one.messages] for one in watched.values()])
    share = float(np.isfinite(found)[shown].mean())
    out: list[Delivered] = []
    for names in (PAIR, FOUR):
        poses, _ = solve(only(setup, names), [watched[name] for name in names])
        truth = [scene.truth(float(t)) for t in times_of_poses(poses)]
        tips = np.array([pose.markers_raw_m[:5] for pose in poses])
        off = np.linalg.norm(tips - np.array([now.markers_m[:5] for now in truth]), axis=2)
        joints = np.array([pose.position_m for pose in poses])
        error = np.linalg.norm(joints - np.array([now.joints.position_m for now in truth]), axis=2)
        out.append(Delivered(~(off <= RIGHT_M), 1e3 * error[:, 1:], share))
    return out[0], out[1]
