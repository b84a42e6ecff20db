"""Where the laser meets each finger: error in millimetres against a plain blob centroid, and the time it takes.

On the recordings, where they are, and on simulated sequences of other hands and palm poses in every light. The point
held against the truth is the ray of the centroid where it meets the laser plane. On its own finger is one that lies
nearer to the truth of its finger than half a finger's breadth. The baseline is the centroid of the largest connected
bright blob between seams, as the paper has it; both see the same seams.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import cv2
import numpy as np

from bench.markers import interleaved
from bench.row import Row
from bench.wrist_shown import RECORDINGS, ROOT, datasets, other_palm, recorded
from common.arrays import Bool, Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.hand.model import FINGERS
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import AMBIENTS, WristScene
from slave.cameras.synthetic import STROBE
from slave.wrist.background import lit
from slave.wrist.fingers import Fingers, separate
from slave.wrist.laser import laser_lines
from slave.wrist.view import WristView

MOTIONS = ("curl", "poses", "spread")
POSES, SEEDS, RATE_HZ = 20, (101, 102), 90.0
VISIBLE_M, ON_FINGER_M = 2e-3, 8e-3
BRIGHT = 24  # levels: the baseline's threshold
Find = Callable[[Image, Fingers, WristView], Float]


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One triple as differences of frames, with where the laser really is on each finger.

    Attributes:
        view: The device.
        laser, led: Differences to the ambient frame.
        truth_m: (5, 3) [m], NaN: not seen.
        visible_m: (5,) length of line that is seen [m].
    """

    view: WristView
    laser: Image
    led: Image
    truth_m: Float
    visible_m: Float


def rows() -> Iterator[Row]:
    """Rows of the recordings, of each light, and of the time."""
    cv2.setNumThreads(1)
    data = datasets()
    timed: list[Shown] = []
    if (data / "wrist").is_dir():
        for name in RECORDINGS:
            shown = of_recording(data, name)
            timed = timed or shown
            yield from _scored(name, shown)
    else:
        yield Row("recordings: skipped", 0.0, "", f"none at {data}: set PHALANX_DATASETS")
    for ambient in AMBIENTS:
        shown = [one for motion in MOTIONS for seed in SEEDS for one in simulated(motion, ambient, seed)]
        timed = timed or shown
        yield from _scored(f"simulated, {ambient}", shown)
    yield from _times(timed)


def of_recording(data: Path, name: str) -> list[Shown]:
    """The triples of a recording."""
    all_of = recorded(data, name)
    points, lengths = all_of.truth["laser_pt"][:, 1:6], all_of.truth["laser_len_vis"][:, 1:6]
    shown = zip(all_of.laser, all_of.led, points, lengths, strict=True)
    return [Shown(all_of.view, *each) for each in shown]


def simulated(motion: str, ambient: str, seed: int) -> list[Shown]:
    """Poses of a simulated hand, which moves on from frame to frame, before a palm that lies a little differently."""
    rng = np.random.default_rng([seed, 5])
    rig = load(ROOT / "calib_json/rigs/wrist.json", RigCalibration)
    camera = load(ROOT / f"calib_json/cameras/{rig.cameras[0]}.json", CameraCalibration)
    hand = load(ROOT / f"calib_json/hands/{rig.hand}.json", HandProfile)
    rig = other_palm(rig, rng)
    scene = WristScene.by_name(f"{motion}@{ambient}", rig, {camera.name: camera}, hand, seed)
    renderer, view = WristRenderer(scene, camera.name), WristView.of(rig, camera, hand)
    out: list[Shown] = []
    for start in np.arange(POSES) * scene.period_s / POSES:
        frames = [renderer.render(float(start) + k / RATE_HZ, kind) for k, kind in enumerate(STROBE)]
        truth = scene.truth(float(start) + 1.0 / RATE_HZ)
        differences = (lit(frames[1], frames[0]), lit(frames[2], frames[0]))
        out.append(Shown(view, *differences, truth.laser_pt[1:6], truth.laser_len_vis[1:6]))
    return out


def found_here(laser: Image, fingers: Fingers, view: WristView) -> Float:
    """Ours (5, 2) [px]."""
    return laser_lines(laser, fingers, view).uv


def blob_centroids(laser: Image, fingers: Fingers, view: WristView) -> Float:
    """The baseline (5, 2) [px]: threshold, connected components, for each finger the largest whose centroid it has."""
    _, _, stats, centroids = cv2.connectedComponentsWithStats((laser >= BRIGHT).astype(np.uint8))
    places = np.asarray(centroids[1:], dtype=np.float64)
    out = np.full((5, 2), np.nan)
    largest = np.zeros(5)
    for finger, area, uv in zip(
        fingers.finger_of(places).tolist(),
        stats[1:, cv2.CC_STAT_AREA].tolist(),
        places,
        strict=True,
    ):
        if area > largest[finger]:
            largest[finger], out[finger] = area, uv
    return out


def _scored(name: str, shown: list[Shown]) -> Iterator[Row]:
    ours, theirs = (_errors(shown, find) for find in (found_here, blob_centroids))
    seen = np.array([one.visible_m >= VISIBLE_M for one in shown])
    for finger, called in enumerate(FINGERS):
        of = seen[:, finger]
        if not of.any():
            continue
        error, plain = ours[of, finger], theirs[of, finger]
        yield Row(
            f"{name}: {called}, median",
            1e3 * _quantile(error, 0.5),
            "mm",
            f"goal 0.6; p95 {1e3 * _quantile(error, 0.95):.2f}; plain blob {1e3 * _quantile(plain, 0.5):.2f},"
            f" p95 {1e3 * _quantile(plain, 0.95):.2f}",
        )
    yield from _shares(name, ours, seen)


def _shares(name: str, errors: Float, seen: Bool) -> Iterator[Row]:
    right = errors[seen] < ON_FINGER_M
    missed = np.isnan(errors[seen])
    note = f"goal >= 95 of {seen.sum()} with 2 mm of line; missed {100.0 * missed.mean():.1f} %"
    yield Row(f"{name}: on the right finger", 100.0 * float(right.mean()), "%", note)


def _errors(shown: list[Shown], find: Find) -> Float:
    """Distance (T, 5) [m] of what is found from the truth."""
    out = np.empty((len(shown), 5))
    for k, one in enumerate(shown):
        uv = find(one.laser, separate(one.led, one.view), one.view)
        out[k] = np.linalg.norm(one.view.on_plane(uv) - one.truth_m, axis=1)
    return out


def _quantile(values: Float, share: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if len(known) else float("nan")


def _times(shown: list[Shown]) -> Iterator[Row]:
    seams = [separate(one.led, one.view) for one in shown]

    def step(of: Callable[[int], object]) -> Callable[[], object]:
        turn = cycle(range(len(shown)))
        return lambda: of(next(turn))

    took = interleaved(
        {
            "seams": step(lambda k: separate(shown[k].led, shown[k].view)),
            "laser": step(lambda k: laser_lines(shown[k].laser, seams[k], shown[k].view)),
            "blobs": step(lambda k: blob_centroids(shown[k].laser, seams[k], shown[k].view)),
        },
        100,
    )
    for name, what in (
        ("seams", "seams of a triple"),
        ("laser", "laser of a triple"),
        ("blobs", "plain blobs"),
    ):
        yield Row(what, float(np.median(took[name])), "us", "baseline" if name == "blobs" else "")
