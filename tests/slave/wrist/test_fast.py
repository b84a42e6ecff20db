"""The inner loops as machine code against those of numpy: the same seams, the same lines, the same points."""

import sys
from functools import cache

import numpy as np
import pytest

from common.arrays import Image
from common.errors import PhalanxError
from slave.wrist.detector import WristDetector
from slave.wrist.engine import NUMPY, Engine, engine_named
from slave.wrist.fingertips import fingertips
from slave.wrist.laser import laser_lines, separate
from slave.wrist.seams import FENCE
from slave.wrist.strobe import lit
from tests.slave.wrist.wrist_frames import VIEW, strobed

pytest.importorskip("numba", reason="numba is not installed: the extra `fast`")


@pytest.fixture(scope="module")
def fast() -> Engine:
    return engine_named("numba")


def random_energy(rng: np.random.Generator, stations: int, widths: tuple[int, ...]) -> np.ndarray:
    parts = [rng.uniform(0.0, 20.0, (stations, width)).astype(np.float32) for width in widths]
    for part in parts:
        part[:, :2] = part[:, -2:] = FENCE
    return np.concatenate(parts, axis=1)


def cost(energy: np.ndarray, path: np.ndarray) -> float:
    turns = 0.02 * np.abs(np.diff(path)).sum()
    return float(energy[np.arange(len(energy)), path].sum() + turns)


@pytest.mark.parametrize("stations", [1, 2, 7, 40])
def test_paths_cost_as_little(fast: Engine, stations: int) -> None:
    rng = np.random.default_rng(stations)
    widths = (9, 30, 17)
    energy = random_energy(rng, stations, widths)
    begin = np.concatenate([[0], np.cumsum(widths)])
    pairs = zip(
        fast.minimum_cost_paths(energy, widths), NUMPY.minimum_cost_paths(energy, widths), strict=True
    )
    for band, (found, expected) in enumerate(pairs):
        part = energy[:, begin[band] : begin[band + 1]]
        assert cost(part, found) == pytest.approx(cost(part, expected), rel=1e-5)
        assert np.abs(np.diff(found)).max(initial=0) <= 2


def test_energy_is_the_same(fast: Engine) -> None:
    rng = np.random.default_rng(4)
    straightened = rng.integers(0, 256, (40, len(fast.energy(np.zeros((1, 232), np.uint8), 0)[0]))).astype(
        np.uint8
    )
    straightened[rng.random(straightened.shape) < 0.5] = 0
    straightened[:, 100:180] = 0
    for crossed in (0, 7, 40):
        np.testing.assert_allclose(
            fast.energy(straightened, crossed), NUMPY.energy(straightened, crossed), rtol=1e-5, atol=1e-5
        )


@cache
def drawn(seed: int) -> Image:
    """Lines that meet, part and touch, spurs, glow and noise."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[0:480, 0:640].astype(np.float64)
    image = rng.normal(4.0, 2.0, (480, 640))
    for _ in range(12):
        middle, slope, bend = rng.uniform(240.0, 400.0), rng.uniform(-0.6, 0.6), rng.uniform(-0.01, 0.01)
        first, length = rng.uniform(0.0, 500.0), rng.uniform(2.0, 120.0)
        at = middle + slope * (columns - first) + bend * (columns - first) ** 2
        on = (columns >= first) & (columns < first + length)
        image += on * rng.uniform(30.0, 400.0) * np.exp(-(((rows - at) / rng.uniform(0.8, 9.0)) ** 2))
    return np.clip(image, 0.0, 255.0).astype(np.uint8)


@pytest.mark.parametrize("seed", range(3))
def test_runs_and_lines_are_the_same(fast: Engine, seed: int) -> None:
    image = drawn(seed)
    (found, on), (expected, on_expected) = fast.lines(image, 200), NUMPY.lines(image, 200)
    assert len(expected.row) > 100
    for name in ("column", "start", "end", "first", "joins"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    np.testing.assert_allclose(found.row, expected.row, atol=1e-3)
    np.testing.assert_array_equal(on, on_expected)


@pytest.mark.parametrize("seed", range(3))
def test_pieces_measure_the_same(fast: Engine, seed: int) -> None:
    runs, on = NUMPY.lines(drawn(seed), 200)
    rng = np.random.default_rng(seed)
    finger = np.where(on, runs.column // 128, -1)
    finger[rng.random(len(finger)) < 0.02] = -1
    found, expected = (engine.measure(runs, finger, 640) for engine in (fast, NUMPY))
    for name, value in expected._asdict().items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=1e-9, atol=1e-9, err_msg=name)
    assert np.isfinite(expected.uv).any()


@pytest.mark.parametrize("image", [np.zeros((480, 640), np.uint8), np.full((480, 640), 255, np.uint8)])
def test_without_a_line_there_are_no_runs(fast: Engine, image: Image) -> None:
    found, on = fast.lines(image, 200)
    assert len(found.row) == len(on) == 0


def test_a_hand_is_seen_alike(fast: Engine) -> None:
    frames = strobed("curl", 8)
    for k in range(0, 24, 6):
        ambient, laser, led = (frame.image for frame in frames[k : k + 3])
        seams = [separate(lit(led, ambient), VIEW, engine) for engine in (NUMPY, fast)]
        np.testing.assert_allclose(seams[1].seams, seams[0].seams, atol=1.5)
        here, there = (
            laser_lines(lit(laser, ambient), seam, VIEW, engine)
            for seam, engine in zip(seams, (NUMPY, fast), strict=True)
        )
        np.testing.assert_allclose(there.uv, here.uv, atol=0.2)
        np.testing.assert_allclose(there.length_px, here.length_px, atol=0.5)
        np.testing.assert_allclose(there.sigma_px, here.sigma_px, rtol=0.1)


@pytest.mark.parametrize("name", ["spread", "standard", "random"])
def test_fingertips_are_the_same(fast: Engine, name: str) -> None:
    frames = strobed(name, 8)
    count = 0
    for k in range(0, 24, 3):
        ambient, laser, led = (frame.image for frame in frames[k : k + 3])
        lit_led = lit(led, ambient)
        laser_uv = laser_lines(lit(laser, ambient), separate(lit_led, VIEW), VIEW).uv
        here, there = (fingertips(lit_led, led, laser_uv, VIEW, one.candidates) for one in (NUMPY, fast))
        for name in ("uv", "sigma_px", "depth"):
            np.testing.assert_allclose(getattr(there, name), getattr(here, name), atol=0.05, err_msg=name)
        count += int(np.isfinite(here.depth).sum())
    assert count >= 12


def test_a_finger_without_a_laser_point_has_no_tip(fast: Engine) -> None:
    ambient, laser, led = (frame.image for frame in strobed("poses", 1))
    lit_led = lit(led, ambient)
    laser_uv = laser_lines(lit(laser, ambient), separate(lit_led, VIEW), VIEW).uv
    laser_uv[2] = np.nan
    for engine in (NUMPY, fast):
        found = fingertips(lit_led, led, laser_uv, VIEW, engine.candidates)
        assert np.isnan(found.uv[2]).all()
        assert np.isfinite(found.uv[1]).all()
        nothing = fingertips(lit_led, led, np.full((5, 2), np.nan), VIEW, engine.candidates)
        assert np.isnan(nothing.uv).all()


def test_a_first_hand_finds_everything_compiled(fast: Engine) -> None:
    from slave.wrist import fast as compiled
    from slave.wrist import fast_tips

    functions = (
        compiled._minimum_cost_paths,
        compiled._energy,
        compiled._scan,
        compiled._link,
        compiled._measure,
    )
    functions += (fast_tips._search,)
    before = [len(one.signatures) for one in functions]  # pyright: ignore[reportFunctionMemberAccess]
    assert all(before)
    detector = WristDetector(VIEW, 90.0, engine=fast)
    assert sum(detector.push(frame) is not None for frame in strobed("curl", 8)) == 8
    after = [len(one.signatures) for one in functions]  # pyright: ignore[reportFunctionMemberAccess]
    assert after == before


def test_engines_are_chosen_by_name_and_numba_must_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    assert engine_named("numpy") is NUMPY
    with pytest.raises(ValueError, match="not one of numpy, numba"):
        engine_named("cuda")
    monkeypatch.delitem(sys.modules, "slave.wrist.fast", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(PhalanxError, match="--engine numba: numba cannot be used"):
        engine_named("numba")
