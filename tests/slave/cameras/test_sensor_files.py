"""Shipped camera files of real sensors, against what real cameras say of themselves (`tests/slave/recorded_lists.py`).

The table is written by hand: angles and rates are those of the documentation of Raspberry Pi and of the lists.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from common.calibration import CameraCalibration, load
from common.calibration.camera import sensor_files
from common.clock import SystemClock
from common.errors import CameraError
from slave.cameras.grey import Pixels
from slave.cameras.picamera2 import Picamera2Camera
from slave.cameras.picamera2_settings import Picamera2Options
from slave.cameras.v4l2 import V4l2Camera, V4l2Options
from slave.sources import FrameSource
from tests.slave.fake_picamera2 import Sensor, install
from tests.slave.fake_v4l2 import Camera, FakeDevice, webcam_knobs
from tests.slave.recorded_lists import PI_CAMERAS, USB_CAMERAS

ROOT = Path(__file__).resolve().parents[3]
FILES = sensor_files(ROOT / "calib_json")

# File -> cameras that take it, view across [deg], frames a second, row to row of the picture [us].
TABLE: dict[str, tuple[tuple[str, ...], float, float, float]] = {
    "imx219-640x480": (("imx219", "imx219 since 6.6"), 26.5, 90.0, 9.45),
    "imx219-820x616": (("imx219", "imx219 since 6.6"), 62.2, 40.0, 37.8),
    "imx219-820x616-8bit": (("imx219 since 6.6",), 62.2, 80.0, 18.9),
    "imx296-728x544": (("imx296",), 45.4, 60.0, 0.0),
    "imx708-1152x648": (("imx708",), 66.0, 56.0, 26.72),
    "imx708-768x432": (("imx708",), 46.8, 115.0, 18.42),
    "imx708-864x648": (("imx708",), 51.9, 56.0, 26.72),
    "imx708_wide-1152x648": (("imx708_wide",), 99.1, 56.0, 26.72),
    "imx708_wide-864x648": (("imx708_wide",), 82.7, 56.0, 26.72),
    "ov5647-1296x972": (("ov5647", "ov5647 of 2026"), 53.5, 43.0, 21.67),
    "ov5647-640x480": (("ov5647", "ov5647 of 2026"), 52.9, 58.9, 31.75),
    "ov9281-1280x720": (("ov9281", "Spinel OV9281"), 84.9, 120.0, 0.0),
    "ov9281-1280x800": (("ov9281",), 84.9, 120.0, 0.0),
    "ov9281-640x400": (("ov9281",), 84.9, 90.0, 0.0),
    "usb-1280x720": (("USB Camera", "Spinel OV9281"), 70.0, 30.0, 0.0),
    "usb-640x480": (("Logitech C930e", "USB Camera"), 55.0, 30.0, 0.0),
    "usb-global-1280x720": (("Spinel OV9281",), 70.0, 120.0, 0.0),
}
CAMERAS = (*PI_CAMERAS, *USB_CAMERAS)


def opened(monkeypatch: pytest.MonkeyPatch, camera: str, file: CameraCalibration) -> FrameSource:
    """A recorded camera, asked for a file as a slave asks: grey of a monochrome sensor, else colours."""
    if camera in USB_CAMERAS:
        options = V4l2Options(controls={"gain": 32, "white_balance_temperature": 4600})
        fake = Camera(knobs=webcam_knobs(), formats=USB_CAMERAS[camera])
        return V4l2Camera(file, options, SystemClock(), lambda _path: FakeDevice(fake))
    listed = PI_CAMERAS[camera]
    install(monkeypatch, Sensor.of(listed))
    grey = not listed.colours and (file.sensor is None or not file.sensor.colours)
    options = Picamera2Options(pixels=Pixels.GREY if grey else Pixels.COLOUR)
    return Picamera2Camera(file, options, SystemClock())


def test_the_table_has_every_file_and_every_sensor_a_file() -> None:
    assert set(TABLE) == set(FILES)
    taken = {camera for cameras, *_ in TABLE.values() for camera in cameras}
    assert set(CAMERAS) - taken == {"imx296 mono"}, (
        "raw frames of it are 1456x1088 at 60 Hz: no file is shipped"
    )


@pytest.mark.parametrize(("name", "camera"), [(n, c) for n, (cameras, *_) in TABLE.items() for c in cameras])
def test_a_file_opens_on_its_sensor_in_its_mode_at_its_rate(
    monkeypatch: pytest.MonkeyPatch, name: str, camera: str
) -> None:
    file, (_, _, rate_hz, _) = FILES[name], TABLE[name]
    source = opened(monkeypatch, camera, file)
    frames = [frame for _ in range(8) if (frame := source.read()) is not None]
    source.close()
    assert [frame.seq - frames[0].seq for frame in frames] == list(range(8))
    assert all(frame.image.shape[:2] == (file.height_px, file.width_px) for frame in frames)
    period_us = np.diff([frame.t_ns for frame in frames]).mean() * 1e-3
    assert abs(period_us - 1e6 / rate_hz) < 35.0, "a row, at most"


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("name", TABLE)
def test_a_file_of_another_sensor_is_refused_with_the_nearest_modes(
    monkeypatch: pytest.MonkeyPatch, name: str, camera: str
) -> None:
    if camera in TABLE[name][0]:
        return
    with pytest.raises(CameraError) as error:
        opened(monkeypatch, camera, FILES[name]).close()
    if (name, camera) == ("imx296-728x544", "imx296 mono"):
        assert "no control AwbEnable, ColourGains" in str(error.value)
        return
    found = [(int(w), int(h)) for w, h in re.findall(r"(\d+)x(\d+)(?: \d+ bit, up to| at)", near(error))]
    offered = (
        {size for sizes in USB_CAMERAS[camera].values() for size in sizes}
        if camera in USB_CAMERAS
        else {one["size"] for one in PI_CAMERAS[camera].modes}
    )
    assert found
    assert set(found) <= offered
    sensor = FILES[name].sensor
    assert sensor is not None
    if sensor.mode_px in offered:
        assert found[0] == sensor.mode_px


def near(error: pytest.ExceptionInfo[CameraError]) -> str:
    """What an error lists as nearest."""
    (found,) = re.findall(r"Nearest[^:]*: (.*)\. ", str(error.value))
    return found


@pytest.mark.parametrize(
    ("camera", "changes", "nearest"),
    [
        ("ov5647", {"frame_rate_hz": 60.0}, "640x480 10 bit, up to 58.9 Hz, 98 % of the full view"),
        ("ov5647", {"frame_rate_hz": 90.0}, "640x480 10 bit, up to 58.9 Hz"),
        ("imx219", {"width_px": 1640, "height_px": 1232, "frame_rate_hz": 60.0}, "1640x1232 10 bit, up to 41.9 Hz"),
        ("imx219", {"frame_rate_hz": 207.0}, "640x480 10 bit, up to 206.7 Hz, 15 % of the full view"),
        ("imx708", {"frame_rate_hz": 121.0, "focus_m": 0.6}, "1536x864 10 bit, up to 120.1 Hz, 44 % of the full view"),
        ("imx708", {"width_px": 2304, "height_px": 1296, "frame_rate_hz": 60.0}, "2304x1296 10 bit, up to 56.0 Hz"),
        ("imx296", {"frame_rate_hz": 90.0}, "1456x1088 10 bit, up to 60.4 Hz"),
        ("ov9281", {"frame_rate_hz": 90.0}, "640x400 10 bit, up to 247.8 Hz, 100 % of the full view"),
        ("ov9281", {"width_px": 1280, "height_px": 800, "frame_rate_hz": 150.0}, "1280x800 8 bit, up to 143.7 Hz"),
        ("Logitech C930e", {"width_px": 1280, "height_px": 720}, "YUYV 1280x720 at 10 Hz"),
        ("USB Camera", {"frame_rate_hz": 60.0}, "MJPG 640x480 at 5, 10, 15, 20, 25, 30 Hz"),
        ("Spinel OV9281", {"width_px": 1280, "height_px": 720, "frame_rate_hz": 90.0}, "MJPG 1280x720 at 30, 60, 120"),
    ],
)  # fmt: skip
def test_a_mode_that_the_sensor_lacks_is_refused_with_the_nearest_first(
    monkeypatch: pytest.MonkeyPatch, camera: str, changes: dict[str, Any], nearest: str
) -> None:
    plain = replace(FILES["usb-640x480"], sensor=None, colour_gains=(1.0, 1.0), **changes)
    with pytest.raises(CameraError) as error:
        opened(monkeypatch, camera, plain).close()
    assert near(error).startswith(nearest)


@pytest.mark.parametrize("name", TABLE)
def test_a_file_states_no_measurement_and_agrees_with_itself(name: str) -> None:
    file, (_, view_deg, rate_hz, row_us) = FILES[name], TABLE[name]
    sensor = file.sensor
    assert sensor is not None
    assert (file.name, file.intrinsics, file.markers, file.provenance) == (name, None, None, {})
    assert (file.frame_rate_hz, file.row_time_us) == (rate_hz, row_us)
    assert abs(sensor.view_deg[0] - view_deg) < 0.2
    lens, size = sensor.nominal, (file.width_px, file.height_px)
    angles = [
        np.degrees(2.0 * np.arctan(0.5 * n / f)) for n, f in zip(size, (lens.fx_px, lens.fy_px), strict=True)
    ]
    np.testing.assert_allclose(sensor.view_deg, angles, atol=0.1)
    assert abs(size[0] / size[1] - sensor.crop_px[2] / sensor.crop_px[3]) < 0.005, "no stretched picture"
    assert all(picture <= mode for picture, mode in zip(size, sensor.mode_px, strict=True))
    low, high = sensor.exposure_us
    assert low <= file.exposure_us <= high < 1e6 / rate_hz
    assert file.frame_rate_hz <= sensor.max_rate_hz
    assert file.height_px * row_us < 1e6 / rate_hz, "all rows are read before the next frame begins"
    assert {"mode", "row_time_us", "view", "exposure", "sync", "focus"} <= {*sensor.sources, "sync"}
    assert ("motor" in sensor.sources["focus"]) == (file.focus_m is not None) or sensor.driver == "v4l2"


def test_a_view_that_is_not_that_of_the_file_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def zoom(_number: int, metadata: dict[str, Any]) -> None:
        metadata["ScalerCrop"] = (576, 432, 1440, 1080)

    sensor = Sensor.of(PI_CAMERAS["ov5647"])
    sensor.tamper = zoom
    install(monkeypatch, sensor)
    with pytest.raises(
        CameraError, match=r"ScalerCrop: wanted 16, 0, 2560, 1920 px .sensor.crop_px: the view., got 576"
    ):
        Picamera2Camera(FILES["ov5647-640x480"], Picamera2Options(), SystemClock())


def test_the_camera_of_the_shipped_wrist_device_is_a_mode_of_the_ov9281(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = load(ROOT / "calib_json/cameras/wrist.json", CameraCalibration)
    install(monkeypatch, Sensor.of(PI_CAMERAS["ov9281"]))
    source = Picamera2Camera(file, Picamera2Options(pixels=Pixels.GREY), SystemClock())
    frame = source.read()
    source.close()
    assert frame is not None
    assert frame.image.shape == (400, 640)
    sensor = FILES["ov9281-640x400"].sensor
    assert sensor is not None
    assert file.intrinsics is not None
    assert abs(file.intrinsics.fx_px / sensor.nominal.fx_px - 1.0) < sensor.focal_share


@pytest.mark.parametrize("name", TABLE)
def test_the_page_has_the_figures_of_the_files(name: str) -> None:
    page, file = (ROOT / "docs/cameras.md").read_text(), FILES[name]
    (row,) = (line for line in page.splitlines() if line.startswith(f"| `{name}` |"))
    _, _, title, picture, rate, mode, view, row_us, _ = (part.strip() for part in row.split("|"))
    sensor = file.sensor
    assert sensor is not None
    assert (title, picture) == (sensor.title, f"{file.width_px}x{file.height_px}")
    assert rate == f"{file.frame_rate_hz:g}"
    of_mode = f"{sensor.mode_px[0]}x{sensor.mode_px[1]}, {sensor.bits} bit, to {sensor.max_rate_hz:g} Hz"
    assert mode == (of_mode if sensor.bits else "its driver")
    assert view == f"{sensor.view_deg[0]:.0f}° x {sensor.view_deg[1]:.0f}°"
    assert row_us == (
        "not known" if sensor.shutter == "rolling" and not file.row_time_us else f"{file.row_time_us:g}"
    )
