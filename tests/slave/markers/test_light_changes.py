"""Colours calibrated once, then another light: no marker is taken for another one, none is lost unwarned.

Whole detector, rendered frames, exact truth; the scene, its courses of light and the judge are in `light_courses`.
"""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import ParamSpec, TypeVar

import msgspec
import numpy as np
import pytest

from common.sim.light import LightSchedule
from common.sim.render import Renderer
from slave.markers.detector import MarkerDetector
from slave.markers.illuminant import gain_difference
from slave.markers.reloadable import REFUSE, LightAdaptiveDetector, can_adapt, detector_for
from slave.markers.white_balance import Inline
from tests.slave import painted
from tests.slave.light_courses import (
    CANDLE,
    EXPOSURES,
    OPEN_S,
    RAMP,
    RATE_HZ,
    STEPS,
    STILL,
    SWITCHED,
    load_rig,
    outcome,
    standard_scene,
)

P = ParamSpec("P")
T = TypeVar("T")
MARKERS = load_rig().markers


# Each course on the scene and camera where it comes nearest to its bounds.
@pytest.mark.parametrize(
    ("schedule", "seed", "camera"),
    [(STEPS, 5, "left"), (EXPOSURES, 5, "left"), (RAMP, 9, "right"), (SWITCHED, 9, "right")],
    ids=["steps", "exposure", "ramp", "switched"],
)
def test_markers_stay_found_and_themselves(schedule: LightSchedule, seed: int, camera: str) -> None:
    got = outcome(schedule, seed, camera)
    assert got.visible > 500
    assert got.swaps == 0
    assert got.found >= 0.99 * outcome(STILL, seed, camera).found
    assert got.light_error < 0.06


def test_without_following_the_same_light_swaps_markers() -> None:
    assert outcome(RAMP, 5, "left", follow=False, seconds=6.0).swaps > 25


@pytest.mark.parametrize("kelvin", [3000.0, 6500.0])
@pytest.mark.parametrize("exposure", [0.7, 1.3])
def test_a_start_under_another_light_swaps_nothing_unwarned(kelvin: float, exposure: float) -> None:
    for begin_s in (0.0, 4.0, 15.0):  # an open hand, fists, a hand that shows few markers
        schedule = LightSchedule(((0.0, kelvin, exposure),))
        got = outcome(schedule, 7, "left", seconds=1.5, begin_s=begin_s, rate_hz=RATE_HZ)
        assert got.swaps_unwarned == 0
        if begin_s == 0.0:
            assert got.swaps == 0
            assert got.found >= 0.98 * outcome(STILL, 7, "left", seconds=1.5, rate_hz=RATE_HZ).found


def test_a_light_out_of_bounds_is_warned_of_before_it_costs_a_marker() -> None:
    got, still = outcome(CANDLE, 5, "left"), outcome(STILL, 5, "left")
    assert got.visible - got.found > 2 * (still.visible - still.found)  # it does cost some
    assert got.swaps_unwarned == 0
    assert got.missed_unwarned <= still.visible - still.found


class Later(Executor):
    """Workers that are busy: a job is done so many frames after it came."""

    def __init__(self, frames: int) -> None:
        self.frames = frames
        self._jobs: list[tuple[int, Callable[[], None]]] = []
        self._now = 0

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        future: Future[T] = Future()
        self._jobs.append((self._now + self.frames, lambda: future.set_result(fn(*args, **kwargs))))
        return future

    def frame(self) -> None:
        self._now += 1
        due = [job for at, job in self._jobs if at <= self._now]
        self._jobs = [item for item in self._jobs if item[0] > self._now]
        for job in due:
            job()


def test_while_the_colours_are_behind_nothing_is_reported() -> None:
    schedule = LightSchedule(((OPEN_S + 1.0, 4300.0, 1.0), (OPEN_S + 1.0, 3000.0, 1.0)))
    scene = replace(standard_scene(7), light=schedule)
    renderer, workers = Renderer(scene, "left"), Later(8)
    detector = LightAdaptiveDetector(scene.cameras["left"], MARKERS, workers)
    seen: list[int] = []
    for k in range(40):
        workers.frame()
        found = detector.push(renderer.render(OPEN_S + k / RATE_HZ), round(k * 1e9 / RATE_HZ))
        seen.append(int(np.isfinite(found.uv[:, 0]).sum()))
    assert seen[:8] == [0] * 8  # nothing is known of the light before the first answer
    assert min(seen[9:20]) >= 5
    assert seen[20:28] == [0] * 8  # the lamp was switched at frame 20
    assert min(seen[29:]) >= 5
    assert detector.refused == 16
    assert gain_difference(detector.log_gains, np.log(schedule.at(OPEN_S + 2.0).gains_bgr())) < 0.1


def test_it_says_that_a_light_is_not_known_and_what_to_do() -> None:
    ranges = {
        name: msgspec.structs.replace(painted.RANGES[name], reference_bgr_linear=tuple(painted.linear(paint)))
        for name, paint in ((name, painted.marker_hsv(m)) for m, name in enumerate(painted.NAMES))
    }
    camera = msgspec.structs.replace(painted.camera(), markers=ranges)
    detector = LightAdaptiveDetector(camera, painted.NAMES, Inline())
    single = painted.render(painted.finger(5, 300.0, 200.0), noise=2.0)
    found = detector.push(single, 0)
    assert [warning.marker for warning in detector.warnings] == [None]
    assert "show 2 or more markers" in detector.warnings[0].text
    assert np.isfinite(found.uv[5]).all()  # nothing speaks against the light of calibration
    detector.push(painted.render(painted.hand(), noise=2.0, seed=1), 1_000_000_000)
    detector.push(painted.render(painted.hand(), noise=2.0, seed=2), 1_200_000_000)
    detector.push(painted.render(painted.hand(), noise=2.0, seed=3), 1_300_000_000)
    assert detector.warnings == []


def test_the_same_frames_give_the_same_detections_and_a_fresh_start_keeps_the_light() -> None:
    schedule = LightSchedule(((0.0, 3200.0, 0.8), (2.0, 3600.0, 1.1)))
    scene = replace(standard_scene(7), light=schedule)
    renderer = Renderer(scene, "right")
    images = [renderer.render(k / RATE_HZ) for k in range(12)]
    one, two = (LightAdaptiveDetector(scene.cameras["right"], MARKERS, Inline()) for _ in range(2))
    for k, image in enumerate(images):
        t_ns = round(k * 1e9 / RATE_HZ)
        np.testing.assert_array_equal(one.push(image, t_ns).uv, two.push(image, t_ns).uv)
    fresh = one.fresh()
    assert gain_difference(fresh.log_gains, np.zeros(3)) > REFUSE
    assert np.isfinite(fresh.push(images[-1], 10**9).uv[:, 0]).sum() >= 5


def test_a_camera_file_without_reference_colours_cannot_follow() -> None:
    assert can_adapt(standard_scene(7).cameras["left"], MARKERS)
    assert not can_adapt(painted.camera(), painted.NAMES)
    assert not can_adapt(msgspec.structs.replace(painted.camera(), markers=None), painted.NAMES)
    assert isinstance(
        detector_for(standard_scene(7).cameras["left"], MARKERS, Inline()), LightAdaptiveDetector
    )
    assert isinstance(detector_for(painted.camera(), painted.NAMES, Inline()), MarkerDetector)
    with pytest.raises(ValueError, match="reference"):
        LightAdaptiveDetector(painted.camera(), painted.NAMES, Inline())


def test_with_the_light_of_calibration_it_detects_as_without() -> None:
    scene = standard_scene(7)
    renderer, camera = Renderer(scene, "left"), scene.cameras["left"]
    plain, adaptive = MarkerDetector(camera, MARKERS), LightAdaptiveDetector(camera, MARKERS, Inline())
    for k in range(20):
        image, t_ns = renderer.render(20.0 + k / RATE_HZ), round(k * 1e9 / RATE_HZ)
        np.testing.assert_allclose(adaptive.push(image, t_ns).uv, plain.push(image, t_ns).uv, atol=0.2)
