import logging
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from common.calibration import CameraCalibration
from common.errors import CameraError
from slave import failures
from slave.cameras.reconnecting import LONGEST_WAIT_S, ReconnectingCamera
from slave.failures import LOG_EVERY_NS
from slave.sources import Frame

CALIBRATION = CameraCalibration(
    version=1,
    name="left",
    width_px=16,
    height_px=16,
    frame_rate_hz=50.0,
    exposure_us=5000.0,
    analogue_gain=1.25,
    colour_gains=(0.83, 1.24),
    row_time_us=30.0,
)
PERIOD_NS = 20_000_000
IMAGE = np.zeros((2, 2, 3), np.uint8)


class Dispatcher:
    """Time, a socket and the camera that is or is not in it."""

    def __init__(self) -> None:
        self.t_ns = 0
        self.plugged = True
        self.back_at_ns: int | None = None
        self.opened = self.closed = 0
        self.stop = threading.Event()
        self.waits: list[float] = []
        self.lives: list[int] = []  # frames until each camera is lost; empty: for ever

    def now_ns(self) -> int:
        return self.t_ns

    def wait(self, seconds: float) -> bool:
        self.waits.append(seconds)
        self.t_ns += round(seconds * 1e9)
        if self.back_at_ns is not None and self.t_ns >= self.back_at_ns:
            self.plugged = True
        return self.stop.is_set()

    def open(self, _camera: CameraCalibration) -> "Camera":
        if not self.plugged:
            raise CameraError("no such device")
        self.opened += 1
        return Camera(self, self.lives.pop(0) if self.lives else 10**6)


class Camera:
    def __init__(self, world: Dispatcher, life: int) -> None:
        self._dispatcher, self._life, self._seq = world, life, 0

    def read(self) -> Frame | None:
        if self._seq == self._life:
            raise CameraError("unplugged")
        self._dispatcher.t_ns += PERIOD_NS
        self._seq += 1
        return Frame(self._seq - 1, self._dispatcher.t_ns, self._dispatcher.t_ns, IMAGE)

    def close(self) -> None:
        self._dispatcher.closed += 1


class Stop(threading.Event):
    """The slave's stop event, on the world's time."""

    def __init__(self, world: Dispatcher) -> None:
        super().__init__()
        self._dispatcher = world

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        return self._dispatcher.wait(timeout)


def reconnecting_camera(world: Dispatcher) -> ReconnectingCamera:
    return ReconnectingCamera(world.open, CALIBRATION, world, Stop(world))


def frames(camera: ReconnectingCamera) -> Iterator[Frame]:
    while (frame := camera.read()) is not None:
        yield frame


def test_a_camera_that_stays_is_passed_through() -> None:
    world = Dispatcher()
    source = frames(reconnecting_camera(world))
    assert [next(source).seq for _ in range(5)] == [0, 1, 2, 3, 4]
    assert (world.opened, world.closed) == (1, 0)


def test_an_error_at_the_start_is_an_error() -> None:
    world = Dispatcher()
    world.plugged = False
    with pytest.raises(CameraError, match="no such device"):
        reconnecting_camera(world)


def test_numbers_go_on_after_a_loss_and_the_gap_is_the_absence(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    world = Dispatcher()
    world.lives = [4, 10**6]
    camera = reconnecting_camera(world)
    source = frames(camera)
    before = [next(source) for _ in range(4)]
    world.plugged, world.back_at_ns = False, world.t_ns + 5_000_000_000
    after = [next(source) for _ in range(3)]
    gap = (after[0].t_ns - before[-1].t_ns) // PERIOD_NS
    assert gap > 250
    assert [frame.seq for frame in after] == [3 + gap, 4 + gap, 5 + gap]
    assert camera.lost == 1
    assert (world.opened, world.closed) == (2, 1), "the lost one was given back"
    assert "back after loss number 1" in caplog.text


def test_waits_grow_to_one_second_and_begin_anew_with_a_frame() -> None:
    world = Dispatcher()
    world.lives = [1, 1, 10**6]
    source = frames(reconnecting_camera(world))
    next(source)
    world.plugged, world.back_at_ns = False, 20_000_000_000
    next(source)
    assert world.waits[:5] == [0.2, 0.4, 0.8, 1.0, 1.0]
    assert max(world.waits) == LONGEST_WAIT_S
    world.waits.clear()
    next(source)
    assert world.waits == [0.2]


def test_a_camera_that_opens_but_never_delivers_is_not_opened_in_a_hurry() -> None:
    world = Dispatcher()
    world.lives = [1] + [0] * 6 + [10**6]
    source = frames(reconnecting_camera(world))
    next(source)
    next(source)
    assert world.waits == [0.2, 0.4, 0.8, 1.0, 1.0, 1.0, 1.0]


def test_a_stop_and_a_close_end_the_wait() -> None:
    for end in ("stop", "close"):
        world = Dispatcher()
        world.lives = [1]
        stop = Stop(world)
        camera = ReconnectingCamera(world.open, CALIBRATION, world, stop)
        world.stop = stop
        assert camera.read() is not None
        world.plugged = False
        stop.set() if end == "stop" else camera.close()
        assert camera.read() is None


def test_a_long_absence_is_logged_now_and_then(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, logger=failures.__name__)
    world = Dispatcher()
    world.lives = [1]
    source = frames(reconnecting_camera(world))
    next(source)
    away_ns = 10 * LOG_EVERY_NS
    world.plugged, world.back_at_ns = False, world.t_ns + away_ns
    next(source)
    assert 5 <= len(caplog.records) <= 13
    assert len(world.waits) > 40


def test_a_camera_that_cannot_be_given_back_is_no_end(caplog: pytest.LogCaptureFixture) -> None:
    world = Dispatcher()
    world.lives = [1]
    camera = reconnecting_camera(world)

    def stuck(_self: Camera) -> None:
        raise CameraError("does not let go")

    assert camera.read() is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Camera, "close", stuck)
        frame = camera.read()
    assert frame is not None
    assert frame.seq > 0


def test_real_waiting_ends_when_the_slave_is_stopped() -> None:
    world = Dispatcher()
    world.lives = [1]
    stop = threading.Event()
    camera = ReconnectingCamera(world.open, CALIBRATION, world, stop)
    assert camera.read() is not None
    world.plugged = False
    threading.Timer(0.05, stop.set).start()
    assert camera.read() is None
