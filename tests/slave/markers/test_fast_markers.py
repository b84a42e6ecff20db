"""Machine code finds and measures what numpy does, on generated frames of all kinds and on the standard scene."""

import importlib.util
import sys
from collections.abc import Iterator, Sequence
from functools import cache

import cv2
import numpy as np
import pytest

from bench.markers.accuracy import clicks
from bench.markers.scene import KINDS, MarkerFrame, sequences
from common.arrays import Image
from common.calibration import HsvRange
from common.errors import PhalanxError
from common.geometry.srgb import gain_tables
from common.sim.render import Renderer
from common.sim.scene import STANDARD_SEED
from slave.markers import centroid
from slave.markers.centroid import Measured
from slave.markers.classify import Blob, ColourTable, find_blobs
from slave.markers.detector import MarkerDetector
from slave.markers.engine import NUMPY, Engine, engine_named
from tests.slave.light_courses import standard_scene
from tests.slave.painted import RANGES, hand, render

INSTALLED = importlib.util.find_spec("numba") is not None
needs_numba = pytest.mark.skipif(
    not INSTALLED, reason="numba is not installed (pip install phalanx-hand[fast])"
)
TABLE = ColourTable(list(RANGES.values()))
Call = tuple[Image, ColourTable, list[int], list[Blob], list[bool]]


@pytest.fixture(scope="module")
def numba() -> Engine:
    return engine_named("numba")


# Of two kinds that differ in degree the harder one.
HARDEST = tuple(name for name in KINDS if name not in ("blur3", "1280x960"))


@cache
def drawn(name: str) -> list[list[MarkerFrame]]:
    return [list(frames) for frames in sequences(KINDS[name], 2, seed=5)]


def generated(name: str, engine: Engine) -> Iterator[tuple[MarkerDetector, Image, int]]:
    kind = KINDS[name]
    first = MarkerDetector(kind.camera, kind.names, engine=engine)
    for frames in drawn(name):
        pushed = first.fresh(clicks(kind, frames[0]) if kind.clicked else None)
        for frame in frames:
            yield pushed, frame.image, frame.t_ns


@cache
def standard_images() -> list[Image]:
    renderer = Renderer(standard_scene(STANDARD_SEED), "left")
    return [renderer.render(5.0 * k) for k in range(12)]


def standard(engine: Engine) -> Iterator[tuple[MarkerDetector, Image, int]]:
    scene = standard_scene(STANDARD_SEED)
    pushed = MarkerDetector(scene.cameras["left"], scene.rig.markers, engine=engine)
    for k, image in enumerate(standard_images()):
        yield pushed, image, round(5e9 * k)


def frames(name: str, engine: Engine = NUMPY) -> Iterator[tuple[MarkerDetector, Image, int]]:
    return standard(engine) if name == "standard" else generated(name, engine)


def calls_of(name: str) -> list[Call]:
    """What the detector asks to be measured on the frames of a kind."""
    calls: list[Call] = []

    def noting(
        image: Image, table: ColourTable, bits: Sequence[int], blobs: Sequence[Blob], alone: Sequence[bool]
    ) -> list[Measured | None]:
        calls.append((image, table, list(bits), list(blobs), list(alone)))
        return centroid.measure(image, table, bits, blobs, alone)

    for pushed, image, t_ns in frames(name, Engine(NUMPY.scan_blobs, noting, NUMPY.prepare)):
        pushed.push(image, t_ns)
    return calls


def differs(a: Measured | None, b: Measured | None) -> bool:
    if a is None or b is None:
        return a is not b
    return (
        max(abs(a.u - b.u), abs(a.v - b.v)) > 1e-3
        or abs(a.area - b.area) > 1e-3 * a.area
        or (a.cut, a.thin) != (b.cut, b.thin)
        or abs(a.contrast - b.contrast) > 1e-3 * a.contrast
        or max(abs(x - y) for x, y in zip((*a.colour, a.foreign), (*b.colour, b.foreign), strict=True)) > 1e-3
        or max(abs(a.xx - b.xx), abs(a.xy - b.xy), abs(a.yy - b.yy)) > 1e-2
    )


@needs_numba
@pytest.mark.parametrize("name", [*HARDEST, "standard"])
def test_what_is_measured_is_the_same(numba: Engine, name: str) -> None:
    count = differing = 0
    for image, table, bits, blobs, alone in calls_of(name):
        together = centroid.measure(image, table, bits, blobs, alone)
        fast = numba.measure(image, table, bits, blobs, alone)
        for k, (one, other) in enumerate(zip(together, fast, strict=True)):
            count += 1
            (single,) = centroid.measure(image, table, bits[k : k + 1], blobs[k : k + 1], alone[k : k + 1])
            if differs(one, single):
                # Paint at the border of its window touches the next window of the stack: numpy has two answers.
                differing += differs(single, other)
                continue
            assert not differs(one, other)
            if one is not None and other is not None:
                height, width = other.window.shape
                np.testing.assert_allclose(one.window[:height, :width], other.window, atol=1e-3)
                assert (one.left, one.top) == (other.left, other.top)
    assert count >= 40
    assert differing <= 0.02 * count


@needs_numba
@pytest.mark.parametrize("name", [*HARDEST, "standard"])
def test_blobs_and_codes_are_the_same_on_every_grid(numba: Engine, name: str) -> None:
    seen = 0
    for pushed, image, _ in frames(name):
        table = pushed.table
        for grid in ((4, 0, 0), (2, 0, 0), (4, 2, 2), (4, 0, 2), (4, 3, 3)):
            codes = table.scan(image, *grid)
            fast_codes, fast = numba.scan_blobs(image, table, table.bits, *grid, None)
            np.testing.assert_array_equal(fast_codes, codes)
            assert_same_blobs(find_blobs(codes, table.bits, *grid), fast)
            seen += sum(map(len, fast))
    assert seen > 100


@needs_numba
@pytest.mark.parametrize("name", ["finger_end", "clutter", "standard"])
def test_the_detections_of_a_sequence_are_the_same(numba: Engine, name: str) -> None:
    rows = 0
    for (ours, image, t_ns), (theirs, _, _) in zip(frames(name, numba), frames(name), strict=True):
        fast, slow = ours.push(image, t_ns), theirs.push(image, t_ns)
        np.testing.assert_allclose(fast.uv, slow.uv, atol=1e-3)
        np.testing.assert_allclose(fast.area, slow.area, rtol=1e-3)
        np.testing.assert_allclose(fast.sigma_px, slow.sigma_px, atol=1e-3)
        np.testing.assert_allclose(fast.quality, slow.quality, atol=1e-3)
        rows += int(np.isfinite(fast.area).sum())
    assert rows > 30


def assert_same_blobs(expected: list[list[Blob]], found: list[list[Blob]]) -> None:
    assert [len(options) for options in found] == [len(options) for options in expected]
    for ours, theirs in zip(found, expected, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            assert a[2:] == b[2:]
            assert a[:2] == pytest.approx(b[:2], abs=1e-9)


@needs_numba
@pytest.mark.parametrize("count", [6, 9, 24, 63])
def test_noise_of_all_colours_has_the_same_blobs_in_tables_of_every_width(numba: Engine, count: int) -> None:
    ranges = [HsvRange(hsv_low=(2 * m, 60, 40), hsv_high=(2 * m + 9, 255, 255)) for m in range(count)]
    table = ColourTable(ranges)
    rng = np.random.default_rng(count)
    for size in ((90, 101, 3), (64, 64, 3)):
        image = rng.integers(0, 256, size, dtype=np.uint8)
        codes, found = numba.scan_blobs(image, table, table.bits, 2, 1, 1, None)
        np.testing.assert_array_equal(codes, table.scan(image, 2, 1, 1))
        assert_same_blobs(find_blobs(codes, table.bits, 2, 1, 1), found)
        blobs = [Blob(30.0, 30.0, 100.0, 20, 20, 41, 41)]
        for m in (0, count - 1):
            ours = numba.measure(image, table, [table.bits[m]], blobs, [True])
            theirs = centroid.measure(image, table, [table.bits[m]], blobs, [True])
            assert (ours[0] is None) == (theirs[0] is None)


@needs_numba
@pytest.mark.parametrize("gains", [(1.4, 1.0, 0.7), (0.6, 1.2, 1.0)])
def test_under_another_light_both_engines_look_up_the_same_colours(
    numba: Engine, gains: tuple[float, float, float]
) -> None:
    image = np.asarray(cv2.LUT(render(hand()), gain_tables(gains).T[None]), np.uint8)
    table = TABLE.white_balanced(gain_tables(1.0 / np.array(gains)))
    codes, options = numba.scan_blobs(image, table, table.bits, 4, 0, 0, None)
    np.testing.assert_array_equal(codes, table.scan(image, 4))
    assert_same_blobs(find_blobs(codes, table.bits, 4), options)
    call = [b[0] for b in options if b], [bit for bit, b in zip(table.bits, options, strict=True) if b]
    assert len(call[0]) == len(table.bits)
    ours = numba.measure(image, table, call[1], call[0], [True] * len(call[0]))
    theirs = centroid.measure(image, table, call[1], call[0], [True] * len(call[0]))
    for a, b in zip(ours, theirs, strict=True):
        assert a is not None
        assert b is not None
        assert (a.u, a.v, a.area) == pytest.approx((b.u, b.v, b.area), abs=1e-3)


@needs_numba
def test_an_image_that_must_not_be_written_is_no_new_kind_to_compile(numba: Engine) -> None:
    from slave.markers.fast import _scan_blobs
    from slave.markers.fast_window import measure_windows

    numba.prepare(TABLE)
    kernels = (_scan_blobs, measure_windows)
    before = [len(kernel.signatures) for kernel in kernels]  # pyright: ignore[reportFunctionMemberAccess]
    image = render(hand())
    image.flags.writeable = False
    for picture in (image, image[:, ::-1], image[20:]):
        _, options = numba.scan_blobs(picture, TABLE, TABLE.bits, 4, 0, 0, None)
        found = numba.measure(picture, TABLE, TABLE.bits, [b[0] for b in options], [True] * len(options))
        assert all(one is not None for one in found)
    after = [len(kernel.signatures) for kernel in kernels]  # pyright: ignore[reportFunctionMemberAccess]
    assert after == before


@needs_numba
def test_nothing_gives_nothing(numba: Engine) -> None:
    image = render([], 120, 100)
    assert numba.scan_blobs(image, TABLE, (1, 2), 4, 0, 0, None)[1] == [[], []]
    assert numba.measure(image, TABLE, [], [], []) == []
    assert numba.measure(image, TABLE, [1], [Blob(60.0, 50.0, 40.0, 56, 46, 64, 54)], [True]) == [None]
    beyond = [Blob(400.0, 50.0, 40.0, 396, 46, 404, 54), Blob(60.0, -50.0, 40.0, 56, -54, 64, -46)]
    assert numba.measure(image, TABLE, [1, 1], beyond, [False, True]) == [None, None]


def test_an_engine_is_chosen_by_name_and_no_other_takes_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    assert engine_named("numpy") is NUMPY
    with pytest.raises(ValueError, match="numpy, numba"):
        engine_named("fortran")
    for name in [n for n in sys.modules if n.startswith("slave.markers.fast")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "numba", None)  # as if it were not installed
    with pytest.raises(PhalanxError, match=r"pip install 'phalanx-hand\[fast\]'"):
        engine_named("numba")
