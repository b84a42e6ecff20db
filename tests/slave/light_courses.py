"""Light that changes: do the markers stay found and themselves, and is a loss foreseen? Standard scene, exact truth.

Colours are those of the camera files, calibrated once under 4300 K; what is found is held against the same frames under
the light of calibration.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.sim.light import CALIBRATED_KELVIN, LightSchedule
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.markers.detector import MarkerDetector
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


@dataclass(slots=True)
class Outcome:
    """What became of the markers under one course of the light.

    Attributes:
        visible: ImageObservations to be had: markers at least half visible, over all frames.
        found: How many were found.
        swaps: Reports of a marker on the place of another one.
        swaps_unwarned: Swaps before the first warning.
        missed_unwarned: ImageObservations missed before the first warning.
        light_error: Largest error of the estimated light in log gains against green, after a second.
    """

    visible: int = 0
    found: int = 0
    swaps: int = 0
    swaps_unwarned: int = 0
    missed_unwarned: int = 0
    light_error: float = 0.0


@cache
def _renderer(seed: int, camera: str) -> Renderer:
    return Renderer(standard_scene(seed), camera)


@cache
def outcome(
    course: LightSchedule,
    seed: int,
    camera: str,
    *,
    follow: bool = True,
    seconds: float = SECONDS,
    begin_s: float = 0.0,
    rate_hz: float = 0.5 * RATE_HZ,
) -> Outcome:
    """Judge one camera on one course; deterministic."""
    renderer, scene = _renderer(seed, camera), standard_scene(seed)
    model = scene.cameras[camera]
    following = LightAdaptiveDetector(model, scene.rig.markers, Inline()) if follow else None
    detector = MarkerDetector(model, scene.rig.markers) if following is None else following
    got, warned = Outcome(), False
    for k in range(round(seconds * rate_hz)):
        t_s = begin_s + k / rate_hz
        gains_bgr = course.at(t_s).gains_bgr()
        image, truth = renderer.exposed(model.exposure_us, gains_bgr).observe(t_s)
        found = detector.push(image, round(t_s * 1e9))
        seen, visible = np.isfinite(found.uv[:, 0]), truth.visible >= VISIBLE
        swaps = _swaps(found.uv, truth.uv, np.maximum(FREE_PX, np.sqrt(truth.area / np.pi)))
        got.visible += int(visible.sum())
        got.found += int((visible & seen).sum())
        got.swaps += swaps
        if following is not None:
            warned = warned or bool(following.warnings)
            if k >= rate_hz:
                got.light_error = max(
                    got.light_error, gain_difference(following.log_gains, np.log(gains_bgr), dim=0.0)
                )
        if not warned:
            got.swaps_unwarned += swaps
            got.missed_unwarned += int((visible & ~seen).sum())
    return got


def _swaps(uv: Float, truth: Float, allowed: Float) -> int:
    """How many reports lie on another marker and not on their own."""
    swaps = 0
    for m in np.flatnonzero(np.isfinite(uv[:, 0])):
        on = np.hypot(*(truth - uv[m]).T) <= allowed
        swaps += bool(on.any() and not on[m])
    return swaps


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
