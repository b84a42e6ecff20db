"""Grey frames of real cameras: every depth and packing of a monochrome sensor, and luma of colour cameras by name."""

import threading
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from common.calibration import CameraCalibration
from common.clock import SystemClock
from common.errors import CameraError
from common.messages import WristDetections
from common.recording.frame_recording import Illumination, open_recording
from slave.__main__ import main
from slave.cameras import v4l2_abi as abi
from slave.cameras.grey import GREY_FORMATS, Pixels, grey, luma
from slave.cameras.picamera2 import Picamera2Camera
from slave.cameras.picamera2_settings import Picamera2Options
from slave.cameras.v4l2 import V4l2Camera, V4l2Options
from slave.preview import small_jpeg, whole_jpeg
from slave.report import DetectionCounters
from slave.sender import WristPipeline, run
from slave.wrist.detector import WristDetector
from tests.slave.fake_picamera2 import Sensor, install
from tests.slave.fake_v4l2 import Camera, FakeDevice, colour, level, row_bytes, webcam_knobs
from tests.slave.recorded_lists import OV7251, OV9281
from tests.slave.stand_ins import Listed, Wire, camera_file
from tests.slave.wrist.test_loop import NAMES
from tests.slave.wrist.wrist_frames import ROOT, VIEW, strobed

SIZE = (640, 480)
RATE_HZ = 90.0


calibration = partial(
    camera_file,
    name="wrist",
    width_px=SIZE[0],
    height_px=SIZE[1],
    frame_rate_hz=RATE_HZ,
    exposure_us=2000.0,
    colour_gains=(1.0, 1.0),
    row_time_us=0.0,
)


def usb(camera: Camera, pixels: Pixels = Pixels.GREY, **changes: Any) -> V4l2Camera:
    codes = {"gain": 32} | ({"white_balance_temperature": 4600} if has_colours(camera) else {})
    options = V4l2Options(controls=codes, pixels=pixels)
    return V4l2Camera(calibration(**changes), options, SystemClock(), lambda _path: FakeDevice(camera))


def has_colours(camera: Camera) -> bool:
    return any(knob.name.startswith("White Balance T") for knob in camera.knobs)


def mono(name: str, **changes: Any) -> Camera:
    """A USB camera with a monochrome sensor: no white balance."""
    knobs = [knob for knob in webcam_knobs() if not knob.name.startswith("White")]
    return Camera(knobs=knobs, formats={name: {SIZE: (RATE_HZ,)}}, **changes)


def pi(
    monkeypatch: pytest.MonkeyPatch, sensor: Sensor, pixels: Pixels = Pixels.GREY, **changes: Any
) -> Picamera2Camera:
    install(monkeypatch, sensor)
    return Picamera2Camera(calibration(**changes), Picamera2Options(pixels=pixels), SystemClock())


@pytest.mark.parametrize("name", GREY_FORMATS)
@pytest.mark.parametrize("padding", [0, 14])
def test_every_grey_format_becomes_the_highest_8_bits(name: str, padding: int) -> None:
    source = usb(mono(name, padding=padding))
    for _ in range(2):
        frame = source.read()
        assert frame is not None
        first = level(frame.seq + 12)  # those of the start are not handed over
        expected = np.minimum(first + np.arange(SIZE[0]), 1023) >> 2
        np.testing.assert_array_equal(frame.image, np.broadcast_to(expected.astype(np.uint8), SIZE[::-1]))
        assert frame.illumination is Illumination.NONE, "what lit it is for the strobe to tell"
        assert frame.exposure_us == 2000.0
    source.close()


def test_grey_formats_of_the_kernel_by_their_documented_bytes() -> None:
    # pixfmt-yuv-luma: Y10P bits 1-0 of pixel 0 are bits 1-0 of the fifth byte; Y10 is little-endian in two bytes.
    assert grey(np.array([1, 2, 3, 4, 0b11_10_01_00], np.uint8), "Y10P", (4, 1), 5) == pytest.approx(
        np.array([[1, 2, 3, 4]])
    )
    words = np.array([0x03, 0x00, 0x04, 0x00, 0xFF, 0x03, 0xFF, 0xFF], np.uint8)
    np.testing.assert_array_equal(grey(words, "Y10", (4, 1), 8), [[0, 1, 255, 255]])
    np.testing.assert_array_equal(grey(np.array([7, 9, 0x5A], np.uint8), "Y12P", (2, 1), 3), [[7, 9]])
    np.testing.assert_array_equal(
        grey(np.array([0xC0, 0xFF, 0x40, 0x10], np.uint8), "Y16", (2, 1), 4), [[255, 16]]
    )
    for depth, name in ((10, "Y10"), (12, "Y12")):
        every = np.arange(1 << depth, dtype="<u2")
        np.testing.assert_array_equal(
            grey(every.view(np.uint8), name, (len(every), 1), 2 * len(every)), [every >> (depth - 8)]
        )


@pytest.mark.parametrize("name", GREY_FORMATS)
def test_a_cut_frame_and_a_width_that_fills_no_group(name: str) -> None:
    size, stride = (633, 3), row_bytes(name, 633) + 5
    data = np.zeros(stride * 2 + row_bytes(name, 633), np.uint8)  # no padding after the last row
    found = grey(data, name, size, stride)
    assert found is not None
    assert found.shape == (3, 633)
    assert found.flags.owndata or found.base is None or not np.shares_memory(found, data)
    assert grey(data[:-1], name, size, stride) is None
    assert grey(data, name, size, row_bytes(name, 633) - 1) is None


def test_words_that_fill_their_low_end_alone_are_no_y16() -> None:
    with pytest.raises(
        CameraError, match=r"no value above 0x7f.*choose a mode that the driver calls Y10 or Y12"
    ):
        grey(np.arange(128, dtype="<u2").view(np.uint8), "Y16", (128, 1), 256)
    with pytest.raises(CameraError, match=r"'wrist'.*its Y16 has no value above"):
        usb(mono("Y16", low_words=True))


def test_damaged_grey_frames_are_gaps_in_seq() -> None:
    source = usb(mono("Y10", damaged=frozenset({13}), cut=frozenset({15})))
    assert [frame.seq for _ in range(4) if (frame := source.read()) is not None] == [0, 2, 4, 5]
    assert source.broken == 2


@pytest.mark.parametrize("name", ["BA81", "YUYV", "MJPG", "BGR3"])
def test_a_mosaic_and_colours_are_never_taken_for_grey(name: str) -> None:
    with pytest.raises(CameraError, match=rf"known format \(GREY, .*{name}, which are not grey"):
        usb(Camera(formats={name: {SIZE: (RATE_HZ,)}}))
    if name in ("BA81", "BGR3"):
        with pytest.raises(CameraError, match=f"{name}, which hold no luma"):
            usb(Camera(formats={name: {SIZE: (RATE_HZ,)}}), Pixels.LUMA)


def test_an_8_bit_format_is_taken_before_deeper_ones() -> None:
    camera = mono("Y16")
    camera.formats |= {"Y10": {SIZE: (RATE_HZ,)}, "GREY": {SIZE: (60.0, RATE_HZ)}}
    frame = usb(camera).read()
    assert frame is not None
    assert frame.image[0, 0] == level(12) >> 2


@pytest.mark.parametrize("name", ["YUYV", "UYVY", "NV12", "MJPG"])
@pytest.mark.parametrize("padding", [0, 32])
def test_luma_is_that_of_the_colours_from_black_to_white(name: str, padding: int) -> None:
    frame = usb(Camera(formats={name: {SIZE: (RATE_HZ,)}}, padding=padding), Pixels.LUMA).read()
    assert frame is not None
    expected = cv2.cvtColor(np.full((1, 1, 3), colour(12), np.uint8), cv2.COLOR_BGR2GRAY)[0, 0]
    assert frame.image.shape == SIZE[::-1]
    assert np.abs(frame.image.astype(int) - int(expected)).max() <= 2


def test_luma_of_the_full_range_is_not_stretched() -> None:
    data = np.array([16, 128, 235, 128], np.uint8)
    np.testing.assert_array_equal(luma(data, "YUYV", (2, 1), 4, full_range=False), [[0, 255]])
    np.testing.assert_array_equal(luma(data, "YUYV", (2, 1), 4, full_range=True), [[16, 235]])
    limited, full = (
        usb(Camera(formats={"YUYV": {SIZE: (RATE_HZ,)}}, quantization=coded), Pixels.LUMA).read()
        for coded in (abi.V4L2.default_range, abi.V4L2.full_range)
    )
    assert limited is not None
    assert full is not None
    assert abs(int(limited.image[0, 0]) - (int(full.image[0, 0]) - 16) * 255 / 219) < 1.0


def test_a_white_balance_that_is_there_is_fixed_though_frames_are_luma() -> None:
    camera = Camera(formats={"YUYV": {SIZE: (RATE_HZ,)}})
    with pytest.raises(CameraError, match="its white_balance is a code of its maker"):
        V4l2Camera(
            calibration(),
            V4l2Options(controls={"gain": 32}, pixels=Pixels.LUMA),
            SystemClock(),
            lambda _path: FakeDevice(camera),
        )


@pytest.mark.parametrize(
    ("pi_5", "modes", "raw"),
    [(False, OV7251, "R8"), (True, OV7251, "R8"), (False, OV7251[1:], "R10"), (True, OV7251[1:], "R16")],
)
def test_a_pi_camera_gives_what_its_sensor_measured(
    monkeypatch: pytest.MonkeyPatch, pi_5: bool, modes: tuple[dict[str, Any], ...], raw: str
) -> None:
    sensor = Sensor(model="ov7251", modes=modes, monochrome=True, pi_5=pi_5)
    camera = pi(monkeypatch, sensor)
    config = sensor.opened[0].config
    assert config["raw"]["format"] == raw
    assert "ColourGains" not in config["controls"]
    assert config["controls"]["AeEnable"] is False
    for _ in range(3):
        frame = camera.read()
        assert frame is not None
        number = round((frame.t_ns - sensor.start_ns) * 1e-9 * RATE_HZ)
        expected = np.minimum(4 * number + np.arange(SIZE[0]), 1023) >> 2
        np.testing.assert_array_equal(frame.image, np.broadcast_to(expected.astype(np.uint8), SIZE[::-1]))
        assert frame.image.dtype == np.uint8
        assert frame.exposure_us == 2000.0
        middle = (
            sensor.start_ns + round(number * 11_104e3) - 1_000_000
        )  # 694 rows of 16 us; half an exposure before
        assert abs(frame.t_ns - middle) < 100_000
    assert sensor.opened[0].outstanding == 0
    camera.close()


def test_a_pi_camera_has_exactly_a_mode_of_its_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor(model="ov9281", modes=OV9281, monochrome=True)
    with pytest.raises(
        CameraError, match=r"no mode of the sensor is 640x480 at 90 Hz.*640x400 10 bit, up to 247.8 Hz"
    ):
        pi(monkeypatch, sensor)
    camera = pi(monkeypatch, sensor, height_px=400)
    frame = camera.read()
    assert frame is not None
    assert frame.image.shape == (400, 640)
    assert sensor.opened[-1].config["sensor"] == {"output_size": (640, 400), "bit_depth": 8}
    camera.close()
    with pytest.raises(CameraError, match="colour_gains: its sensor has no colours: write"):
        pi(monkeypatch, sensor, height_px=400, colour_gains=(1.2, 1.0))


def test_settings_of_a_grey_pi_camera_are_read_back_and_change_live(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(_number: int, metadata: dict[str, Any]) -> None:
        metadata["ExposureTime"] = 1500

    with pytest.raises(CameraError, match="ExposureTime: wanted 2000 us"):
        pi(monkeypatch, Sensor(modes=OV7251, monochrome=True, tamper=wrong))
    with pytest.raises(CameraError, match="exposure_us 12000 does not fit into a frame of 11111 us"):
        pi(monkeypatch, Sensor(modes=OV7251, monochrome=True), exposure_us=12_000.0)
    camera = pi(monkeypatch, Sensor(modes=OV7251, monochrome=True))
    done = threading.Event()
    exposures: list[float] = []

    def read() -> None:
        while not done.is_set() and (frame := camera.read()) is not None:
            exposures.append(frame.exposure_us)

    loop = threading.Thread(target=read)
    loop.start()
    try:
        camera.tune(calibration(exposure_us=1600.0))
    finally:
        done.set()
        loop.join()
        camera.close()
    assert exposures[-1] == 1600.0
    assert camera.metrics()["exposure_us"] == 1600.0


def test_a_pi_camera_with_colours_is_refused_until_luma_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = Sensor()
    with pytest.raises(CameraError, match=r"colour filters, so that its values are a mosaic.*--luma"):
        pi(monkeypatch, sensor, frame_rate_hz=50.0)
    camera = pi(monkeypatch, sensor, Pixels.LUMA, frame_rate_hz=50.0, row_time_us=33.6)
    assert sensor.opened[-1].config["main"]["format"] == "YUV420"
    assert sensor.opened[-1].config["raw"] is None
    frame = camera.read()
    camera.close()
    assert frame is not None
    expected = np.clip(np.round((np.arange(SIZE[0]) % 128 - 16.0) * 255 / 219), 0, 255)  # the fake's ramp
    np.testing.assert_array_equal(frame.image, np.broadcast_to(expected.astype(np.uint8), SIZE[::-1]))


def test_pictures_of_grey_frames_for_whoever_looks() -> None:
    image = np.tile(np.arange(640, dtype=np.uint16).astype(np.uint8), (480, 1))
    for jpeg, size in ((small_jpeg(image), (240, 320)), (whole_jpeg(image), (480, 640))):
        assert jpeg is not None
        shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
        assert shown is not None
        assert shown.shape == size


def strobed_camera() -> Camera:
    """A camera of 10 bits before a strobed hand."""
    pictures = [frame.image for frame in strobed("curl", 8)]
    camera = mono("Y10", pictures=pictures, padding=32)
    camera.formats = {"Y10": {(pictures[0].shape[1], pictures[0].shape[0]): (RATE_HZ,)}}
    return camera


def test_a_hand_before_a_real_camera_is_found_as_in_the_same_pictures_of_8_bits() -> None:
    source, wire = (
        usb(strobed_camera(), height_px=strobed("curl", 1)[0].image.shape[0]),
        Wire(WristDetections),
    )
    detector = WristDetector(VIEW, RATE_HZ)
    taken = (frame for _ in range(12) if (frame := source.read()) is not None)
    run(
        Listed(taken),
        WristPipeline("wrist", wire.session, wire.send, detector.push, DetectionCounters(NAMES)),
        threading.Event(),
    )
    source.close()
    assert detector.counts["cycles"] >= 3
    plain = WristDetector(VIEW, RATE_HZ)
    found = [one for frame in strobed("curl", 8)[12:] if (one := plain.push(frame)) is not None]
    for message, one in zip(wire.sent, found, strict=True):
        np.testing.assert_array_equal(message.laser_uv, one.laser.uv)
        assert message.exposure_us == 2000.0


def test_a_real_wrist_camera_is_recorded_grey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fake(file: CameraCalibration, asked: V4l2Options, clock: Any) -> V4l2Camera:
        return V4l2Camera(file, asked, clock, lambda _path: FakeDevice(strobed_camera()))

    monkeypatch.setattr("slave.cameras.v4l2.V4l2Camera", fake)
    out = tmp_path / "rec"
    command = [
        "record",
        "--name",
        "wrist",
        "--rig",
        "wrist",
        "--calibration",
        str(ROOT / "calib_json"),
        "--frames",
        "6",
    ]
    given = ["--camera", "v4l2", "--control", "gain=32", "--lights", "external"]
    assert main([*command, *given, "-o", str(out)]) == 0
    recording = open_recording(out)
    assert {row.illumination for row in recording.rows} == {Illumination.NONE}
    image = cv2.imread(str(out / recording.rows[0].file), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, strobed("curl", 8)[12].image)
