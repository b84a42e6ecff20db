"""Time of marker detection against the published pipeline, on generated frames, in one process and one thread.

Steps that are compared are taken in turn, and the clock is that of the thread's own processor time, so that a busy
machine slows all alike; a ratio comes with half its interquartile range over the turns. The standard scene follows.
"""

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import replace
from time import thread_time_ns

import cv2
import numpy as np

from bench.markers.accuracy import Score, clicks, score
from bench.markers.frames import STEP_NS, MarkerFrame, sequences
from bench.markers.kinds import KINDS, Kind
from bench.markers.published import detect
from bench.report import Row, rig_files
from common.arrays import Float, Image
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.markers.detector import MarkerDetector
from slave.markers.engine import NUMPY, Engine, engine_named

_FRAMES = 240  # judged, spread over the minute of the standard scene
_REPEATS, _WARM, _BURST = 40, 3, 4
_VISIBLE = 0.5

Step = Callable[[], object]


def rows() -> Iterator[Row]:
    """Measure times on generated frames, and errors in the standard scene."""
    cv2.setNumThreads(1)
    six, many = Timed(KINDS["finger_end"]), Timed(KINDS["twentyfour"])
    small, large = Timed(KINDS["320x240"]), Timed(KINDS["1456x1088"], scenes=1, frames=4)
    numba: dict[str, Step] = {}
    if importlib.util.find_spec("numba") is not None:  # an optional package of slaves
        engine = engine_named("numba")
        numba = {"numba": six.ours(6, engine), "numba windows": six.ours(6, engine, windows_only=True)}
    took = interleaved(
        numba
        | {
            "published": six.published(),
            "ours": six.ours(6),
            "windows": six.ours(6, windows_only=True),
            "anew": six.reinitialised(),
            "24": many.ours(24),
            "24 published": many.published(),
            "small published": small.published(),
            "small": small.ours(6),
            "large published": large.published(),
            "large": large.ours(6),
        }
    )
    yield time_row("published pipeline, 6 markers", took["published"], "baseline")
    yield time_row("our detector, 6 markers, whole frame, refined", took["ours"])
    yield _ratio("published / ours", took["published"], took["ours"])
    for name in numba:
        yield _ratio(f"published / ours with {name}", took["published"], took[name])
    yield _ratio("whole frame / windows", took["ours"], took["windows"])
    yield _ratio("every marker sought anew / tracked", took["anew"], took["ours"], "goal <= 1.3")
    yield _ratio("published / ours, 24 markers", took["24 published"], took["24"])
    yield _ratio("published / ours, 320x240", took["small published"], took["small"])
    yield _ratio("published / ours, 1456x1088", took["large published"], took["large"])
    mine, theirs = _standard()
    found, wrong = (
        f"published {100 * theirs.found:.1f}",
        f"of {mine.judged}; published {theirs.wrong}; goal 0",
    )
    yield Row(
        "standard scene: error per axis", mine.rms_px, "px RMS", f"published {theirs.rms_px:.3f}, goal 0.1"
    )
    yield Row("standard scene: found of half visible", 100.0 * mine.found, "%", found)
    yield Row("standard scene: wrong blobs", mine.wrong, "count", wrong)


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
        """Return a step: the published pipeline on the next frame."""
        ranges = [(self._camera.markers or {})[name] for name in self.kind.names]
        return self._each(lambda scene, image, t_ns: detect(image, ranges))

    def ours(self, count: int, engine: Engine = NUMPY, *, windows_only: bool = False) -> Step:
        """Return a step: our detector on the first `count` markers, each clicked on in the first frame."""
        names = self.kind.names[:count]
        first = MarkerDetector(self._camera, names, engine=engine)
        first.windows_only = windows_only
        detectors = [first.fresh(clicks(self.kind, scene[0])) for scene in self.scenes]
        return self._each(lambda scene, image, t_ns: detectors[scene].push(image, t_ns))

    def reinitialised(self) -> Step:
        """Return a step: our detector when it knows nothing."""
        detector = MarkerDetector(self._camera, self.kind.names)
        return self._each(lambda scene, image, t_ns: detector.fresh().push(image, t_ns))

    def _each(self, run: Callable[[int, Image, int], object]) -> Step:
        count = -1

        def step() -> object:
            nonlocal count
            count += 1
            rotation, scene = divmod(count, len(self.scenes))
            frames = self.scenes[scene]
            place = rotation % (2 * len(frames) - 2)
            frame = frames[min(place, 2 * len(frames) - 2 - place)]
            return run(scene, frame.image, rotation * STEP_NS)

        return step


def interleaved(steps: dict[str, Step], repeats: int = _REPEATS, warm: int = _WARM) -> dict[str, Float]:
    """Return durations of each step [us], (repeats,), the steps taken in turn.

    A turn of a step is a few frames, the first not counted: it finds in the caches what another step left there,
    while a camera's computer has one detector and its own tables.
    """
    samples = {name: np.empty(repeats) for name in steps}
    for k in range(-warm, repeats):
        for name, step in steps.items():
            step()
            start_ns = thread_time_ns()
            for _ in range(_BURST):
                step()
            if k >= 0:
                samples[name][k] = (thread_time_ns() - start_ns) * 1e-3 / _BURST
    return samples


def time_row(name: str, took: Float, note: str = "") -> Row:
    """Return the row of durations (N,) [us]."""
    low, middle, high = np.percentile(took, (25.0, 50.0, 75.0)).tolist()
    spread = f"quartiles ±{(high - low) / 2.0:.0f}"
    return Row(name, middle, "us", f"{note}; {spread}" if note else spread)


def _ratio(name: str, above: Float, below: Float, goal: str = "") -> Row:
    low, high = np.percentile(above / below, (25.0, 75.0)).tolist()
    value = float(np.median(above) / np.median(below))
    spread = f"quartiles ±{(high - low) / 2.0:.2f}"
    return Row(name, value, "x", f"{goal}; {spread}" if goal else spread)


def _standard() -> tuple[Score, Score]:
    """Scores of both over a minute: errors of markers both found, found of half visible ones, all wrong blobs."""
    rig, cameras, hand = rig_files("desk")
    camera = cameras[rig.cameras[0]]
    renderer = Renderer(Scene.standard(rig, cameras, hand), camera.name)
    ranges, detector = [(camera.markers or {})[n] for n in rig.markers], MarkerDetector(camera, rig.markers)
    found: list[tuple[Float, ...]] = []
    for k in range(_FRAMES):
        t_s = 60.0 * k / _FRAMES
        image, truth = renderer.observe(t_s)
        uv = detector.push(image, round(t_s * 1e9)).uv
        found.append((uv, detect(image, ranges), truth.uv, truth.visible, np.sqrt(truth.area / np.pi)))
    a, b, truth_uv, visible, r = (np.concatenate(part) for part in zip(*found, strict=True))
    half = visible >= _VISIBLE
    both = half & np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    scores: list[Score] = []
    for uv in (a, b):
        seen = score(uv[both], truth_uv[both], r[both])
        share, judged = score(uv[half], truth_uv[half], r[half]).found, int(np.isfinite(uv[:, 0]).sum())
        scores.append(replace(seen, found=share, wrong=score(uv, truth_uv, r).wrong, judged=judged))
    return scores[0], scores[1]
