"""The V4L2 driver: the kernel's numbers, its logic against a camera that answers ioctls, and a real device if any."""

import ctypes as c
import errno
import os
import re
import time
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import CameraError
from slave.cameras import v4l2_abi as abi
from slave.cameras.grey import Pixels
from slave.cameras.v4l2 import BUFFERS, V4l2Camera, V4l2Options
from slave.cameras.v4l2_controls import plain_name, read_controls
from slave.cameras.v4l2_formats import Layout, choose_offer, read_offers
from tests.slave.fake_v4l2 import Camera, FakeDevice, Knob, colour, encode
from tests.slave.stand_ins import camera_file

GIVEN = {"gain": 32, "white_balance_temperature": 4600}
PERIOD_NS = 1e9 / 30.0


calibration = partial(camera_file, row_time_us=30.0)


def opened(camera: Camera, options: V4l2Options | None = None, **changes: Any) -> V4l2Camera:
    options = options or V4l2Options(controls=GIVEN)
    return V4l2Camera(calibration(**changes), options, SystemClock(), lambda _path: FakeDevice(camera))


# Printed by a C program that includes linux/videodev2.h, on x86-64; every 64-bit Linux has the same.
SIZES = {
    abi.Capability: 104,
    abi.FormatDescription: 64,
    abi.FrameSizes: 44,
    abi.FrameIntervals: 52,
    abi.PixelFormat: 48,
    abi.Format: 208,
    abi.StreamParameters: 204,
    abi.RequestBuffers: 20,
    abi.Buffer: 88,
    abi.QueryControl: 232,
    abi.QueryMenu: 44,
    abi.ControlValue: 20,
    abi.ControlValues: 32,
}
NUMBERS = {
    "QUERYCAP": 0x80685600,
    "ENUM_FMT": 0xC0405602,
    "S_FMT": 0xC0D05605,
    "REQBUFS": 0xC0145608,
    "QUERYBUF": 0xC0585609,
    "QBUF": 0xC058560F,
    "DQBUF": 0xC0585611,
    "STREAMON": 0x40045612,
    "STREAMOFF": 0x40045613,
    "S_PARM": 0xC0CC5616,
    "QUERYMENU": 0xC02C5625,
    "G_EXT_CTRLS": 0xC0205647,
    "S_EXT_CTRLS": 0xC0205648,
    "ENUM_FRAMESIZES": 0xC02C564A,
    "ENUM_FRAMEINTERVALS": 0xC034564B,
    "QUERY_EXT_CTRL": 0xC0E85667,
}
OFFSETS = {
    (abi.Buffer, "flags"): 12,
    (abi.Buffer, "tv_sec"): 24,
    (abi.Buffer, "sequence"): 56,
    (abi.Buffer, "offset"): 64,
    (abi.Buffer, "length"): 72,
    (abi.Format, "fmt"): 8,
    (abi.ControlValues, "controls"): 24,
    (abi.QueryControl, "minimum"): 40,
    (abi.QueryControl, "flags"): 72,
    (abi.FrameSizes, "size"): 12,
    (abi.FrameIntervals, "interval"): 20,
}


def test_structures_have_the_layout_of_the_kernel() -> None:
    assert {kind: c.sizeof(kind) for kind in SIZES} == SIZES
    assert {(kind, name): getattr(kind, name).offset for kind, name in OFFSETS} == OFFSETS


def test_requests_have_the_numbers_of_the_kernel() -> None:
    assert {name: getattr(abi, name) for name in NUMBERS} == NUMBERS
    assert abi.fourcc("YUYV") == 0x56595559
    assert abi.fourcc("MJPG") == 0x47504A4D
    assert abi.fourcc_text(0x33524742) == "BGR3"
    assert abi.fourcc("Y10") == 0x20303159
    assert abi.fourcc_text(0x20363159) == "Y16"


def test_automatics_are_off_before_values_are_written_and_all_are_as_asked() -> None:
    camera = Camera()
    opened(camera).close()
    names = [name for name, _ in camera.writes]
    assert names.index("Exposure, Auto") < names.index("Exposure Time, Absolute")
    assert names.index("White Balance, Automatic") < names.index("White Balance Temperature")
    expected = {
        "Exposure, Auto": 1,
        "Exposure, Dynamic Framerate": 0,
        "White Balance, Automatic": 0,
        "Power Line Frequency": 0,
        "Exposure Time, Absolute": 50,  # x 100 us
        "Gain": 32,
        "White Balance Temperature": 4600,
        "Brightness": 0,
    }
    assert {name: camera.knob(name).value for name in expected} == expected
    assert camera.closed == 1


@pytest.mark.parametrize(
    ("name", "to", "expected"),
    [
        (
            "Exposure Time, Absolute",
            157,
            "exposure_time_absolute: wanted 50 x 100 us (exposure_us), got 157 x 100 us",
        ),
        ("Exposure, Auto", 3, "auto_exposure: wanted 1 (no automatic), got 3"),
        ("Gain", 33, "gain: wanted 32 (--control), got 33"),
        ("Exposure, Dynamic Framerate", 1, "exposure_dynamic_framerate: wanted 0 (no automatic), got 1"),
    ],
)
def test_a_setting_that_was_not_taken_is_named_with_wanted_and_got(name: str, to: int, expected: str) -> None:
    camera = Camera(keeps=lambda knob, value: to if knob == name else value)
    with pytest.raises(CameraError) as error:
        opened(camera)
    assert expected in str(error.value)
    assert "camera 'left' (v4l2:/dev/video0)" in str(error.value)
    assert camera.closed == 1


def test_a_camera_that_falls_back_when_the_stream_starts_is_reported_again() -> None:
    camera = Camera(resets={"Exposure Time": 333, "Gain": 1})
    opened(camera).close()
    assert (camera.knob("Exposure Time").value, camera.knob("Gain").value) == (50, 32)


def without(*names: str) -> Camera:
    camera = Camera()
    camera.knobs = [knob for knob in camera.knobs if not knob.name.startswith(names)]
    return camera


def test_what_the_camera_lacks_is_said_by_name_and_must_be_allowed() -> None:
    with pytest.raises(CameraError) as error:
        opened(without("Gain", "White Balance"), V4l2Options())
    assert (
        "no gain control for analogue_gain of the camera file: allow that with --allow-missing gain"
        in str(error.value)
    )
    assert "--allow-missing white_balance" in str(error.value)
    opened(without("Gain", "White Balance"), V4l2Options(allow_missing=("gain", "white_balance"))).close()
    with pytest.raises(CameraError, match="--allow-missing exposure"):
        opened(without("Exposure Time"))
    with pytest.raises(CameraError, match="--allow-missing colour: there are exposure, gain, white_balance"):
        opened(Camera(), V4l2Options(controls=GIVEN, allow_missing=("colour",)))


def test_codes_of_the_maker_must_be_given() -> None:
    with pytest.raises(CameraError) as error:
        opened(Camera(), V4l2Options())
    assert "its gain is a code of its maker: give --control gain=N, gain (0 to 100 step 1)" in str(
        error.value
    )
    assert "--control white_balance_temperature=N" in str(error.value)
    # allowing that a control is missing is no way around one that is there
    with pytest.raises(CameraError, match="give --control gain=N"):
        opened(Camera(), V4l2Options(controls={"white_balance_temperature": 4600}, allow_missing=("gain",)))
    camera = without("White Balance Temperature")
    camera.knobs += [
        Knob(0x0098090E, "Red Balance", 1, 0, 255, 1, 9),
        Knob(0x0098090F, "Blue Balance", 1, 0, 255, 1, 9),
    ]
    with pytest.raises(CameraError, match="--control red_balance=N and --control blue_balance=N"):
        opened(camera, V4l2Options(controls={"gain": 32, "red_balance": 100}))
    opened(camera, V4l2Options(controls={"gain": 32, "red_balance": 100, "blue_balance": 90})).close()
    camera = Camera()
    camera.knobs.append(Knob(0x009A090A, "Focus, Absolute", 1, 0, 250, 5, 0))
    with pytest.raises(CameraError, match="focus motor: give --control focus_absolute=N"):
        opened(camera)


@pytest.mark.parametrize(
    ("controls", "expected"),
    [
        (
            {"sharpness": 1},
            "--control sharpness: it has no such control; it has white_balance_automatic|brightness",
        ),
        ({"gain": 101}, "--control gain=101: out of range; gain .0 to 100 step 1."),
        (
            {"white_balance_temperature": 4605},
            "out of range; white_balance_temperature .2800 to 6500 step 10.",
        ),
        ({"auto_exposure": 0}, "out of range; auto_exposure .1 = Manual Mode, 3 = Aperture Priority Mode."),
        ({"exposure_time_absolute": 9}, "the exposure is exposure_us of the camera file"),
    ],
)
def test_a_wrong_control_is_refused_with_what_is_allowed(controls: dict[str, int], expected: str) -> None:
    with pytest.raises(CameraError, match=expected):
        opened(Camera(), V4l2Options(controls=GIVEN | controls))


def test_an_exposure_beyond_the_camera_is_refused_and_one_between_steps_is_rounded() -> None:
    with pytest.raises(CameraError, match="exposure_us 600000 is not within 100 to 500000"):
        opened(Camera(), exposure_us=600_000.0)
    camera = Camera()
    opened(camera, exposure_us=5049.0).close()
    assert camera.knob("Exposure Time").value == 50


def test_a_filter_that_cannot_be_switched_off_must_be_chosen() -> None:
    camera = Camera()
    camera.knob("Power Line").menu = {1: "50 Hz", 2: "60 Hz"}
    with pytest.raises(CameraError, match="power_line_frequency cannot be switched off: give --control"):
        opened(camera)
    opened(camera, V4l2Options(controls=GIVEN | {"power_line_frequency": 1})).close()
    assert camera.knob("Power Line").value == 1


def test_a_refused_write_says_why() -> None:
    with pytest.raises(CameraError, match=r"gain=32 .--control. was refused: another program is using it"):
        opened(Camera(refuses={"Gain": errno.EBUSY}))


def test_controls_have_the_names_of_today_whatever_the_kernel_calls_them() -> None:
    found = read_controls(FakeDevice(Camera()))
    assert "auto_exposure" in found
    assert "exposure_auto" not in found
    assert "user_controls" not in found, "a heading is no control"
    assert found["auto_exposure"].menu == {1: "Manual Mode", 3: "Aperture Priority Mode"}
    assert plain_name("White Balance, Automatic") == "white_balance_automatic"


@pytest.mark.parametrize(("rate_hz", "expected"), [(30.0, "YUYV"), (29.97, "YUYV"), (60.0, "MJPG")])
def test_the_uncompressed_format_is_taken_where_it_is_fast_enough(rate_hz: float, expected: str) -> None:
    offers = read_offers(FakeDevice(Camera()), (640, 480))
    assert abi.fourcc_text(choose_offer(offers, (640, 480), rate_hz).pixel_format) == expected


@pytest.mark.parametrize(("size", "rate_hz"), [((640, 480), 90.0), ((640, 360), 30.0), ((640, 480), 20.0)])
def test_what_is_not_offered_is_refused_with_the_list(size: tuple[int, int], rate_hz: float) -> None:
    with pytest.raises(CameraError) as error:
        opened(Camera(), width_px=size[0], height_px=size[1], frame_rate_hz=rate_hz)
    assert re.search(
        "Nearest of 4: (YUYV 640x480 at 15, 30 Hz; MJPG 640x480 at 30, 60 Hz|MJPG 640x480 at 30, 60 Hz; YUYV 640x480 at"
        " 15, 30 Hz); (MJPG 1280x720 at 30, 60 Hz; YUYV|YUYV 1280x720 at 10 Hz; MJPG) 1280x720 at",
        str(error.value),
    )


def test_formats_that_cannot_be_read_are_named_apart() -> None:
    camera = Camera(formats={"YUYV": {(320, 240): (30.0,)}, "BA81": {(640, 480): (30.0,)}})
    with pytest.raises(
        CameraError, match=r"Nearest of 1: YUYV 320x240 at 30 Hz .and BA81, which Phalanx does not read"
    ):
        opened(camera)


def test_a_range_of_sizes_and_rates_is_understood() -> None:
    camera = Camera(stepwise=(16, 1920, 2, 16, 1080, 2), formats={"BGR3": {(0, 0): (60.0, 1.0)}})
    offers = read_offers(FakeDevice(camera), (640, 480))
    assert choose_offer(offers, (640, 480), 47.0).rates_hz == (1.0, 60.0)
    with pytest.raises(CameraError, match=r"641x480 at 47 Hz .* BGR3 1920x1080 at 1 to 60 Hz; BGR3 16x16"):
        choose_offer(read_offers(FakeDevice(camera), (641, 480)), (641, 480), 47.0)
    opened(camera, frame_rate_hz=47.0).close()


@pytest.mark.parametrize("name", ["YUYV", "MJPG", "BGR3", "RGB3"])
@pytest.mark.parametrize("padding", [0, 64])
def test_every_format_becomes_the_same_bgr(name: str, padding: int) -> None:
    camera = Camera(formats={name: {(640, 480): (30.0,)}}, padding=padding)
    source = opened(camera)
    for _ in range(3):
        frame = source.read()
        assert frame is not None
        assert frame.image.shape == (480, 640, 3)
        number = frame.seq + 12  # those of the start are not handed over
        exact = name in ("BGR3", "RGB3")
        assert np.abs(frame.image.astype(int) - colour(number)).max() <= (0 if exact else 4)


def test_frames_handed_over_are_never_written_again() -> None:
    source = opened(Camera(formats={"BGR3": {(640, 480): (30.0,)}}))
    frames = [frame for _ in range(3 * BUFFERS) if (frame := source.read()) is not None]
    assert [tuple(frame.image[0, 0]) for frame in frames] == [colour(frame.seq + 12) for frame in frames]


@pytest.mark.parametrize(
    ("flags", "middle_ns"),
    [
        (abi.V4L2.stamp_monotonic | abi.V4L2.stamp_start_of_exposure, 2_500_000),
        (
            abi.V4L2.stamp_monotonic,
            -(480 * 30_000) - 2_500_000,
        ),  # end of frame: all rows and half an exposure earlier
        (abi.V4L2.stamp_start_of_exposure, 2_500_000),  # clock not said: found by its value
    ],
)
def test_a_frame_has_the_time_of_the_middle_of_row_zero(flags: int, middle_ns: int) -> None:
    camera = Camera(stamp_flags=flags)
    frame = opened(camera).read()
    assert frame is not None
    stamp_ns = camera.stamp_zero_ns + round(12 * PERIOD_NS)
    assert abs(frame.t_ns - stamp_ns - middle_ns) < 50_000


def test_a_driver_that_stamps_with_the_wall_clock_is_converted() -> None:
    camera = Camera(stamp_flags=0, stamp_zero_ns=time.time_ns() - 2_000_000_000)
    shift_ns = time.monotonic_ns() - time.time_ns()
    frame = opened(camera).read()
    assert frame is not None
    assert (
        abs(frame.t_ns - (camera.stamp_zero_ns + shift_ns + round(12 * PERIOD_NS) - 16_900_000)) < 1_000_000
    )
    with pytest.raises(CameraError, match="on no known clock"):
        opened(Camera(stamp_flags=0, stamp_zero_ns=0))


def test_lost_and_damaged_frames_are_gaps_in_seq() -> None:
    camera = Camera(skip=frozenset({14, 15}), damaged=frozenset({17}), cut=frozenset({19}))
    source = opened(camera)
    assert [frame.seq for _ in range(6) if (frame := source.read()) is not None] == [0, 1, 4, 6, 8, 9]
    assert source.broken == 2


def test_a_cut_jpeg_is_damaged() -> None:
    camera = Camera(cut=frozenset({13}))
    source = opened(camera, frame_rate_hz=60.0)
    assert [frame.seq for _ in range(2) if (frame := source.read()) is not None] == [0, 2]


def test_a_driver_that_does_not_count_is_counted_for() -> None:
    source = opened(Camera(counts=False))
    assert [frame.seq for _ in range(3) if (frame := source.read()) is not None] == [0, 1, 2]


def test_a_late_reader_gets_the_newest_frame_and_the_others_count_as_dropped() -> None:
    camera = Camera()
    source = opened(camera)
    assert source.read() is not None
    camera.queue = 3
    frame = source.read()
    assert frame is not None
    assert frame.seq == 3
    assert np.abs(frame.image[0, 0].astype(int) - colour(15)).max() <= 4


def test_frames_that_waited_while_nobody_read_are_thrown_away() -> None:
    camera = Camera()
    source = opened(camera)
    assert source.read() is not None
    camera.queue = 1000  # a long while: the first four fill the buffers, then the camera finds none
    device = source._device
    assert isinstance(device, FakeDevice)
    device.wait(1.0)
    camera.queue = 1
    frame = source.read()
    assert frame is not None
    assert frame.seq > 990
    assert source.broken == 0


def test_a_camera_slower_than_asked_is_refused() -> None:
    with pytest.raises(CameraError, match="wanted 30, frames come at 15 Hz; an exposure of 5000 us"):
        opened(Camera(real_rate_hz=15.0))


def test_an_unplugged_and_a_silent_camera_are_errors() -> None:
    camera = Camera(gone_after=14)
    source = opened(camera)
    assert source.read() is not None
    with pytest.raises(CameraError, match="gone: No such device"):
        source.read()
    source.close()
    source.close()
    assert camera.closed == 1
    assert source.read() is None
    source = opened(Camera(silent_after=12))
    with pytest.raises(CameraError, match="no frame for 2 s; check its cable"):
        source.read()


def test_a_device_that_is_no_camera_is_refused() -> None:
    with pytest.raises(CameraError, match="no single-planar capture device"):
        opened(Camera(capabilities=0x00A00000))


def test_an_absent_device_is_an_error_with_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="is it plugged in"):
        V4l2Camera(calibration(), V4l2Options(tmp_path / "video9"), SystemClock())
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(CameraError, match="cannot be started: Inappropriate ioctl"):
        V4l2Camera(calibration(), V4l2Options(tmp_path / "file"), SystemClock())


def test_a_frame_of_too_few_bytes_or_another_size_is_no_image() -> None:
    yuyv = Layout(Pixels.COLOUR, "YUYV", (64, 48), 128)
    data = memoryview(encode("YUYV", (64, 48), 128, 0))
    assert yuyv.image(data) is not None
    assert yuyv.image(data[:-1]) is None
    whole = Layout(Pixels.COLOUR, "MJPG", (32, 48), 0)
    jpeg = memoryview(cv2.imencode(".jpg", np.zeros((48, 32, 3), np.uint8))[1].tobytes())
    assert Layout(Pixels.COLOUR, "MJPG", (64, 48), 0).image(jpeg) is None
    assert whole.image(jpeg) is not None
    for kept in (10, len(jpeg) // 2, len(jpeg) - 2):
        assert whole.image(jpeg[:kept]) is None


def real_devices() -> list[Path]:
    return sorted(Path("/dev").glob("video*"))


def test_a_real_camera_delivers_frames_with_all_settings_checked() -> None:
    """With vivid (`modprobe vivid`) or a USB camera; its maker's codes stay as they are."""
    if not real_devices():
        pytest.skip(
            "no /dev/video* here: streaming, kernel time stamps and read-back of a real V4L2 device are not "
            "tested on this machine (load the kernel module vivid)"
        )
    path = Path(os.environ.get("PHALANX_V4L2", str(real_devices()[0])))
    device = abi.KernelDevice(path)
    offers = [
        offer for offer in read_offers(device, (640, 480)) if offer.size == (640, 480) and offer.rates_hz
    ]
    controls = read_controls(device)
    device.close()
    if not offers:
        pytest.skip(f"{path} has no size of 640x480, so nothing was tested on it")
    rate_hz = max(rate for offer in offers for rate in offer.rates_hz if rate <= 60.0)
    codes = ("gain", "white_balance_temperature", "red_balance", "blue_balance", "focus_absolute")
    given = {
        name: controls[name].nearest(0.5 * (controls[name].low + controls[name].high))
        for name in codes
        if name in controls
    }
    if (
        "timestamp_source" in controls
    ):  # vivid: "end of frame" would be nine tenths of a frame after the hand-over
        given["timestamp_source"] = 1  # start of exposure
    needs = ("exposure", "gain", "white_balance")
    clock = SystemClock()
    camera = V4l2Camera(
        calibration(frame_rate_hz=rate_hz), V4l2Options(path, given, allow_missing=needs), clock
    )
    frames = [frame for _ in range(30) if (frame := camera.read()) is not None]
    camera.close()
    assert len(frames) == 30
    assert frames[0].image.shape == (480, 640, 3)
    steps = np.diff([frame.t_ns for frame in frames]) / np.diff([frame.seq for frame in frames])
    assert abs(np.median(steps) * rate_hz * 1e-9 - 1.0) < 0.1
    assert all(
        -2_500_000 <= frame.ready_t_ns - frame.t_ns < 1_000_000_000 for frame in frames
    )  # vivid exposes 0 us
    again = V4l2Camera(
        calibration(frame_rate_hz=rate_hz), V4l2Options(path, given, allow_missing=needs), clock
    )
    assert again.read() is not None, "given back, and opened again"
    again.close()


@pytest.mark.parametrize(("parameter", "sigma_ns"), [("0\n", 1.2e6), ("1\n", 0.3e6), (None, 1.2e6)])
def test_a_usb_stamp_says_how_far_it_scatters(
    parameter: str | None, sigma_ns: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "hwtimestamps"
    if parameter is not None:
        path.write_text(parameter)
    monkeypatch.setattr("slave.cameras.v4l2.USB_CLOCK", path)
    frame = opened(Camera()).read()
    assert frame is not None
    assert frame.t_sigma_ns == sigma_ns
