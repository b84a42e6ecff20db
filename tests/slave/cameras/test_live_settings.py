"""Exposure and gains of a camera that is being read: changed, read back, compared; what it refuses changes nothing."""

import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

import msgspec
import pytest

from common.calibration import CameraCalibration
from common.clock import SystemClock
from common.errors import CameraError
from slave.cameras import picamera2, v4l2_controls
from slave.cameras.picamera2 import Picamera2Camera
from slave.cameras.picamera2_settings import Picamera2Options
from slave.cameras.settings import FrameObserver
from slave.cameras.v4l2 import V4l2Camera, V4l2Options
from slave.reconnect import ReconnectingCamera
from slave.sources import FrameSource
from tests.network_helpers import until
from tests.slave.cameras.test_real_cameras import CALIBRATION as FILE
from tests.slave.fake_picamera2 import Sensor, install
from tests.slave.fake_v4l2 import Camera, FakeDevice

GIVEN = {"gain": 32, "white_balance_temperature": 4600}


def changed(**changes: Any) -> CameraCalibration:
    return msgspec.structs.replace(FILE, **changes)


@contextmanager
def reading(source: FrameSource) -> Generator[list[int], None, None]:
    """Read frames on another thread, as the slave's loop does; their times gather in the list."""
    stop, times = threading.Event(), list[int]()

    def loop() -> None:
        while not stop.is_set() and (frame := source.read()) is not None:
            times.append(frame.t_ns)
            time.sleep(0.001)

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield times
    finally:
        stop.set()
        thread.join()
        source.close()


def pi(monkeypatch: pytest.MonkeyPatch, sensor: Sensor) -> Picamera2Camera:
    install(monkeypatch, sensor)
    return Picamera2Camera(FILE, Picamera2Options(), SystemClock())


def usb(camera: Camera, file: CameraCalibration = FILE) -> V4l2Camera:
    return V4l2Camera(file, V4l2Options(controls=GIVEN), SystemClock(), lambda _path: FakeDevice(camera))


def test_a_pi_camera_takes_settings_while_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    source = pi(monkeypatch, Sensor(delay=7))
    with reading(source):
        source.tune(changed(exposure_us=9000.0, analogue_gain=2.0, colour_gains=(1.1, 1.6)))
        got = source.metrics()
    assert got["exposure_us"] == pytest.approx(9000.0, abs=33.6)
    assert got["analogue_gain"] == 2.0
    assert (got["red_gain"], got["blue_gain"]) == pytest.approx((1.1, 1.6), abs=1e-6)
    assert got["frame_rate_hz"] == pytest.approx(30.0, rel=2e-3)


def test_controls_that_picamera2_loses_are_written_again(monkeypatch: pytest.MonkeyPatch) -> None:
    source = pi(monkeypatch, Sensor(loses=2))
    with reading(source):
        source.tune(changed(exposure_us=9000.0))
        assert source.metrics()["exposure_us"] == pytest.approx(9000.0, abs=33.6)


def pinned(name: str, value: object, after: int) -> Callable[[int, dict[str, Any]], None]:
    """Metadata that say `value` where another than the first was asked for, from some frame on."""

    def tamper(number: int, metadata: dict[str, Any]) -> None:
        if number > after and metadata[name] > {"ExposureTime": 6000, "AnalogueGain": 1.5}[name]:
            metadata[name] = value

    return tamper


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("ExposureTime", 7777, "ExposureTime: wanted 9000 us .exposure_us., got 7777 us"),
        ("AnalogueGain", 1.75, "AnalogueGain: wanted 2 .analogue_gain., got 1.75"),
    ],
)
def test_what_a_pi_camera_does_not_take_is_named_and_the_old_settings_come_back(
    name: str, value: object, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = pi(monkeypatch, Sensor(tamper=pinned(name, value, 10)))
    with reading(source):
        with pytest.raises(CameraError, match=expected) as error:
            source.tune(changed(exposure_us=9000.0, analogue_gain=2.0))
        assert str(error.value).endswith("the settings before are back")
        got = source.metrics()
    assert got["exposure_us"] == pytest.approx(5000.0, abs=33.6)
    assert got["analogue_gain"] == 1.25


def test_settings_that_do_not_come_back_are_said_to_be_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    def stuck(number: int, metadata: dict[str, Any]) -> None:
        if number > 10:
            metadata["ExposureTime"] = 100

    source = pi(monkeypatch, Sensor(tamper=stuck))
    with reading(source), pytest.raises(CameraError, match="and the settings before did not come back"):
        source.tune(changed(exposure_us=9000.0))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"exposure_us": 40_000.0}, "does not fit into a frame of 33333 us"),
        ({"analogue_gain": 90.0}, "AnalogueGain 90 is not within 1 to 63.9375"),
        ({"colour_gains": (40.0, 1.0)}, "ColourGains 40, 1 is not within 0 to 32"),
    ],
)
def test_what_is_out_of_range_is_refused_before_anything_is_written(
    changes: dict[str, Any], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = Sensor()
    source = pi(monkeypatch, sensor)
    with reading(source), pytest.raises(CameraError, match=expected):
        source.tune(changed(**changes))
    written = {value for _, controls in sensor.opened[0]._changes for value in controls.values()}
    assert written <= {5000, 1.25, (0.83, 1.24), (33333, 33333)}, "what it had"


def test_a_usb_camera_takes_an_exposure_while_it_is_read() -> None:
    camera = Camera()
    source = usb(camera)
    with reading(source) as times:
        while len(times) < 5:
            time.sleep(0.001)
        source.tune(changed(exposure_us=9000.0))
        assert source.metrics()["exposure_us"] == 9000.0
        assert source.metrics()["control.gain"] == 32.0
        count = len(times)
        while len(times) < count + 5:
            time.sleep(0.001)
    period_ns = 1e9 / 30.0
    early, late = times[0] % period_ns, times[-1] % period_ns
    # The stamp is the start of the exposure: its middle comes 2 ms later now.
    assert (late - early + period_ns / 2) % period_ns - period_ns / 2 == pytest.approx(2e6, abs=1e5)


def test_what_a_usb_camera_does_not_take_is_named_and_the_old_exposure_comes_back() -> None:
    camera = Camera(
        keeps=lambda name, value: 77 if name.startswith("Exposure Time") and value > 50 else value
    )
    source = usb(camera)
    with reading(source):
        with pytest.raises(CameraError, match=r"wanted 90 x 100 us .exposure_us., got 77 x") as error:
            source.tune(changed(exposure_us=9000.0))
        assert str(error.value).endswith("the settings before are back")
    assert camera.knob("Exposure Time").value == 50


def test_a_pi_camera_takes_another_rate_within_its_mode_unless_it_runs_in_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = pi(monkeypatch, Sensor())
    with reading(source):
        source.tune(changed(frame_rate_hz=20.0))
        assert source.metrics()["frame_rate_hz"] == pytest.approx(20.0, rel=2e-3)
        with pytest.raises(CameraError, match=r"FrameDurationLimits 1000, 1000 is not within"):
            source.tune(changed(frame_rate_hz=1000.0, exposure_us=500.0))
        assert source.metrics()["frame_rate_hz"] == pytest.approx(20.0, rel=2e-3)
    install(monkeypatch, Sensor())
    led = Picamera2Camera(FILE, Picamera2Options(sync="server"), SystemClock())
    with (
        reading(led),
        pytest.raises(CameraError, match="30 cannot become 20 while it runs in step with others"),
    ):
        led.tune(changed(frame_rate_hz=20.0))


def test_a_usb_camera_takes_another_rate_where_its_driver_does() -> None:
    source = usb(Camera())
    with reading(source):
        source.tune(changed(frame_rate_hz=15.0))
        assert source.metrics()["frame_rate_hz"] == pytest.approx(15.0, rel=1e-2)
        with pytest.raises(CameraError, match="exposure_us 70000 does not fit into a frame of 66667 us"):
            source.tune(changed(frame_rate_hz=15.0, exposure_us=70_000.0))
    source = usb(Camera(keeps_rate=True))
    with reading(source):
        with pytest.raises(
            CameraError, match="while frames come: write it into the camera file, and restart"
        ):
            source.tune(changed(frame_rate_hz=15.0))
        source.tune(changed(exposure_us=9000.0))
        assert source.metrics()["frame_rate_hz"] == pytest.approx(30.0, rel=1e-2)


def test_a_usb_camera_takes_rate_and_exposure_together_in_the_order_that_it_can() -> None:
    camera = Camera()
    source = usb(camera)
    slow, fast = changed(frame_rate_hz=15.0, exposure_us=50_000.0), changed(frame_rate_hz=30.0)
    with reading(source):
        for file in (slow, fast):
            source.tune(file)
            got = source.metrics()
            assert got["exposure_us"] == file.exposure_us
            assert got["frame_rate_hz"] == pytest.approx(file.frame_rate_hz, rel=1e-2)
        camera.real_rate_hz = 30.0  # the second step fails: the first one is taken back
        with pytest.raises(CameraError, match="frame_rate_hz: wanted 15, frames come at 30 Hz"):
            source.tune(changed(frame_rate_hz=15.0, exposure_us=4000.0))
        assert source.metrics()["exposure_us"] == fast.exposure_us


def test_what_a_usb_camera_cannot_change_is_said() -> None:
    source = usb(Camera())
    with reading(source):
        with pytest.raises(CameraError, match="analogue_gain and colour_gains cannot be changed"):
            source.tune(changed(analogue_gain=2.0, colour_gains=(1.0, 1.0)))
        with pytest.raises(CameraError, match="exposure_us 600000 does not fit into a frame"):
            source.tune(changed(exposure_us=600_000.0))
        source.tune(changed(exposure_us=5000.0))


def test_without_a_loop_that_reads_frames_nothing_can_be_verified(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(v4l2_controls, "TIMEOUT_S", 0.01)
    monkeypatch.setattr(picamera2, "TIMEOUT_S", 0.01)
    for source in (usb(Camera()), pi(monkeypatch, Sensor())):
        with pytest.raises(CameraError, match=r"no frame was read for 0.01 s"):
            source.tune(changed(exposure_us=9000.0))
        source.close()


def test_a_camera_that_comes_back_has_the_settings_it_was_given_last() -> None:
    first, second = Camera(damaged=frozenset({20, 21})), Camera(damaged=frozenset({13}))
    plugged = [first, second]
    source = ReconnectingCamera(
        lambda file: usb(plugged.pop(0), file),
        FILE,
        SystemClock(),
        threading.Event(),
        first_s=0.001,
    )
    with reading(source):
        source.tune(changed(exposure_us=9000.0))
        assert until(lambda: source.counts()["camera.broken"] == 2)
        first.gone_after = 0
        assert until(lambda: source.counts()["camera.broken"] == 3)
        assert source.counts() == {
            "camera.lost": 1,
            "camera.back": 1,
            "camera.frozen": 0,
            "camera.raised": 0,
            "camera.broken": 3,
        }
        assert source.metrics()["exposure_us"] == 9000.0
    assert second.knob("Exposure Time").value == 90


def test_a_camera_that_is_away_cannot_be_changed() -> None:
    source = ReconnectingCamera(lambda file: usb(Camera(), file), FILE, SystemClock(), threading.Event())
    source.close()
    with pytest.raises(CameraError, match="camera 'left' is away"):
        source.tune(changed(exposure_us=9000.0))
    assert source.metrics() == {"camera.away_s": 0.0}


def test_a_late_watcher_sees_only_the_newest() -> None:
    frames = FrameObserver[int]()
    assert frames.newest is None
    frames.put(1)
    seen = frames.following(2, 5.0)
    for number in (2, 3, 4, 5):
        frames.put(number)
    assert next(seen) == 5
    frames.put(6)
    assert list(seen) == [6]  # the three that were missed do not count
    with pytest.raises(CameraError, match="no frame was read"):
        next(frames.following(1, 0.01))
