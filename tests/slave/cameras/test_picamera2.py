"""The Pi camera's driver, against a stand-in with the real library's interface and habits."""

import importlib
import importlib.util
import logging
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import CameraError
from slave.cameras.picamera2 import BUFFERS, Picamera2Camera
from slave.cameras.picamera2_settings import Picamera2Options
from slave.cameras.picamera2_streams import choose_mode, read_modes, without_padding
from tests.slave.fake_picamera2 import CompletedRequest, Picamera2, Sensor, install, parameters
from tests.slave.recorded_lists import IMX219, OV5647
from tests.slave.stand_ins import camera_file

calibration = partial(camera_file, frame_rate_hz=50.0)


def opened(
    monkeypatch: pytest.MonkeyPatch,
    sensor: Sensor,
    options: Picamera2Options | None = None,
    **changes: Any,
) -> Picamera2Camera:
    install(monkeypatch, sensor)
    return Picamera2Camera(calibration(**changes), options or Picamera2Options(), SystemClock())


def test_everything_is_fixed_before_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor()
    opened(monkeypatch, sensor).close()
    config = sensor.opened[0].config
    assert config["controls"] == {
        "AeEnable": False,
        "AwbEnable": False,
        "ExposureTime": 5000,
        "AnalogueGain": 1.25,
        "ColourGains": (0.83, 1.24),
        "FrameDurationLimits": (20_000, 20_000),
        "NoiseReductionMode": 0,
    }
    assert config["main"]["format"] == "RGB888"
    assert config["raw"] is None, "raw buffers cost memory that nobody reads"
    assert sensor.opened[0].closed


def test_a_frame_is_bgr_and_its_time_is_the_middle_of_the_exposure_of_row_zero(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = Sensor()
    camera = opened(monkeypatch, sensor)
    frames = [frame for _ in range(3) if (frame := camera.read()) is not None]
    assert [frame.seq for frame in frames] == [0, 1, 2]
    assert tuple(frames[0].image[0, 0, :2]) == (200, 100), "blue, green"
    number = int(frames[0].image[0, 0, 2])  # the fake writes the frame's number into red
    # SensorTimestamp is when row 0 is read out, at the end of its exposure: 148 rows of 33.67 us.
    middle = sensor.start_ns + round(number * 594 * 33.67e3) - 4972 * 500
    assert abs(frames[0].t_ns - middle) < 100_000
    assert abs(frames[0].ready_t_ns - time.monotonic_ns()) < 10_000_000_000
    assert frames[0].image is not frames[1].image


def test_image_and_metadata_are_of_one_request_and_every_request_goes_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = Sensor()
    camera = opened(monkeypatch, sensor)
    first = camera.read()
    assert first is not None
    for _ in range(10 * BUFFERS):  # a pool that leaks is empty after BUFFERS
        frame = camera.read()
        assert frame is not None
        step = int(frame.image[0, 0, 2]) - int(first.image[0, 0, 2])
        assert abs(frame.t_ns - first.t_ns - step * 19_999_980) < 50_000
    assert sensor.opened[0].outstanding == 0


@pytest.mark.parametrize("method", ["make_array", "get_metadata"])
def test_a_request_is_released_though_reading_it_fails(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    sensor = Sensor()
    camera = opened(monkeypatch, sensor)
    sensor.fails = frozenset({method})
    with pytest.raises(CameraError, match=f"{method} failed"):
        camera.read()
    assert sensor.opened[0].outstanding == 0


def test_dropped_frames_are_gaps_in_seq(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor()
    camera = opened(monkeypatch, sensor)
    first = camera.read()
    assert first is not None
    number = int(first.image[0, 0, 2])
    sensor.dropped = frozenset({number + 2, number + 3, number + 7})
    seqs = [frame.seq for _ in range(6) if (frame := camera.read()) is not None]
    assert seqs == [1, 4, 5, 6, 8, 9]


def overwrite(name: str, value: object) -> Callable[[int, dict[str, Any]], None]:
    def tamper(_number: int, metadata: dict[str, Any]) -> None:
        metadata[name] = value

    return tamper


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("ExposureTime", 4000, "ExposureTime: wanted 5000 us (exposure_us), got 4000 us"),
        ("AnalogueGain", 1.5, "AnalogueGain: wanted 1.25 (analogue_gain), got 1.5"),
        ("DigitalGain", 1.4, "DigitalGain: wanted 1"),
        ("ColourGains", (0.83, 1.6), "ColourGains: wanted 0.83, 1.24 (colour_gains), got 0.83, 1.6"),
        ("ColourGains", (0.83,), "ColourGains"),
        ("FrameDuration", 33_333, "FrameDuration: wanted 20000 us (frame_rate_hz 50), got 33333 us"),
        ("ExposureTime", None, "ExposureTime: wanted 5000 us (exposure_us), got None"),
    ],
)
def test_a_setting_that_was_not_taken_is_named_with_wanted_and_got(
    monkeypatch: pytest.MonkeyPatch, name: str, value: object, expected: str
) -> None:
    sensor = Sensor(tamper=overwrite(name, value))
    with pytest.raises(CameraError) as error:
        opened(monkeypatch, sensor)
    assert expected in str(error.value)
    assert "camera 'left'" in str(error.value)
    assert "Change the camera file" in str(error.value)
    assert sensor.opened[0].closed, "the camera is given back"


def test_a_setting_that_is_not_reported_counts_as_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor(tamper=lambda _k, metadata: metadata.pop("ColourGains") and None)
    with pytest.raises(CameraError, match=r"ColourGains: wanted .*, not read back at all"):
        opened(monkeypatch, sensor)


def test_settings_that_come_late_are_waited_for_and_ones_that_waver_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened(monkeypatch, Sensor(delay=20)).close()

    def waver(number: int, metadata: dict[str, Any]) -> None:
        if number % 2:
            metadata["ExposureTime"] = 9000

    with pytest.raises(CameraError, match=r"did not take|do not stay"):
        opened(monkeypatch, Sensor(tamper=waver))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"exposure_us": 25_000.0}, "exposure_us 25000 does not fit into a frame of 20000 us"),
        ({"analogue_gain": 90.0}, "AnalogueGain 90 is not within 1 to 63.9375"),
        ({"exposure_us": 20.0}, "ExposureTime 20 is not within 34 to"),
        ({"frame_rate_hz": 90.0}, "Nearest: 640x480 10 bit, up to 58.9 Hz"),
        ({"width_px": 1920, "height_px": 1080}, "no mode of the camera delivers 1920x1080 at 50 Hz"),
    ],
)
def test_what_the_camera_cannot_do_is_refused_with_its_limits(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], expected: str
) -> None:
    with pytest.raises(CameraError) as error:
        opened(monkeypatch, Sensor(), **changes)
    assert expected in str(error.value)


def test_a_stream_that_libcamera_adjusted_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def smaller(config: dict[str, Any]) -> None:
        config["main"]["size"] = (608, 480)

    with pytest.raises(CameraError, match="wanted 640x480 RGB888, the camera makes 608x480 RGB888 of it"):
        opened(monkeypatch, Sensor(adjust=smaller))


def test_a_monochrome_camera_is_refused_because_of_the_colour_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CameraError, match="no control AwbEnable, ColourGains"):
        opened(monkeypatch, Sensor(monochrome=True))


def test_focus_is_fixed_where_there_is_focus_and_refused_where_there_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = Sensor(focus=True)
    opened(monkeypatch, sensor, focus_m=0.5).close()
    controls = sensor.opened[0].config["controls"]
    assert (controls["AfMode"], controls["LensPosition"]) == (0, 2.0), "manual, 1 / 0.5 m"
    with pytest.raises(CameraError, match="it has a focus motor, which would move"):
        opened(monkeypatch, Sensor(focus=True))
    with pytest.raises(CameraError, match="no focus motor"):
        opened(monkeypatch, Sensor(), focus_m=0.5)
    with pytest.raises(CameraError, match="LensPosition 20 is not within 0 to 15"):
        opened(monkeypatch, Sensor(focus=True), focus_m=0.05)
    moved = Sensor(focus=True, tamper=overwrite("LensPosition", 1.0))
    with pytest.raises(CameraError, match=r"LensPosition: wanted 2 dioptres .focus_m., got 1 dioptres"):
        opened(monkeypatch, moved, focus_m=0.5)


@pytest.mark.parametrize("role", ["server", "client"])
def test_synchronised_cameras_start_with_the_first_common_frame(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, role: Any
) -> None:
    caplog.set_level(logging.INFO)
    sensor = Sensor(sync_ready_at=200)
    camera = opened(monkeypatch, sensor, Picamera2Options(sync=role))
    controls = sensor.opened[0].config["controls"]
    assert controls["SyncMode"] == (1 if role == "server" else 2)
    assert ("SyncFrames" in controls) == (role == "server"), "only the server says when"
    frame = camera.read()
    assert frame is not None
    assert int(frame.image[0, 0, 2]) == 201
    assert "in step, -37 us off" in caplog.text
    assert "waiting for" in caplog.text


def test_nobody_to_synchronise_with_is_an_error_after_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CameraError, match=r"not in step after .* s, nothing was received from a server"):
        opened(monkeypatch, Sensor(sync_ready_at=None), Picamera2Options(sync="client", sync_timeout_s=0.01))
    with pytest.raises(CameraError, match="--sync server: not in step"):
        opened(monkeypatch, Sensor(sync_ready_at=None), Picamera2Options(sync="server", sync_timeout_s=0.01))


def test_a_stop_ends_the_wait_for_synchronisation(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = install(monkeypatch, Sensor(sync_ready_at=None))
    stop = threading.Event()
    stop.set()
    with pytest.raises(CameraError, match="stopped while it waited for the server"):
        Picamera2Camera(calibration(), Picamera2Options(sync="client"), SystemClock(), stop)
    assert sensor.opened[0].closed


def test_synchronisation_needs_a_libcamera_that_can_and_a_mode_with_room(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(CameraError, match="cannot synchronise cameras"):
        opened(monkeypatch, Sensor(sync=False), Picamera2Options(sync="client"))
    opened(monkeypatch, Sensor(), frame_rate_hz=58.0).close()
    with pytest.raises(CameraError, match="no mode of the camera"):
        opened(monkeypatch, Sensor(), Picamera2Options(sync="client"), frame_rate_hz=58.0)


def test_a_libcamera_without_the_enumeration_cannot_synchronise(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, Sensor(), with_sync=False)
    with pytest.raises(CameraError, match="cannot synchronise cameras"):
        Picamera2Camera(calibration(), Picamera2Options(sync="server"), SystemClock())


def test_a_missing_system_package_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(CameraError) as error:
        Picamera2Camera(calibration(), Picamera2Options(), SystemClock())
    assert "sudo apt install python3-picamera2" in str(error.value)
    assert "--system-site-packages" in str(error.value)


def test_an_absent_or_busy_camera_is_an_error_with_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CameraError, match=r"no such camera; there are: 0 \(ov5647\)"):
        opened(monkeypatch, Sensor(), Picamera2Options(index=1))
    with pytest.raises(CameraError, match="another program may have it"):
        opened(monkeypatch, Sensor(busy=True))


def test_a_lost_camera_is_an_error_and_can_be_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor()
    camera = opened(monkeypatch, sensor)
    sensor.lost_after = 0
    with pytest.raises(CameraError, match="no frame for 2 s; check its cable"):
        camera.read()
    camera.close()  # would wait for ever behind the capture, if the jobs were not flushed
    camera.close()
    assert sensor.opened[0].closed
    assert camera.read() is None


def test_without_a_sensor_time_the_wall_clock_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    for unit in (1, 1000):  # early libcamera said microseconds

        def only_wall(_number: int, metadata: dict[str, Any], unit: int = unit) -> None:
            del metadata["SensorTimestamp"]
            metadata["FrameWallClock"] //= unit

        sensor = Sensor(tamper=only_wall)
        camera = opened(monkeypatch, sensor)
        frame = camera.read()
        assert frame is not None
        middle = sensor.start_ns + round(int(frame.image[0, 0, 2]) * 594 * 33.67e3) - 4972 * 500
        assert abs(frame.t_ns - middle) < 1_000_000


def test_a_frame_without_a_time_is_skipped_and_one_on_no_clock_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = Sensor()
    camera = opened(monkeypatch, sensor)
    first = camera.read()
    assert first is not None
    late = int(first.image[0, 0, 2]) + 1
    sensor.tamper = lambda k, metadata: metadata.update(SensorTimestamp=0) if k == late else None
    after = camera.read()
    assert after is not None
    assert after.seq == 2
    broken = opened(monkeypatch, Sensor(tamper=overwrite("SensorTimestamp", 12_345)))
    with pytest.raises(CameraError, match="is on no clock"):
        broken.read()


def test_the_small_image_is_of_the_same_frame_and_without_padding(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor()
    camera = opened(monkeypatch, sensor, Picamera2Options(lores=(200, 150)))
    assert sensor.opened[0].config["lores"]["stride"] == 256
    assert camera.lores is None
    assert camera.read() is not None
    small = camera.lores
    assert small is not None
    assert small.shape == (225, 200)
    assert (small[:150] == np.arange(200) % 128).all()
    assert (small[150:].ravel()[:7500] == 130).all()
    assert (small[150:].ravel()[7500:] == 140).all()


@pytest.mark.parametrize("shape", [(224, 256), (225, 150), (225, 255)])
def test_a_small_image_of_another_shape_is_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(RuntimeError, match="a small frame is"):
        without_padding(np.zeros(shape, np.uint8), 200, 150)


def test_the_widest_view_that_is_fast_enough_wins() -> None:
    modes = read_modes(IMX219)
    assert choose_mode(modes, 40.0, (640, 480)).size == (1640, 1232), "the full view, binned"
    assert choose_mode(modes, 90.0, (640, 480)).crop == (1000, 752, 1280, 960), "only the centre is that fast"
    assert choose_mode(modes, 20.0, (1920, 1080)).size == (3280, 2464)
    assert choose_mode(read_modes(OV5647), 58.92, (640, 480)).size == (640, 480)
    with pytest.raises(
        CameraError, match=r"640x480 10 bit, up to 206.7 Hz, 15 % of the full view; 1640x1232 10 bit"
    ):
        choose_mode(modes, 207.0, (640, 480))
    with pytest.raises(CameraError, match="v4l2"):
        choose_mode(read_modes([{"format": "MJPEG"}]), 30.0, (640, 480))


def test_the_stand_in_has_the_signatures_of_the_real_library() -> None:
    if importlib.util.find_spec("picamera2") is None:
        pytest.skip("picamera2 is not installed here: its signatures were compared by hand with 0.3.38")
    real: Any = importlib.import_module("picamera2")
    request: Any = importlib.import_module("picamera2.request")
    methods = (
        "__init__",
        "create_video_configuration",
        "configure",
        "start",
        "set_controls",
        "capture_request",
    )
    for name in (*methods, "close"):
        assert parameters(getattr(Picamera2, name)) == parameters(getattr(real.Picamera2, name)), name
    for name in ("make_array", "get_metadata", "release"):
        assert parameters(getattr(CompletedRequest, name)) == parameters(
            getattr(request.CompletedRequest, name)
        ), name


def test_a_stamp_scatters_by_the_latency_of_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = opened(monkeypatch, Sensor()).read()
    assert frame is not None
    assert 50e3 <= frame.t_sigma_ns < 100e3  # and a little of the conversion between clocks
