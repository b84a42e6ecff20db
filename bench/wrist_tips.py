"""Fingertips of the wrist device: how near, how many, how many of something else, how sure they
say they are, and the time they take.

On the recordings, where they are, and on simulated hands and palm poses of other seeds in every light. A tip counts as
found within 6 px of the end of its finger; false is a report more than 25 px from it, or of an end that is not seen.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bench.row import Row, median_us
from bench.wrist_shown import RECORDINGS, ROOT, datasets, other_palm, recorded
from common.arrays import Bool, Float, Image
from common.calibration import CameraCalibration, RigCalibration, load
from common.hand.profiles import generated_profile
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import AMBIENTS, WristScene
from slave.cameras.synthetic import STROBE
from slave.wrist.background import lit
from slave.wrist.fingers import separate
from slave.wrist.fingertips import NO_TIPS, Fingertips, fingertips
from slave.wrist.laser import laser_lines
from slave.wrist.view import WristView

MOTIONS = ("standard", "curl", "poses", "spread", "random")
HAND_LENGTHS_M = (0.17, 0.185, 0.2)  # one for each seed
SEEDS, POSES = (201, 202, 203), 14
FOUND_PX, ELSEWHERE_PX = 6.0, 25.0
TOUCHING_PX, EDGE_PX = 45.0, 40.0  # between the ends of two fingers: a diameter; to the edge of the image


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One triple: differences to the ambient frame, the LED frame, true ends of fingers (5, 2) [px], and which are seen
    (5,)."""

    view: WristView
    laser: Image
    led: Image
    frame: Image
    truth_px: Float
    seen: Bool


def rows() -> Iterator[Row]:
    """Rows of the recordings, of each light, and of the time."""
    cv2.setNumThreads(1)
    data = datasets()
    if (data / "wrist").is_dir():
        yield from _scored("recordings", [one for name in RECORDINGS for one in of_recording(data, name)])
    else:
        yield Row("recordings: skipped", 0.0, "", f"none at {data}: set PHALANX_DATASETS")
    shown: list[Shown] = []
    for ambient in AMBIENTS:
        shown = [
            one
            for motion in MOTIONS
            for seed, length in zip(SEEDS, HAND_LENGTHS_M, strict=True)
            for one in simulated(f"{motion}@{ambient}", seed, length)
        ]
        yield from _scored(f"simulated, {ambient}", shown)
    one = max(shown, key=lambda each: int(each.seen.sum()))
    laser_uv = laser_lines(one.laser, separate(one.led, one.view), one.view).uv
    middle, half = median_us(lambda: fingertips(one.led, one.frame, laser_uv, one.view))
    yield Row("fingertips of one triple", middle, "us", f"+-{half:.0f}; goal 600")


def of_recording(data: Path, name: str) -> list[Shown]:
    """The triples of a recording."""
    all_of = recorded(data, name)
    truth = all_of.truth
    shown = zip(all_of.laser, all_of.led, all_of.frames, truth["tip_uv"], truth["tip_visible"], strict=True)
    return [Shown(all_of.view, *each) for each in shown]


def simulated(name: str, seed: int, hand_length_m: float) -> list[Shown]:
    """Poses of a generated hand before a palm that lies a little differently."""
    rng = np.random.default_rng([seed, 6])
    rig = load(ROOT / "calib_json/rigs/wrist.json", RigCalibration)
    camera = load(ROOT / f"calib_json/cameras/{rig.cameras[0]}.json", CameraCalibration)
    hand = generated_profile(f"{hand_length_m:.3f} m", "right", hand_length_m)
    rig = other_palm(rig, rng)
    scene = WristScene.by_name(name, rig, {camera.name: camera}, hand, seed)
    renderer, view = WristRenderer(scene, camera.name), WristView.of(rig, camera, hand)
    out: list[Shown] = []
    for t in (np.arange(POSES) * scene.period_s / POSES).tolist():
        ambient, laser, led = (renderer.render(t, kind) for kind in STROBE)
        truth = scene.truth(t)
        out.append(Shown(view, lit(laser, ambient), lit(led, ambient), led, truth.tip_uv, truth.tip_visible))
    return out


def _scored(name: str, shown: list[Shown]) -> Iterator[Row]:
    found = [_found(one) for one in shown]
    off = np.array([tips.uv - one.truth_px for tips, one in zip(found, shown, strict=True)])
    sigma = np.array([tips.sigma_px for tips in found])
    seen = np.array([one.seen for one in shown])
    reported = np.isfinite(off[..., 0])
    distance = np.linalg.norm(off, axis=2)
    four = seen & (np.arange(5) > 0)
    both = four & reported
    yield Row(f"{name}: median", float(np.median(distance[both])), "px", f"{four.sum()} seen, thumbs apart")
    yield Row(
        f"{name}: found within 6 px",
        100.0 * float((distance[four] <= FOUND_PX).mean()),
        "%",
        "goal 90, thumbs apart",
    )
    elsewhere = reported & (distance > ELSEWHERE_PX)
    yield Row(
        f"{name}: of something else",
        100.0 * float(elsewhere.sum() / max(reported.sum(), 1)),
        "%",
        f"goal <= 5; of an end that is not seen {100.0 * float((reported & ~seen).sum() / max(reported.sum(), 1)):.1f}",
    )
    thumb, shows = reported[:, 0], seen[:, 0]
    if shows.any():
        found_of = 100.0 * float(thumb[shows].mean())
        yield Row(f"{name}: thumbs found", found_of, "%", f"of {shows.sum()} seen")
    yield Row(f"{name}: thumbs that are not seen", float((thumb & ~shows).sum()), "", "goal 0")
    for kind, some in _kinds(shown, reported, seen).items():
        pull = np.abs(off[some] / sigma[some][:, None])
        if len(pull):
            yield Row(
                f"{name}: within 1.96 sigma, {kind}",
                100.0 * float((pull < 1.96).mean()),
                "%",
                f"goal 95; {len(pull)} tips, median sigma {float(np.median(sigma[some])):.1f} px",
            )
    yield Row(
        f"{name}: given to another finger",
        1000.0 * float(_swapped(found, shown).sum() / max(reported.sum(), 1)),
        "per 1000",
        "goal 0",
    )


def _found(one: Shown) -> Fingertips:
    fingers = separate(one.led, one.view)
    laser_uv = laser_lines(one.laser, fingers, one.view).uv
    return fingertips(one.led, one.frame, laser_uv, one.view) if fingers.palm_pose.straight else NO_TIPS


def _kinds(shown: list[Shown], reported: Bool, seen: Bool) -> dict[str, Bool]:
    """Which reports (N, 5) are of ends in the clear, beside another end, near the image's edge, or not seen."""
    truth = np.array([one.truth_px for one in shown])
    apart = np.linalg.norm(truth[:, :, None] - truth[:, None], axis=-1) + 1e9 * np.eye(5)
    touching = apart.min(axis=2) < TOUCHING_PX
    height, width = shown[0].led.shape
    edge = (np.minimum(truth, [width, height] - truth) < EDGE_PX).any(axis=2)
    both = reported & seen
    return {
        "clear": both & ~touching & ~edge,
        "touching": both & touching & ~edge,
        "near the edge": both & edge,
        "not seen": reported & ~seen,
    }


def _swapped(found: list[Fingertips], shown: list[Shown]) -> Bool:
    """Which reports (N, 5) lie on the end of another finger than their own."""
    at, truth = np.array([tips.uv for tips in found]), np.array([one.truth_px for one in shown])
    distance = np.linalg.norm(at[:, :, None] - truth[:, None], axis=-1)
    own = np.diagonal(distance, axis1=1, axis2=2)
    others = (distance + 1e9 * np.eye(5)).min(axis=2)
    return (others < own) & (others < TOUCHING_PX / 3.0)
