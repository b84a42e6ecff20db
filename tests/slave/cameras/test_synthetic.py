"""The synthetic camera keeps time like a real one: on its own clock, never late by its drawing, never in a backlog."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.clock import Clock, SkewedClock
from common.errors import CalibrationError, CameraError
from common.geometry.srgb import to_linear
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.cameras.synthetic import SyntheticCamera

pytestmark = pytest.mark.usefixtures("drawn_once")
ROOT = Path(__file__).resolve().parents[3]
RIG = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
CAMERAS = {name: load(ROOT / f"calib_json/cameras/{name}.json", CameraCalibration) for name in RIG.cameras}
SCENE = Scene.standard(RIG, CAMERAS, load(ROOT / "calib_json/hands/default-right.json", HandProfile))
PERIOD_NS = 1e9 / 60.0
READOUT_NS = 2_500_000 + 480 * 20_600  # half the exposure, then all rows
EPOCH_NS = 7_000_000_000_000


class StageClock(Clock):
    """A true clock that moves only when somebody sleeps or the test says so."""

    def __init__(self, t_ns: int) -> None:
        self.t_ns = t_ns
        self.slept: list[float] = []

    def now_ns(self) -> int:
        return self.t_ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.t_ns += max(round(seconds * 1e9), 1)


def camera(clock: StageClock, name: str = "left", ppm: float = 0.0, late_ns: int = 0) -> SyntheticCamera:
    own = SkewedClock(3_000_000_000, ppm, clock)
    return SyntheticCamera(SCENE, name, EPOCH_NS, own, late_ns, clock, clock.sleep)


def test_frames_come_one_per_period_at_the_end_of_the_readout() -> None:
    clock = StageClock(EPOCH_NS - 100_000_000)
    source = camera(clock)
    for k in range(4):
        frame = source.read()
        assert frame is not None
        assert frame.seq == k
        true_ns = frame.t_ns - 3_000_000_000
        assert abs(true_ns - EPOCH_NS - k * PERIOD_NS) < 3
        assert 0 <= frame.ready_t_ns - frame.t_ns - READOUT_NS < 1_000
        assert clock.now_ns() == frame.ready_t_ns - 3_000_000_000
    assert source.skipped == 0


def test_image_is_the_scene_at_the_true_time_of_the_frame() -> None:
    clock = StageClock(EPOCH_NS + 20_000_000_000)
    frame = camera(clock, "right", late_ns=5_000_000).read()
    assert frame is not None
    t_s = (frame.t_ns - 3_000_000_000 - EPOCH_NS) * 1e-9
    assert (t_s - 0.005) * 60.0 == pytest.approx(frame.seq, abs=1e-4)
    np.testing.assert_array_equal(frame.image, Renderer(SCENE, "right").render(t_s))


def test_joins_at_any_time_with_the_number_of_that_moment() -> None:
    clock = StageClock(EPOCH_NS + 10_000_000_000)
    source = camera(clock)
    frame = source.read()
    assert frame is not None
    assert frame.seq in (600, 601)
    assert source.skipped == 0  # frames before it joined were never its own
    assert clock.now_ns() - EPOCH_NS - 10_000_000_000 < PERIOD_NS + 1


def test_rate_is_that_of_its_own_clock() -> None:
    clock = StageClock(EPOCH_NS)
    source = camera(clock, ppm=1000.0)
    first = source.read()
    clock.t_ns += 10_000_000_000
    second = source.read()
    assert first is not None
    assert second is not None
    count = second.seq - first.seq
    assert abs((second.t_ns - first.t_ns) - count * PERIOD_NS) < 3  # its own clock sees its nominal rate
    own = SkewedClock(0, 1000.0, StageClock(0))
    assert own.to_true(10**9) < 10**9


def test_a_slow_process_loses_frames_and_builds_no_backlog() -> None:
    clock = StageClock(EPOCH_NS - 1)
    source = camera(clock)
    assert source.read() is not None
    clock.t_ns += round(5.2 * PERIOD_NS)  # the caller was busy
    frame = source.read()
    assert frame is not None
    assert source.skipped == frame.seq - 1 >= 4
    assert frame.ready_t_ns - frame.t_ns - READOUT_NS < 1_000  # and is on time again
    after = source.read()
    assert after is not None
    assert after.seq == frame.seq + 1


def test_a_little_lateness_costs_no_frame() -> None:
    clock = StageClock(EPOCH_NS - 1)
    source = camera(clock)
    seen = []
    for _ in range(5):
        frame = source.read()
        assert frame is not None
        seen.append(frame.seq)
        clock.t_ns += round(1.3 * PERIOD_NS) if frame.seq == 1 else 0
    assert seen == [0, 1, 2, 3, 4]
    assert source.skipped == 0


def test_waits_in_short_steps_so_that_a_signal_ends_it() -> None:
    clock = StageClock(EPOCH_NS - 1_000_000_000)
    assert camera(clock).read() is not None
    assert max(clock.slept) <= 0.05


def test_closed_camera_ends_the_stream_and_unknown_one_is_refused() -> None:
    clock = StageClock(EPOCH_NS)
    source = camera(clock)
    source.close()
    source.close()
    assert source.read() is None
    with pytest.raises(CalibrationError, match="third"):
        camera(clock, "third")


def retuned(**changes: object) -> tuple[np.ndarray, np.ndarray]:
    """The same moment before and after a change of settings, as linear light (H, W, 3)."""
    clock = StageClock(EPOCH_NS + 20_000_000_000)
    source = camera(clock)
    before = source.read()
    source.tune(msgspec.structs.replace(CAMERAS["left"], **changes))
    clock.t_ns -= 30_000_000
    source._next -= 1  # the same frame once more
    after = source.read()
    assert before is not None
    assert after is not None
    assert before.t_ns == after.t_ns
    return to_linear(before.image / 255.0), to_linear(after.image / 255.0)


@pytest.mark.parametrize(
    ("changes", "factor_bgr"),
    [
        ({"exposure_us": 2500.0}, (0.5, 0.5, 0.5)),
        ({"analogue_gain": 2.5}, (2.0, 2.0, 2.0)),
        ({"exposure_us": 10_000.0, "analogue_gain": 0.625}, (1.0, 1.0, 1.0)),
        ({"colour_gains": (0.83 * 1.5, 1.24 * 0.6)}, (0.6, 1.0, 1.5)),
    ],
)
def test_exposure_and_gains_make_the_picture_brighter_or_darker(
    changes: dict[str, object], factor_bgr: tuple[float, float, float]
) -> None:
    before, after = retuned(**changes)
    middle = (before.min(axis=2) > 0.05) & (before.max(axis=2) < 0.35)
    ratio = after[middle].sum(axis=0) / before[middle].sum(axis=0)
    np.testing.assert_allclose(ratio, factor_bgr, rtol=0.05)


def test_a_longer_exposure_smears_what_moves() -> None:
    still = CAMERAS["left"]
    moving = Renderer(SCENE, "left")
    long = moving.exposed(15_000.0, np.ones(3))
    fastest = max(np.arange(0.0, 30.0, 0.5).tolist(), key=lambda t_s: _speed(moving, t_s))
    assert _speed(moving, fastest) * 0.010 > 4.0  # px: what 10 ms more must smear
    assert _sharpness(long, fastest) < 0.9 * _sharpness(moving, fastest)
    assert still.exposure_us == 5000.0
    np.testing.assert_array_equal(
        moving.exposed(still.exposure_us, np.ones(3)).render(fastest), moving.render(fastest)
    )


def _speed(renderer: Renderer, t_s: float) -> float:
    """Speed of the hand in the picture [px/s]."""
    now, later = (renderer.markers(t).uv for t in (t_s, t_s + 0.005))
    return float(np.nanmedian(np.linalg.norm(later - now, axis=1))) / 0.005


def _sharpness(renderer: Renderer, t_s: float) -> float:
    """Mean step between neighbours, where the hand is."""
    image = renderer.render(t_s).astype(float)
    uv = renderer.markers(t_s).uv
    u0, v0 = np.nanmin(uv, axis=0).astype(int) - 10
    u1, v1 = np.nanmax(uv, axis=0).astype(int) + 10
    part = image[max(v0, 0) : v1, max(u0, 0) : u1]
    return float(np.abs(np.diff(part, axis=1)).mean() + np.abs(np.diff(part, axis=0)).mean())


def test_it_says_what_it_has_and_refuses_what_does_not_fit_into_a_frame() -> None:
    source = camera(StageClock(EPOCH_NS))
    with pytest.raises(CameraError, match="exposure_us: wanted 17000, a frame at 60 Hz has 16666"):
        source.tune(msgspec.structs.replace(CAMERAS["left"], exposure_us=17_000.0))
    assert source.metrics()["exposure_us"] == 5000.0
    source.tune(msgspec.structs.replace(CAMERAS["left"], exposure_us=7000.0, colour_gains=(0.9, 1.1)))
    got = source.metrics()
    assert (got["exposure_us"], got["red_gain"], got["blue_gain"], got["frame_rate_hz"]) == (
        7000,
        0.9,
        1.1,
        60,
    )
    assert source.counts() == {"camera.skipped": 0}


def test_frames_are_handed_over_when_the_longer_exposure_is_over() -> None:
    clock = StageClock(EPOCH_NS)
    source = camera(clock)
    source.tune(msgspec.structs.replace(CAMERAS["left"], exposure_us=9000.0))
    frame = source.read()
    assert frame is not None
    assert 0 <= frame.ready_t_ns - frame.t_ns - READOUT_NS - 2_000_000 < 1_000


def test_another_rate_holds_from_the_next_frame_on() -> None:
    clock = StageClock(EPOCH_NS)
    source = camera(clock)
    times = [frame.t_ns for _ in range(3) if (frame := source.read()) is not None]
    source.tune(msgspec.structs.replace(CAMERAS["left"], frame_rate_hz=30.0))
    frames = [frame for _ in range(3) if (frame := source.read()) is not None]
    assert [frame.seq for frame in frames] == [3, 4, 5], "none is counted as lost"
    times += [frame.t_ns for frame in frames]
    np.testing.assert_allclose(np.diff(times) * 1e-9, [1 / 60, 1 / 60, 1 / 60, 1 / 30, 1 / 30], atol=1e-8)
    assert source.metrics()["frame_rate_hz"] == 30.0
    with pytest.raises(
        CameraError, match="frame_rate_hz: wanted 120, the rows of a frame are read out in 9888 us"
    ):
        source.tune(msgspec.structs.replace(CAMERAS["left"], frame_rate_hz=120.0))
