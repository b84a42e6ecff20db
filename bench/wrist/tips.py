"""Fingertips of the wrist device: how many of those in sight are found, within 6 px of the end of their finger.

On the recordings, and on simulated hands and palm poses of other seeds in every light.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bench.report import Row, datasets, rig_files, skipped
from bench.wrist.frames import RECORDINGS, differences, drawn, other_palm, recorded
from common.arrays import Bool, Float
from common.hand.profiles import generated_profile
from common.sim.wrist.scene import AMBIENTS, WristScene
from slave.wrist.fingertips import NO_TIPS, Fingertips, fingertips
from slave.wrist.laser import laser_lines, separate
from slave.wrist.led_image import WristView
from slave.wrist.strobe import StrobeCycle

_MOTIONS = ("standard", "curl", "poses", "spread", "random")
_LENGTHS_M = (0.17, 0.185, 0.2)  # of hands, one for each seed
_SEEDS = (201, 202, 203)


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One strobe cycle with the true ends of fingers (5, 2) [px], and which are seen (5,)."""

    view: WristView
    cycle: StrobeCycle
    truth_px: Float
    seen: Bool


def rows() -> Iterator[Row]:
    """Measure the recordings, and each light."""
    cv2.setNumThreads(1)
    data = datasets()
    if (data / "wrist").is_dir():
        read = [recorded(data / "wrist" / name, data / "hands") for name in RECORDINGS]
        shown = [
            Shown(one.view, *row)
            for one in read
            for row in zip(one.cycles, one.truth["tip_uv"], one.truth["tip_visible"], strict=True)
        ]
        yield from _scored("recordings", shown)
    else:
        yield skipped("recordings", data / "wrist")
    for ambient in AMBIENTS:
        people = list(zip(_SEEDS, _LENGTHS_M, strict=True))
        shown = [one for m in _MOTIONS for person in people for one in simulated(f"{m}@{ambient}", *person)]
        yield from _scored(f"simulated, {ambient}", shown)


def simulated(name: str, seed: int, hand_length_m: float) -> list[Shown]:
    """Render poses of a generated hand before a palm that lies a little differently."""
    rig, cameras, _ = rig_files("wrist")
    hand = generated_profile(f"{hand_length_m:.3f} m", "right", hand_length_m)
    rig = other_palm(rig, np.random.default_rng([seed, 6]))
    scene = WristScene.by_name(name, rig, cameras, hand, seed)
    view = WristView.of(rig, cameras[rig.cameras[0]], hand)
    poses = 14
    times = np.arange(poses) * scene.period_s / poses
    truths = [scene.truth(t) for t in times.tolist()]
    cycles = drawn(scene, rig.cameras[0], times)
    return [Shown(view, one, now.tip_uv, now.tip_visible) for one, now in zip(cycles, truths, strict=True)]


def _scored(name: str, shown: list[Shown]) -> Iterator[Row]:
    seen = np.array([one.seen for one in shown])
    off = np.array([_found(one).uv - one.truth_px for one in shown])
    within = 100.0 * float((np.linalg.norm(off, axis=2) <= 6.0)[:, 1:][seen[:, 1:]].mean())
    yield Row(f"{name}: found within 6 px", within, "%", f"goal 90, no thumbs; {seen[:, 1:].sum()} seen")
    if (thumb := seen[:, 0]).any():
        found = 100.0 * float(np.isfinite(off[thumb, 0, 0]).mean())
        yield Row(f"{name}: thumbs found", found, "%", f"of {thumb.sum()} seen")


def _found(one: Shown) -> Fingertips:
    laser, led = differences(one.cycle)
    fingers = separate(led, one.view)
    if not fingers.palm_pose.straight:
        return NO_TIPS
    return fingertips(led, one.cycle.led.image, laser_lines(laser, fingers, one.view).uv, one.view)
