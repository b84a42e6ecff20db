"""Time of marker detection against the published pipeline, on generated frames, in one process and one thread.

Compared steps are taken in turn on the thread's own processor time, so that a busy machine slows all alike; a ratio
comes with half its interquartile range over the turns.
"""

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import replace
from time import thread_time_ns

import cv2
import numpy as np

from bench.markers.accuracy import clicks
from bench.markers.published import detect
from bench.markers.scene import KINDS, STEP_NS, Kind, MarkerFrame, sequences
from bench.report import Row
from common.arrays import Float, Image
from slave.markers.detector import MarkerDetector
from slave.markers.engine import NUMPY, Engine, engine_named

Step = Callable[[], object]


def rows() -> Iterator[Row]:
    """Measure times on generated frames, of 640x480 but where stated."""
    cv2.setNumThreads(1)
    six, large = Timed(KINDS["finger_end"]), Timed(KINDS["1456x1088"], scenes=1, frames=4)
    steps: dict[str, Step] = {"published": six.published()}
    engines: dict[str, Engine] = {"": NUMPY}
    if importlib.util.find_spec("numba") is not None:  # an optional package of slaves
        engines[" by numba"] = engine_named("numba")
    for by, engine in engines.items():
        for size, timed in (("", six), (", 1456x1088", large)):
            steps[f"whole{by}{size}"] = timed.ours(6, engine)
            steps[f"windows{by}{size}"] = timed.ours(6, engine, windows_only=True)
    took = interleaved(steps)
    yield time_row("published pipeline, 6 markers", took["published"], "baseline")
    yield time_row("our detector, 6 markers, whole frame, refined", took["whole"])
    for by in engines:
        yield _ratio(f"published / ours{by}", took["published"], took[f"whole{by}"])
        for size in ("", ", 1456x1088"):
            ratio = took[f"whole{by}{size}"], took[f"windows{by}{size}"]
            yield _ratio(f"whole frame / windows{by}{size}", *ratio)


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


def interleaved(steps: dict[str, Step], repeats: int = 40, warm: int = 3) -> dict[str, Float]:
    """Return durations of each step [us], (repeats,), the steps taken in turn.

    A turn of a step is a few frames, the first not counted: it finds in the caches what another step left there.
    """
    samples = {name: np.empty(repeats) for name in steps}
    for k in range(-warm, repeats):
        for name, step in steps.items():
            step()
            start_ns = thread_time_ns()
            for _ in range(4):
                step()
            if k >= 0:
                samples[name][k] = (thread_time_ns() - start_ns) * 1e-3 / 4
    return samples


def time_row(name: str, took: Float, note: str = "") -> Row:
    """Return the row of durations (N,) [us]."""
    low, middle, high = np.percentile(took, (25.0, 50.0, 75.0)).tolist()
    spread = f"quartiles ±{(high - low) / 2.0:.0f}"
    return Row(name, middle, "us", f"{note}; {spread}" if note else spread)


def _ratio(name: str, above: Float, below: Float) -> Row:
    low, high = np.percentile(above / below, (25.0, 75.0)).tolist()
    value = float(np.median(above) / np.median(below))
    return Row(name, value, "x", f"quartiles ±{(high - low) / 2.0:.2f}")
