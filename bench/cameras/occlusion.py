"""Finger tips that no two cameras see, in the six poses of the Digits study: one pair, and a second pair aside.

A tip is *unseen* when fewer than two cameras see it, for then nothing triangulates it (Kalbfleisch, section X, proposes
a further pair). Counted twice: by the exact visibility in the renderer, and by what the line from image to point
delivers within a centimetre. `--picture FILE` draws where a second pair helps most (exact visibility only, minutes):
the second pair is the same bar, half a metre from the middle of the scene, and looks at it. Its *angle* is that between
the axes of the pairs. Its *side* is counted in the plane across the first pair's axis: 0 to the right, 90 to the user
(down in the image), 180 to the left, 270 beyond the finger tips.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from bench.played import shown_by, solve, times_of, times_of_poses, watch
from bench.report import CALIBRATION, Row, figure, rig_files
from common.arrays import Bool, Float, Int
from common.calibration import CameraCalibration, HandProfile, Matrix4, RigCalibration, load
from common.hand.model import HandModel
from common.sim.scene import Scene, view_centre
from common.sim.scenes import scene_by_name
from master.rig.setup import RigSetup, load_setup

PAIR, FOUR = ("left", "right"), ("left", "right", "left2", "right2")
SEEN = 0.15
"""Discs of its cap's radius that a tip must show to be seen: there the detector finds nine of ten."""
_RIGHT_M = 0.010
_PERIOD_S, _SAMPLE_HZ, _FRAME_HZ = 60.0, 4.0, 30.0
_EXACT = (("right", 7), ("right", 21), ("left", 7), ("left", 21))
_PLAYED = (("right", 7), ("left", 21))
_ANGLES_DEG, _SIDES_DEG = (30, 50, 70, 90, 110, 125), (0, 45, 90, 135, 180, 225, 270, 315)
_DISTANCE_M, _MAP_HZ, _MAP_SEED = 0.5, 2.0, 7


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
    """The line's result in a scene.

    Attributes:
        missing: (T, 5) tips without a point, or with one more than a centimetre off.
        joint_mm: (T, 25) error of every joint, seen or not; NaN before the first pose.
        found: Found of the tips that show `SEEN` or more, in all cameras.
    """

    missing: Bool
    joint_mm: Float
    found: float


def rows() -> Iterator[Row]:
    """Measure exact visibility and the whole line, with one pair and with two."""
    ratios: list[float] = []
    for side, seed in _EXACT:
        scene, _ = _scene_of(side, seed)
        seen = _seen(scene, FOUR, _SAMPLE_HZ)
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
        out.append(Delivered(~(off <= _RIGHT_M), 1e3 * error[:, 1:], share))
    return out[0], out[1]


def pair_at(rig: RigCalibration, angle_deg: float, side_deg: float) -> tuple[Float, Float]:
    """Return poses (4, 4) of both cameras of a second bar, rig frame; its images are upright as a desk is level."""
    angle, side = np.radians(angle_deg), np.radians(side_deg)
    out = np.array([np.sin(angle) * np.cos(side), np.sin(angle) * np.sin(side), -np.cos(angle)])
    x = np.cross([0.0, 0.0, 1.0], -out)
    x = x / np.linalg.norm(x)
    first = np.eye(4)
    first[:3, :3] = np.stack([x, np.cross(-out, x), -out], axis=1)
    bar = np.linalg.inv(rig.camera_pose(PAIR[0])) @ rig.camera_pose(PAIR[1])
    first[:3, 3] = view_centre(rig) + _DISTANCE_M * out - first[:3, :3] @ (bar[:3, 3] / 2.0)
    return first, first @ bar


def _mapped() -> tuple[Unseen, dict[tuple[int, int], Unseen]]:
    """Of the first pair alone, and with a second one at every angle and side; both hands together."""
    rig, own, _ = rig_files("desk")
    hands = [load(CALIBRATION / f"hands/default-{side}.json", HandProfile) for side in ("right", "left")]

    def seen(rig: RigCalibration, cameras: dict[str, CameraCalibration], names: tuple[str, ...]) -> Int:
        scenes = [scene_by_name("poses", rig, cameras, hand, _MAP_SEED) for hand in hands]
        return np.concatenate([_seen(scene, names, _MAP_HZ).sum(axis=0) for scene in scenes])

    first = seen(rig, own, PAIR)
    both: dict[tuple[int, int], Unseen] = {}
    for angle in _ANGLES_DEG:
        for side in _SIDES_DEG:
            poses = dict(zip(("left2", "right2"), pair_at(rig, angle, side), strict=True))
            more = {
                n: msgspec.structs.replace(own[like], name=n) for n, like in zip(poses, PAIR, strict=True)
            }
            placed = {name: msgspec.convert(pose.tolist(), Matrix4) for name, pose in poses.items()}
            T = rig.T_rig_camera | placed
            wide = msgspec.structs.replace(rig, cameras=(*PAIR, *poses), T_rig_camera=T)
            both[angle, side] = Unseen.of(first + seen(wide, own | more, tuple(poses)))
    return Unseen.of(first), both


def picture(file: Path) -> None:
    """Draw the map as the first pair sees it, angle outwards, side around; print it as a table."""
    alone, both = _mapped()
    made = figure(8.2, 7.4)
    axes = made.add_subplot()
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set_xlim(-165.0, 165.0)
    axes.set_ylim(160.0, -160.0)  # down is down, as in the image
    for angle in _ANGLES_DEG:
        ring = np.radians(np.arange(361))
        axes.plot(angle * np.cos(ring), angle * np.sin(ring), color="0.85", lw=1.0, zorder=1)
        at = angle * np.cos(np.radians(22.5)), angle * np.sin(np.radians(22.5))
        axes.text(*at, f"{angle}°", color="0.4", size=9, ha="center", va="center")
        print(
            f"| {angle}° | " + " | ".join(f"{100 * both[angle, side].tips:.0f}" for side in _SIDES_DEG) + " |"
        )
    axes.text(0.0, 0.0, "first\npair", size=10, ha="center", va="center")
    places = np.array(list(both), np.float64)
    x, y = (places[:, 0] * rotation(np.radians(places[:, 1])) for rotation in (np.cos, np.sin))
    ratio = np.array([one.tips / alone.tips for one in both.values()])
    shown = axes.scatter(x, y, c=ratio, s=600, cmap="viridis_r", vmin=0.0, vmax=1.0, zorder=3)
    for u, v, share in zip(x.tolist(), y.tolist(), ratio.tolist(), strict=True):
        light = "white" if share > 0.4 else "black"
        axes.text(u, v, f"{share:.2f}", ha="center", va="center", color=light, size=9, zorder=4)
    for side, name in ((0, "right"), (90, "to the user"), (180, "left"), (270, "beyond the finger tips")):
        u, v = 147.0 * float(np.cos(np.radians(side))), 147.0 * float(np.sin(np.radians(side)))
        axes.text(u, v, name, size=10, ha="center", va="center", rotation=90 if side % 180 == 0 else 0)
    axes.set_title(f"Tips unseen with a second pair / with one ({100 * alone.tips:.0f} % of all)", size=12)
    made.colorbar(shown, ax=axes, shrink=0.7)
    made.savefig(file, metadata={"Software": None})
