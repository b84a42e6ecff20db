"""Light that changes: do the markers stay found and themselves, and is a loss foreseen? Standard scene, exact truth.

Colours are those of the camera files, calibrated once under 4300 K. Every figure is summed over seeds and both cameras;
what is found is held against the same frames under the light of calibration.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from time import perf_counter_ns
from typing import Protocol

import cv2
import numpy as np

from bench.report import Row
from common.arrays import Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.sim.light import CALIBRATED_KELVIN, LightSchedule
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.illuminant import apart
from slave.markers.reloadable import LightAdaptiveDetector
from slave.markers.white_balance import Inline

CALIBRATION = Path(__file__).resolve().parents[2] / "calib_json"
RATE_HZ = 20.0
SEEDS = (3, 7, 11)
SECONDS = 14.0
VISIBLE = 0.5
FREE_PX = 3.0
BEGIN_S = (0.0, 4.0, 15.0, 41.0)  # an open hand, fists, a hand that shows few markers
OPEN_S = 20.0  # an open hand: all six markers in view

STILL = LightSchedule(((0.0, CALIBRATED_KELVIN, 1.0),))
RAMP = LightSchedule(((2.0, 3000.0, 1.0), (12.0, 6500.0, 1.0)))
STEPS = LightSchedule(
    tuple((2.0 * i + j * 1.99, k, 1.0) for i, k in enumerate(range(3000, 6501, 500)) for j in (0, 1))
)
EXPOSURES = LightSchedule(((1.0, 4300.0, 1.0), (4.0, 4300.0, 0.7), (10.0, 4300.0, 1.3), (13.0, 4300.0, 1.0)))
SWITCHED = LightSchedule(
    (
        (4.0, 3000.0, 1.3),
        (4.0, 6500.0, 0.7),
        (8.0, 6500.0, 0.7),
        (8.0, 3000.0, 0.7),
        (11.0, 3000.0, 0.7),
        (11.0, 5000.0, 1.3),
    )
)
CANDLE = LightSchedule(((1.0, 4300.0, 1.0), (9.0, 2000.0, 1.0)))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of the markers under one course of the light.

    Attributes:
        visible: ImageObservations to be had: markers at least half visible, over all frames.
        found: How many were found.
        swaps: Reports of a marker on the place of another one.
        wrong: All reports that are on no visible part of their marker, swaps included.
        swaps_unwarned: Swaps before the first warning.
        missed_unwarned: ImageObservations missed before the first warning.
        apart: Largest error of the estimated light in log gains of red or blue against green, after the first second.
        refused: Frames in which nothing was reported.
    """

    visible: int
    found: int
    swaps: int
    wrong: int
    swaps_unwarned: int
    missed_unwarned: int
    apart: float
    refused: int

    def __add__(self, other: "Outcome") -> "Outcome":
        return Outcome(
            self.visible + other.visible,
            self.found + other.found,
            self.swaps + other.swaps,
            self.wrong + other.wrong,
            self.swaps_unwarned + other.swaps_unwarned,
            self.missed_unwarned + other.missed_unwarned,
            max(self.apart, other.apart),
            self.refused + other.refused,
        )

    @property
    def share(self) -> float:
        """Found of those visible."""
        return self.found / self.visible


class Detector(Protocol):
    """What is judged."""

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame."""
        ...


def rows() -> list[Row]:
    """Rows (name, value, unit, what it is held against)."""
    cv2.setNumThreads(1)
    still = total(STILL)
    fixed = f"of {still.visible}; these are the detector's, not the light's"
    out = [
        Row("calibrated light: identity swaps", still.swaps, "count", fixed),
        Row(
            "calibrated light: found",
            100.0 * still.share,
            "%",
            "of those half visible; the others are a few px^2",
        ),
    ]
    courses = {
        "3000 -> 6500 K in 10 s": RAMP,
        "3000 -> 6500 K, steps of 500 K": STEPS,
        "exposure 0.7 -> 1.3": EXPOSURES,
        "lamps switched": SWITCHED,
    }
    for name, course in courses.items():
        got, plain = total(course), total(course, follow=False, seeds=SEEDS[:1])
        swapped = f"of {got.visible}, goal 0; colours fixed: {plain.swaps} of {plain.visible}"
        share = f"goal 99; colours fixed: {100.0 * plain.share:.0f}"
        out += [
            Row(f"{name}: identity swaps", got.swaps, "count", swapped),
            Row(f"{name}: found / in calibrated light", 100.0 * got.found / still.found, "%", share),
            Row(
                f"{name}: light known to", 100.0 * got.apart, "%", "worst error of red or blue against green"
            ),
        ]
    return [*out, _starts(), _candle(), *_times()]


def _starts() -> Row:
    """Programs that start under a light other than that of calibration."""
    lights = [
        LightSchedule(((0.0, kelvin, exposure),)) for kelvin in (3000.0, 6500.0) for exposure in (0.7, 1.3)
    ]
    runs = [
        outcome(light, seed, camera, seconds=1.5, begin_s=begin_s)
        for light in lights
        for seed in SEEDS
        for camera in load_rig().cameras
        for begin_s in BEGIN_S
    ]
    got = sum_of(runs)
    note = f"of {got.visible}, goal 0; found {100.0 * got.share:.0f} %, refused {got.refused} frames"
    return Row("start at 3000 or 6500 K, 0.7 or 1.3: swaps unwarned of", got.swaps_unwarned, "count", note)


def _candle() -> Row:
    """A light that leaves the bounds: what is lost, and whether it was foreseen."""
    still, got = total(STILL), total(CANDLE)
    lost, typical = got.visible - got.found, still.visible - still.found
    note = f"goal 0; lost in all {lost}, in calibrated light {typical}"
    return Row("4300 -> 2000 K: swapped before a warning", got.swaps_unwarned, "count", note)


def total(course: LightSchedule, *, follow: bool = True, seeds: Sequence[int] = SEEDS) -> Outcome:
    """Outcome over seeds and both cameras."""
    return sum_of(
        [outcome(course, seed, camera, follow=follow) for seed in seeds for camera in load_rig().cameras]
    )


def sum_of(outcomes: Sequence[Outcome]) -> Outcome:
    """All of them together."""
    got = outcomes[0]
    for other in outcomes[1:]:
        got += other
    return got


def outcome(
    course: LightSchedule,
    seed: int,
    camera: str,
    *,
    follow: bool = True,
    seconds: float = SECONDS,
    begin_s: float = 0.0,
) -> Outcome:
    """Judge one camera on one course; deterministic."""
    scene = replace(standard_scene(seed), light=course)
    renderer, model = Renderer(scene, camera), scene.cameras[camera]
    following = LightAdaptiveDetector(model, scene.rig.markers, Inline()) if follow else None
    detector: Detector = MarkerDetector(model, scene.rig.markers) if following is None else following
    got, warned = Outcome(0, 0, 0, 0, 0, 0, 0.0, 0), False
    for k in range(round(seconds * RATE_HZ)):
        t_s = begin_s + k / RATE_HZ
        image, truth = renderer.observe(t_s)
        found = detector.push(image, round(t_s * 1e9))
        seen, visible = np.isfinite(found.uv[:, 0]), truth.visible >= VISIBLE
        allowed = np.maximum(FREE_PX, np.sqrt(truth.area / np.pi))
        swaps, wrong = _misplaced(found.uv, truth.uv, allowed)
        light = 0.0
        if following is not None:
            warned = warned or bool(following.warnings)
            if k >= RATE_HZ:
                light = apart(following.log_gains, np.log(course.at(t_s).gains_bgr()), dim=0.0)
        missed = int((visible & ~seen).sum())
        unwarned = (0, 0) if warned else (swaps, missed)
        got += Outcome(int(visible.sum()), int((visible & seen).sum()), swaps, wrong, *unwarned, light, 0)
    return replace(got, refused=0 if following is None else following.refused)


def _misplaced(uv: Float, truth: Float, allowed: Float) -> tuple[int, int]:
    """How many reports lie on another marker, and how many not on their own."""
    swaps = wrong = 0
    for m in np.flatnonzero(np.isfinite(uv[:, 0])):
        connection_lost = np.hypot(*(truth - uv[m]).T)
        if connection_lost[m] <= allowed[m]:
            continue
        wrong += 1
        others = np.delete(connection_lost <= allowed, m)
        swaps += bool(others.any())
    return swaps, wrong


def _times() -> list[Row]:
    """What following costs in a frame that needs no new table, and what a new table and a first light take."""
    scene = standard_scene(SEEDS[0])
    camera = scene.cameras[scene.rig.cameras[0]]
    image = Renderer(scene, camera.name).render(OPEN_S)
    plain = MarkerDetector(camera, scene.rig.markers)
    following = LightAdaptiveDetector(camera, scene.rig.markers, Inline())
    samples = np.empty((300, 2))
    for k in range(len(samples)):
        for i, detector in enumerate((plain, following)):
            start_ns = perf_counter_ns()
            detector.push(image, k * 16_666_667)
            samples[k, i] = (perf_counter_ns() - start_ns) * 1e-3
    without, along = np.median(samples[20:], axis=0)
    worst = np.percentile(samples[20:], 99, axis=0)
    note = f"{along:.0f} us, {without:.0f} us, medians in turn"
    return [
        Row("one frame, colours following / fixed", along / without, "x", note),
        Row("99th percentile, colours following / fixed", worst[1] / worst[0], "x", ""),
    ]


@cache
def load_rig() -> RigCalibration:
    """The rig of the demo."""
    return load(CALIBRATION / "rigs/desk.json", RigCalibration)


@cache
def standard_scene(seed: int) -> Scene:
    """The standard scene, as the demo shows it."""
    rig = load_rig()
    cameras = {n: load(CALIBRATION / f"cameras/{n}.json", CameraCalibration) for n in rig.cameras}
    return Scene.standard(rig, cameras, load(CALIBRATION / f"hands/{rig.hand}.json", HandProfile), seed)
