"""Whatever a driver raises, or a camera repeats: the slave's loop goes on, and measures nothing twice."""

import logging
import threading
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration
from common.clock import SystemClock
from common.errors import CameraError
from common.messages import MarkerDetections, Message
from slave import sources
from slave.cameras.grey import Pixels
from slave.cameras.picamera2 import Picamera2Camera
from slave.cameras.picamera2_settings import Picamera2Options
from slave.cameras.v4l2 import V4l2Camera, V4l2Options
from slave.markers.detector import Detections
from slave.reconnect import CONTRAST, ReconnectingCamera, RepeatedPictures
from slave.report import DetectionCounters
from slave.sender import MarkerPipeline, WristPipeline, run
from slave.sources import LOG_EVERY_NS, Failures, Frame, FrameSource
from tests.slave.fake_picamera2 import Sensor, install
from tests.slave.fake_v4l2 import Camera, FakeDevice
from tests.slave.recorded_lists import OV7251
from tests.slave.stand_ins import camera_file

FILE = camera_file()
MONO = replace(FILE, colour_gains=(1.0, 1.0))
CODES = {"gain": 32, "white_balance_temperature": 4600}
GREY = {"GREY": {(640, 480): (30.0,)}}
CLOCK = SystemClock()


class Wire:
    """Stands for the uplink. Ends the loop after so many messages."""

    session = 77

    def __init__(self, stop: threading.Event, most: int) -> None:
        self.sent: list[Message] = []
        self._stop, self._most = stop, most

    def send(self, message: Message) -> None:
        self.sent.append(message)
        if len(self.sent) >= self._most:
            self._stop.set()


def usb(camera: Camera, file: CameraCalibration, pixels: Pixels = Pixels.GREY) -> V4l2Camera:
    return V4l2Camera(
        file, V4l2Options(controls=CODES, pixels=pixels), CLOCK, lambda _path: FakeDevice(camera)
    )


def camera_of(
    opener: Callable[[CameraCalibration], FrameSource], stop: threading.Event
) -> ReconnectingCamera:
    """A camera that is lost after 30 ms of one picture, and for which nothing is waited for long."""
    return ReconnectingCamera(opener, FILE, CLOCK, stop, first_s=0.001, frozen_s=0.03)


def tracked(
    opener: Callable[[CameraCalibration], FrameSource], most: int
) -> tuple[ReconnectingCamera, list[Frame]]:
    """Run the slave's loop with a camera until it has sent so many frames: the camera, and what was sent of."""
    stop = threading.Event()
    source = camera_of(opener, stop)
    wire, shown = Wire(stop, most), list[Frame]()
    run(
        source,
        MarkerPipeline(
            "left",
            wire.session,
            wire.send,
            lambda _image, _t_ns: Detections.none(6),
            DetectionCounters(("a",) * 6),
            shown.append,
        ),
        stop,
    )
    source.close()
    seqs = [one.seq for one in wire.sent if isinstance(one, MarkerDetections)]
    assert len(seqs) == len(shown) == most
    assert seqs == sorted(set(seqs))
    return source, shown


def equal_neighbours(frames: list[Frame]) -> int:
    return sum(np.array_equal(a.image, b.image) for a, b in pairwise(frames))


def test_a_usb_driver_that_raises_something_of_its_own_costs_no_process(
    caplog: pytest.LogCaptureFixture,
) -> None:
    plugged = [Camera(formats=GREY, fails_at=frozenset({20})), Camera(formats=GREY)]
    source, _ = tracked(lambda file: usb(plugged.pop(0), file), 30)
    assert (source.counts()["camera.lost"], source.counts()["camera.raised"]) == (1, 1)
    lost = [
        record for record in caplog.records if "ZeroDivisionError: a fault in the driver" in record.message
    ]
    assert len(lost) == 1
    assert lost[0].exc_info, "the cause with its traceback"
    assert "back after loss number 1" in caplog.text


def test_a_pi_library_that_raises_something_of_its_own_costs_no_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = install(monkeypatch, Sensor(modes=OV7251, monochrome=True, breaks_at=frozenset({40})))
    options = Picamera2Options(pixels=Pixels.GREY)

    def opener(_file: CameraCalibration) -> Picamera2Camera:
        camera = Picamera2Camera(MONO, options, CLOCK)
        sensor.breaks_at = frozenset() if len(sensor.opened) > 1 else sensor.breaks_at
        return camera

    source, _ = tracked(opener, 60)
    assert (source.counts()["camera.lost"], source.counts()["camera.raised"]) == (1, 1)
    assert len(sensor.opened) == 2


def test_a_driver_that_cannot_change_its_settings_is_asked_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_arguments: object) -> None:
        raise KeyError("tune")

    monkeypatch.setattr(V4l2Camera, "tune", fail)
    source = camera_of(lambda file: usb(Camera(formats=GREY), file), threading.Event())
    with pytest.raises(CameraError, match="its settings cannot be changed: KeyError"):
        source.tune(FILE)
    assert source.metrics().keys() >= {"exposure_us"}
    assert source.counts()["camera.raised"] == 1
    source.close()


def test_a_frozen_usb_camera_is_not_measured_and_is_opened_again(caplog: pytest.LogCaptureFixture) -> None:
    plugged = [Camera(formats=GREY, frozen_after=20), Camera(formats=GREY)]
    source, frames = tracked(lambda file: usb(plugged.pop(0), file), 40)
    assert equal_neighbours(frames) == 0
    assert source.counts()["camera.lost"] == 1
    assert source.counts()["camera.frozen"] > 1
    assert source.counts()["camera.raised"] == 0
    assert "repeated one picture" in caplog.text


def test_a_frozen_pi_camera_is_not_measured_and_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = install(monkeypatch, Sensor(modes=OV7251, monochrome=True, frozen_after=40))

    def opener(_file: CameraCalibration) -> Picamera2Camera:
        sensor.frozen_after = 40 if not sensor.opened else None
        return Picamera2Camera(MONO, Picamera2Options(pixels=Pixels.GREY), CLOCK)

    source, frames = tracked(opener, 60)
    assert equal_neighbours(frames) == 0
    assert source.counts()["camera.lost"] == 1
    assert source.counts()["camera.frozen"] > 1


def test_a_camera_that_stays_frozen_is_never_measured_again() -> None:
    """As that of a wrist device: the picture is the same however often it is opened."""
    stop, opened = threading.Event(), list[Camera]()

    def opener(file: CameraCalibration) -> V4l2Camera:
        opened.append(Camera(formats=GREY, frozen_after=0))
        if len(opened) == 4:
            stop.set()
        return usb(opened[-1], file)

    source = camera_of(opener, stop)
    counters = DetectionCounters(())
    run(
        source,
        WristPipeline(
            "left",
            77,
            Wire(stop, 1).send,
            lambda _frame: None,
            counters,
            lambda _frame: stop.set(),
        ),
        stop,
    )
    source.close()
    assert counters.counts()["frames"] == 1, "its first picture, and no other"
    assert source.counts()["camera.lost"] >= 3


def test_a_camera_that_sends_each_picture_twice_keeps_half_of_its_frames() -> None:
    class Twice(FakeDevice):
        def _expose(self) -> None:
            self.camera.frozen_after = self.frame // 2 * 2 if self.frame > 20 else None
            super()._expose()

    camera = Camera(formats=GREY)
    options = V4l2Options(controls=CODES, pixels=Pixels.GREY)
    source, frames = tracked(lambda file: V4l2Camera(file, options, CLOCK, lambda _path: Twice(camera)), 40)
    assert equal_neighbours(frames) == 0
    assert source.counts()["camera.lost"] == 0
    assert {b.seq - a.seq for a, b in pairwise(frames[20:])} == {2}, "the copies count as dropped"


def test_only_a_picture_with_contrast_that_is_equal_in_every_byte_is_a_repeated_one() -> None:
    rng = np.random.default_rng(1)
    for shape in ((48, 64, 3), (48, 64), (3, 5, 3)):
        image: Image = rng.integers(0, 255, shape, np.uint8)
        for at in (0, image.size // 2, image.size - 1):
            other = image.copy()
            other.reshape(-1)[at] ^= 1
            pictures = RepeatedPictures()
            given = (image, image.copy(), image, other, image, image[:-1])
            assert [pictures.push(one) for one in given] == [False, True, True, False, False, False]
    flat = np.full((48, 64, 3), (10, 90, 200), np.uint8)
    flat[20:30] += CONTRAST
    pictures = RepeatedPictures()
    assert not any(pictures.push(flat.copy()) for _ in range(5)), "behind a cap, or fully exposed"
    flat[20, 20] += 2
    assert [pictures.push(flat.copy()) for _ in range(3)] == [False, True, True]


@pytest.mark.parametrize("buffers", [2, 4, 8])
def test_a_driver_that_hands_the_same_buffers_round_is_found_in_the_third_turn(buffers: int) -> None:
    rng = np.random.default_rng(2)
    ring: list[Image] = [rng.integers(0, 255, (48, 64, 3), np.uint8) for _ in range(buffers)]
    pictures = RepeatedPictures()
    found = [pictures.push(image.copy()) for _ in range(4) for image in ring]
    assert found == [False] * (2 * buffers) + [True] * (2 * buffers)


class Failing:
    """A detector that raises in some frames."""

    def __init__(self, fails: frozenset[int]) -> None:
        self._count, self._fails = 0, fails

    def push(self, image: Image, t_ns: int) -> Detections:
        self._count += 1
        if self._count in self._fails:
            raise IndexError("a fault in the detector")
        return Detections.none(1)


def test_a_frame_that_the_detector_fails_of_is_dropped_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    stop, alive = threading.Event(), list[int]()
    source = usb(Camera(formats=GREY), FILE)
    wire, counters = Wire(stop, 20), DetectionCounters(("a",))
    run(
        source,
        MarkerPipeline("left", wire.session, wire.send, Failing(frozenset({3, 4, 9})).push, counters),
        stop,
        lambda: alive.append(1),
    )
    source.close()
    counts = counters.counts()
    assert (counts["frames"], counts["failed"], counts["dropped"]) == (20, 3, 3)
    assert len(wire.sent) == len(alive) == 20, "what fails does not feed the watchdog"
    assert caplog.text.count("nothing is made of frame") == 1, "one line, however many frames"


def test_what_shows_or_finds_tags_costs_no_detection() -> None:
    def fail(_frame: Frame) -> None:
        raise ValueError("a fault in what shows")

    stop = threading.Event()
    source = usb(Camera(formats=GREY), FILE)
    wire, counters = Wire(stop, 10), DetectionCounters(("a",))
    run(
        source,
        MarkerPipeline(
            "left", wire.session, wire.send, lambda _image, _t_ns: Detections.none(1), counters, fail
        ),
        stop,
    )
    source.close()
    counts = counters.counts()
    assert (counts["frames"], counts["failed"], len(wire.sent)) == (10, 10, 10)


def test_failures_are_logged_once_in_ten_seconds_with_how_many_were_left_out(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING, logger=sources.__name__)
    now = [0]
    log = Failures("camera", lambda: now[0])
    for _ in range(100):
        assert log.log("lost", CameraError("no frame")) == "no frame"
        log.over("back")
    now[0] = LOG_EVERY_NS
    log.log("lost", KeyError("x"))
    log.over("back")
    assert [record.message for record in caplog.records] == [
        "camera: lost: no frame",
        "camera: back",
        "camera: lost: KeyError: 'x' (99 more since the last such line)",
        "camera: back",
    ]
    assert log.raised == 1
