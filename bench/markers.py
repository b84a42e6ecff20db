"""Marker detection against the published pipeline, on frames of the standard scene, in one process and one thread."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter_ns

import cv2
import msgspec
import numpy as np

from bench.seed_markers import detect
from common.arrays import Bool, Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.markers.detector import MarkerDetector

CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
STEP_NS = 16_666_667
FRAMES = 240  # judged, spread over the minute of the scene
TIMED = 12
REPEATS, WARM = 150, 15
OPEN_S = 20.0  # an open hand: all six markers in view
VISIBLE = 0.5
FREE_PX = 3.0


@dataclass(frozen=True, slots=True)
class _Accuracy:
    """Over the judged frames: RMS per axis [px] of what both saw, found share, wrong blobs."""

    rms_px: float
    found: float
    wrong: int
    judged: int


def rows() -> list[tuple[str, float, str, str]]:
    """Rows (name, value, unit, what it is held against)."""
    cv2.setNumThreads(1)
    camera, names, renderer = _open()
    ranges = [(camera.markers or {})[n] for n in names]
    timed = [renderer.render(OPEN_S + 0.005 * k) for k in range(TIMED)]
    detector = MarkerDetector(camera, names)
    turn = iter(range(1_000_000))
    seed, ours, lost, twelve = _interleaved(
        [
            lambda: detect(timed[next(turn) % TIMED], ranges),
            _stepper(detector, timed),
            lambda: detector.fresh().push(timed[next(turn) % TIMED], 0),
            _stepper(*_twelve(camera, names, timed)),
        ]
    )
    mine, theirs = _judge(renderer, MarkerDetector(camera, names), camera, names)
    return [
        ("published pipeline, 6 markers", seed, "us", "baseline, same run, taken in turn"),
        ("our detector, 6 markers, whole frame, refined", ours, "us", ""),
        ("published / ours", seed / ours, "x", "goal >= 9"),
        ("every marker sought anew / tracked", lost / ours, "x", "goal <= 1.3"),
        ("12 markers / 6 markers", twelve / ours, "x", "goal <= 1.5"),
        ("centroid error per axis, ours", mine.rms_px, "px RMS", f"published {theirs.rms_px:.3f}, goal 0.1"),
        ("found of those half visible", 100.0 * mine.found, "%", f"published {100 * theirs.found:.1f}, goal 95"),
        ("wrong blobs, ours", mine.wrong, "count", f"of {mine.judged}; published {theirs.wrong}; goal 0"),
    ]  # fmt: skip


def _open() -> tuple[CameraCalibration, tuple[str, ...], Renderer]:
    rig = load(CALIBRATION / "rigs/desk.json", RigCalibration)
    cameras = {n: load(CALIBRATION / f"cameras/{n}.json", CameraCalibration) for n in rig.cameras}
    hand = load(CALIBRATION / f"hands/{rig.hand}.json", HandProfile)
    name = rig.cameras[0]
    return cameras[name], rig.markers, Renderer(Scene.standard(rig, cameras, hand), name)


def _stepper(detector: MarkerDetector, images: list[Image]) -> Callable[[], object]:
    count = 0

    def step() -> object:
        nonlocal count
        count += 1
        return detector.push(images[count % len(images)], count * STEP_NS)

    return step


def _interleaved(steps: list[Callable[[], object]]) -> list[float]:
    """Median duration of each step [us], the steps taken in turn, so that a busy machine slows all alike."""
    samples = np.empty((REPEATS, len(steps)))
    for k in range(-WARM, REPEATS):
        for i, step in enumerate(steps):
            start_ns = perf_counter_ns()
            step()
            samples[k, i] = (perf_counter_ns() - start_ns) * 1e-3
    return np.median(samples, axis=0).tolist()


def _twelve(
    camera: CameraCalibration, names: tuple[str, ...], images: list[Image]
) -> tuple[MarkerDetector, list[Image]]:
    """Twelve markers: six more colours, and a second hand in them on the other side of the picture."""
    ranges = dict(camera.markers or {})
    second: dict[str, tuple[int, int, int]] = {}
    for name in names:
        low, high = ranges[name].hsv_low, ranges[name].hsv_high
        hue = (low[0] + high[0]) // 2 if low[0] <= high[0] else 0
        ranges[name] = msgspec.structs.replace(ranges[name], hsv_high=(high[0], 255, 235))
        second[f"{name}2"] = (hue, 200, 250)
        ranges[f"{name}2"] = msgspec.structs.replace(
            ranges[name], hsv_low=(low[0], low[1], 236), hsv_high=high
        )
    every = (*names, *second)
    marked: list[Image] = []
    for image in images:
        image = image.copy()
        for k, hsv in enumerate(second.values()):
            pixel = np.asarray(cv2.cvtColor(np.array([[hsv]], np.uint8), cv2.COLOR_HSV2BGR))[0, 0]
            cv2.circle(image, (60 + 28 * k, 74 + 11 * (k % 2)), 12, (140, 165, 215), -1, cv2.LINE_AA)
            cv2.circle(image, (60 + 28 * k, 60 + 11 * (k % 2)), 8, [int(c) for c in pixel], -1, cv2.LINE_AA)
        marked.append(image)
    return MarkerDetector(msgspec.structs.replace(camera, markers=ranges), every), marked


def _judge(
    renderer: Renderer, detector: MarkerDetector, camera: CameraCalibration, names: tuple[str, ...]
) -> tuple[_Accuracy, _Accuracy]:
    ranges = [(camera.markers or {})[n] for n in names]
    ours: list[Float] = []
    published: list[Float] = []
    truths: list[Float] = []
    visible: list[Float] = []
    areas: list[Float] = []
    for k in range(FRAMES):
        t_s = 60.0 * k / FRAMES
        image, truth = renderer.observe(t_s)
        ours.append(detector.push(image, round(t_s * 1e9)).uv)
        published.append(detect(image, ranges))
        truths.append(truth.uv)
        visible.append(truth.visible)
        areas.append(truth.area)
    half = np.array(visible) >= VISIBLE
    allowed = np.maximum(FREE_PX, np.sqrt(np.array(areas) / np.pi))
    a, b = np.array(ours), np.array(published)
    both = half & np.isfinite(a[..., 0]) & np.isfinite(b[..., 0])
    return _accuracy(a, np.array(truths), half, allowed, both), _accuracy(
        b, np.array(truths), half, allowed, both
    )


def _accuracy(uv: Float, truth: Float, half: Bool, allowed: Float, both: Bool) -> _Accuracy:
    seen = np.isfinite(uv[..., 0])
    error = uv - truth
    right = np.hypot(error[..., 0], error[..., 1]) <= allowed
    counted = error[both & right]
    rms_px = float(np.sqrt(np.mean(np.square(counted))))
    found = float((seen & half).sum() / half.sum())
    return _Accuracy(rms_px, found, int((seen & ~right).sum()), int(seen.sum()))
