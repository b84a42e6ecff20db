"""The speed rows run what they name: frames to and fro, each step with its own place."""

from dataclasses import replace

import numpy as np

from bench.markers.scene import KINDS
from bench.markers.speed import Timed, interleaved
from slave.markers.detector import Detections


def test_frames_go_to_and_fro_and_markers_stay_found() -> None:
    timed = Timed(replace(KINDS["320x240"]), scenes=2, frames=3)
    step = timed.ours(6)
    seen: list[Detections] = []
    for _ in range(12):
        found = step()
        assert isinstance(found, Detections)
        seen.append(found)
    for turn, found in enumerate(seen):
        scene, place = turn % 2, (0, 1, 2, 1)[(turn // 2) % 4]
        np.testing.assert_allclose(found.uv, timed.scenes[scene][place].uv, atol=1.0)


def test_every_step_is_taken_equally_often() -> None:
    counts = {"a": 0, "b": 0}

    def counter(name: str) -> None:
        counts[name] += 1

    took = interleaved({"a": lambda: counter("a"), "b": lambda: counter("b")}, repeats=5, warm=2)
    assert counts["a"] == counts["b"]
    assert all(np.all(samples > 0.0) and samples.shape == (5,) for samples in took.values())
