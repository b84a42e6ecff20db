"""The watch over ten thousand frames bites: a planted leak and a planted slow sort of frame are seen."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from bench.steadiness import KIND, PAUSE_NS, TRACKED, Shot, Watched, shots, traced_growth, watch
from common.arrays import Image
from slave.markers.detector import MarkerDetector

PICTURE = np.zeros((4, 4, 3), np.uint8)
CYCLE = [Shot(TRACKED, PICTURE, 1), Shot(TRACKED, PICTURE, 1), Shot("odd", PICTURE + 1, 1)]


class Leaking:
    """Keeps `kept` bytes of every frame."""

    def __init__(self, kept: int) -> None:
        self.kept = kept
        self.pile: list[bytearray] = []

    def push(self, image: Image, t_ns: int) -> None:
        if self.kept:
            self.pile.append(bytearray(b"\x01" * self.kept))


def test_a_leak_is_seen_and_nothing_is_not() -> None:
    leak = traced_growth(Leaking(4096), CYCLE, frames=600)
    np.testing.assert_allclose(leak, 4096e3, rtol=0.1)
    assert abs(traced_growth(Leaking(0), CYCLE, frames=600)) < 20_000.0


def growth(kept: int) -> float:
    """Growth of the resident set [bytes per 1000 frames] while `kept` bytes of every frame are kept."""
    return watch(Leaking(kept), CYCLE, frames=1200, warm=300).resident_growth


def test_the_resident_set_shows_a_large_leak() -> None:
    # In a process of its own: what other tests had given back would take up a leak, and none would be seen.
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        assert fresh.submit(growth, 65536).result() == pytest.approx(65536e3, rel=0.3)
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        assert abs(fresh.submit(growth, 0).result()) < 1e6


def test_every_sort_of_frame_is_counted_after_warming_up() -> None:
    seen = watch(Leaking(0), CYCLE, frames=330, warm=30)
    assert {sort: took.size for sort, took in seen.took_us.items()} == {TRACKED: 200, "odd": 100}


def test_the_worst_sort_is_that_of_the_largest_median_not_of_the_largest_value() -> None:
    took = {
        TRACKED: np.full(9, 10.0),
        "slow": np.full(9, 14.0),
        "hiccup": np.array([10.0] * 8 + [500.0]),
    }
    assert Watched(took, 0.0).worst == ("slow", pytest.approx(1.4))


def test_the_cycle_holds_every_sort_and_the_detector_meets_it() -> None:
    cycle = shots()
    assert {shot.sort for shot in cycle} == {
        TRACKED,
        "one marker lost",
        "back",
        "clutter",
        "ambiguous",
        "nothing in view",
        "all sought anew",
        "all sought anew in clutter",
    }
    detector = MarkerDetector(KIND.camera, KIND.names)
    t_ns, found = 0, dict[str, int]()
    for shot in (*cycle, *cycle):
        t_ns += shot.after_ns
        found[shot.sort] = int(np.isfinite(detector.push(shot.image, t_ns).uv[:, 0]).sum())
        assert (shot.after_ns == PAUSE_NS) == ("anew" in shot.sort)
    assert found["nothing in view"] == 0
    assert found["one marker lost"] == 5
    assert found[TRACKED] == found["back"] == 6
