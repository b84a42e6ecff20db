"""Light that changes: do the markers stay found and themselves, and is a loss foreseen? Standard scene, exact truth.

Colours are those of the camera files, calibrated once under 4300 K; what is found is held against the same frames under
the light of calibration.
"""

from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.sim.light import CALIBRATED_KELVIN, LightSchedule
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.illuminant import gain_difference
from slave.markers.reloadable import LightAdaptiveDetector
from slave.markers.white_balance import Inline

CALIBRATION = Path(__file__).resolve().parents[2] / "calib_json"
RATE_HZ = 20.0
SECONDS = 14.0
VISIBLE = 0.5
FREE_PX = 3.0
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


@lru_cache(maxsize=2)
def _renderer(course: LightSchedule, seed: int, camera: str) -> Renderer:
    """Of the standard scene under this course of the light."""
    return Renderer(replace(standard_scene(seed), light=course), camera)


@cache
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
    renderer, scene = _renderer(course, seed, camera), standard_scene(seed)
    model = scene.cameras[camera]
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
                light = gain_difference(following.log_gains, np.log(course.at(t_s).gains_bgr()), dim=0.0)
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
