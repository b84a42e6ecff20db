"""How fast markers are found, against the published pipeline, on generated frames, in one process and one thread.

Steps that are compared are taken in turn, and the clock is that of the thread's own processor time, so that a busy
machine slows all alike; a ratio comes with half the distance of its quartiles over the turns. The standard scene
follows, with what both pipelines find in it.
"""

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import thread_time_ns
from typing import Final

import cv2
import numpy as np

from bench.marker_frames import STEP_NS, MarkerFrame, sequences
from bench.marker_kinds import KINDS, Kind
from bench.marker_score import Score, clicks, score
from bench.seed_markers import detect
from common.arrays import Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.markers.detector import MarkerDetector
from slave.markers.engine import NUMPY, Engine, engine_named

CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
FRAMES: Final = 240  # judged, spread over the minute of the standard scene
TIMED: Final = 12
REPEATS, WARM, BURST = 40, 3, 4
OPEN_S: Final = 20.0  # an open hand: all six markers in view
VISIBLE: Final = 0.5
NUMBA: Final = importlib.util.find_spec("numba") is not None  # an optional package: its row only where it is

Step = Callable[[], object]
Row = tuple[str, float, str, str]


def rows() -> list[Row]:
    """Rows (name, value, unit, what it is held against)."""
    cv2.setNumThreads(1)
    return [*_generated(), *_standard()]


def _generated() -> list[Row]:
    six, twelve, many = (Timed(KINDS[name]) for name in ("finger_end", "twelve", "twentyfour"))
    small, large = Timed(KINDS["320x240"]), Timed(KINDS["1456x1088"], scenes=1, frames=4)
    numba: dict[str, Step] = {}
    if NUMBA:
        engine = engine_named("numba")
        numba = {"numba": six.ours(6, engine), "numba windows": six.ours(6, engine, windows_only=True)}
    took = interleaved(
        numba
        | {
            "published": six.published(),
            "ours": six.ours(6),
            "windows": six.ours(6, windows_only=True),
            "large windows": large.ours(6, windows_only=True),
            "anew": six.reinitialised(),
            "6 of 12": twelve.ours(6),
            "12": twelve.ours(12),
            "6 of 24": many.ours(6),
            "24": many.ours(24),
            "24 published": many.published(),
            "small published": small.published(),
            "small": small.ours(6),
            "large published": large.published(),
            "large": large.ours(6),
        }
    )
    return [
        _time("published pipeline, 6 markers", took["published"], "baseline"),
        _time("our detector, 6 markers, whole frame, refined", took["ours"], ""),
        _ratio("published / ours", took["published"], took["ours"], "goal >= 9"),
        *[_ratio(f"published / ours with {n}", took["published"], took[n], "goal >= 20") for n in numba],
        _ratio("whole frame / windows", took["ours"], took["windows"], ""),
        _ratio("whole frame / windows, 1456x1088", took["large"], took["large windows"], ""),
        _ratio("every marker sought anew / tracked", took["anew"], took["ours"], "goal <= 1.3"),
        _ratio("12 markers / 6 of them", took["12"], took["6 of 12"], "goal <= 1.5"),
        _ratio("24 markers / 6 of them", took["24"], took["6 of 24"], ""),
        _ratio("published / ours, 24 markers", took["24 published"], took["24"], ""),
        _ratio("published / ours, 320x240", took["small published"], took["small"], ""),
        _ratio("published / ours, 1456x1088", took["large published"], took["large"], ""),
    ]


class Timed:
    """Frames of a few scenes of one kind, and steps that run a pipeline over them; every step holds its own place.

    Within a scene the frames go to and fro, so that motion stays small and the tracks alive.
    """

    def __init__(self, kind: Kind, scenes: int = 3, frames: int = 6) -> None:
        """Render the frames."""
        self.kind = replace(kind, frames=frames)
        self.scenes: list[list[MarkerFrame]] = [list(frames) for frames in sequences(self.kind, scenes)]
        self._camera = kind.camera

    def published(self) -> Step:
        """The published pipeline on the next frame."""
        ranges = [(self._camera.markers or {})[name] for name in self.kind.names]
        return self._each(lambda scene, image, t_ns: detect(image, ranges))

    def ours(self, count: int, engine: Engine = NUMPY, *, windows_only: bool = False) -> Step:
        """Our detector, looking for the first `count` markers, each pointed out in the first frame."""
        names = self.kind.names[:count]
        first = MarkerDetector(self._camera, names, engine=engine)
        first.windows_only = windows_only
        detectors = [first.fresh(clicks(self.kind, scene[0])) for scene in self.scenes]
        return self._each(lambda scene, image, t_ns: detectors[scene].push(image, t_ns))

    def reinitialised(self) -> Step:
        """Our detector when it knows nothing."""
        detector = MarkerDetector(self._camera, self.kind.names)
        return self._each(lambda scene, image, t_ns: detector.fresh().push(image, t_ns))

    def _each(self, run: Callable[[int, Image, int], object]) -> Step:
        count = -1

        def step() -> object:
            nonlocal count
            count += 1
            turn, scene = divmod(count, len(self.scenes))
            frames = self.scenes[scene]
            place = turn % (2 * len(frames) - 2)
            frame = frames[min(place, 2 * len(frames) - 2 - place)]
            return run(scene, frame.image, turn * STEP_NS)

        return step


def interleaved(steps: dict[str, Step], repeats: int = REPEATS, warm: int = WARM) -> dict[str, Float]:
    """Durations of each step [us], (repeats,), the steps taken in turn.

    A turn of a step is a few frames, the first not counted: it finds in the caches what another step left there,
    while a camera's computer has one detector and its own tables.
    """
    samples = {name: np.empty(repeats) for name in steps}
    for k in range(-warm, repeats):
        for name, step in steps.items():
            step()
            start_ns = thread_time_ns()
            for _ in range(BURST):
                step()
            if k >= 0:
                samples[name][k] = (thread_time_ns() - start_ns) * 1e-3 / BURST
    return samples


def _time(name: str, took: Float, note: str) -> Row:
    low, middle, high = np.percentile(took, (25.0, 50.0, 75.0)).tolist()
    spread = f"quartiles ±{(high - low) / 2.0:.0f}"
    return name, middle, "us", f"{note}; {spread}" if note else spread


def _ratio(name: str, above: Float, below: Float, goal: str) -> Row:
    low, high = np.percentile(above / below, (25.0, 75.0)).tolist()
    value = float(np.median(above) / np.median(below))
    spread = f"quartiles ±{(high - low) / 2.0:.2f}"
    return name, value, "x", f"{goal}; {spread}" if goal else spread


def _standard() -> list[Row]:
    camera, names, renderer = _open()
    ranges = [(camera.markers or {})[n] for n in names]
    images = [renderer.render(OPEN_S + 0.005 * k) for k in range(TIMED)]
    detector = MarkerDetector(camera, names)
    took = interleaved(
        {
            "published": _over(images, lambda image, t_ns: detect(image, ranges)),
            "ours": _over(images, detector.push),
        }
    )
    mine, theirs = _judge(renderer, detector.fresh(), camera, names)
    return [
        _ratio("standard scene: published / ours", took["published"], took["ours"], "goal >= 9"),
        ("standard scene: error per axis, ours", mine.rms_px, "px RMS", f"published {theirs.rms_px:.3f}, goal 0.1"),
        ("standard scene: found of half visible", 100.0 * mine.found, "%", f"published {100 * theirs.found:.1f}"),
        ("standard scene: wrong blobs", mine.wrong, "count", f"of {mine.judged}; published {theirs.wrong}; goal 0"),
    ]  # fmt: skip


def _open() -> tuple[CameraCalibration, tuple[str, ...], Renderer]:
    rig = load(CALIBRATION / "rigs/desk.json", RigCalibration)
    cameras = {n: load(CALIBRATION / f"cameras/{n}.json", CameraCalibration) for n in rig.cameras}
    hand = load(CALIBRATION / f"hands/{rig.hand}.json", HandProfile)
    name = rig.cameras[0]
    return cameras[name], rig.markers, Renderer(Scene.standard(rig, cameras, hand), name)


def _over(images: list[Image], run: Callable[[Image, int], object]) -> Step:
    count = 0

    def step() -> object:
        nonlocal count
        count += 1
        return run(images[count % len(images)], count * STEP_NS)

    return step


def _judge(
    renderer: Renderer, detector: MarkerDetector, camera: CameraCalibration, names: tuple[str, ...]
) -> tuple[Score, Score]:
    """Scores of both over the minute: errors of what both saw, found of what is half visible, all wrong blobs."""
    ranges = [(camera.markers or {})[n] for n in names]
    ours, published, truths = [], [], []
    visible: list[Float] = []
    radius: list[Float] = []
    for k in range(FRAMES):
        t_s = 60.0 * k / FRAMES
        image, truth = renderer.observe(t_s)
        ours.append(detector.push(image, round(t_s * 1e9)).uv)
        published.append(detect(image, ranges))
        truths.append(truth.uv)
        visible.append(truth.visible)
        radius.append(np.sqrt(truth.area / np.pi))
    a, b, truth_uv, r = (np.concatenate(part) for part in (ours, published, truths, radius))
    half = np.concatenate(visible) >= VISIBLE
    both = half & np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    scores: list[Score] = []
    for uv in (a, b):
        every, seen = score(uv, truth_uv, r), score(uv[both], truth_uv[both], r[both])
        found = score(uv[half], truth_uv[half], r[half]).found
        judged = int(np.isfinite(uv[:, 0]).sum())
        scores.append(replace(seen, found=found, wrong=every.wrong, judged=judged))
    return scores[0], scores[1]
