"""From `--camera` to an open camera: options, their owners, and a camera that comes back."""

import argparse
import sys
import threading
from typing import Any

import pytest

from common.calibration import CameraCalibration
from common.clock import SystemClock
from common.errors import CameraError
from slave.cameras.grey import Pixels
from slave.cameras.v4l2 import V4l2Camera, V4l2Options
from slave.cli.options import add_camera
from slave.commands import devices
from slave.reconnect import ReconnectingCamera
from slave.sources import FrameSource
from tests.slave.fake_picamera2 import Sensor, install
from tests.slave.fake_v4l2 import Camera, FakeDevice
from tests.slave.stand_ins import camera_file

CALIBRATION = camera_file()


def opened(driver: str, *arguments: str, wrist: bool = False) -> FrameSource | None:
    parser = argparse.ArgumentParser()
    add_camera(parser)
    options = parser.parse_args(arguments)
    return devices.open_camera(driver, options, CALIBRATION, SystemClock(), threading.Event(), wrist=wrist)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[V4l2Options]:
    """What the V4L2 driver is asked for; its devices are fakes."""
    options: list[V4l2Options] = []

    def make(calibration: CameraCalibration, asked: V4l2Options, clock: Any) -> V4l2Camera:
        options.append(asked)
        return V4l2Camera(calibration, asked, clock, lambda _path: FakeDevice(Camera()))

    monkeypatch.setattr("slave.cameras.v4l2.V4l2Camera", make)
    return options


@pytest.mark.parametrize(
    ("driver", "path"),
    [
        ("v4l2", "/dev/video0"),
        ("v4l2:2", "/dev/video2"),
        ("v4l2:/dev/v4l/by-id/usb-cam:1", "/dev/v4l/by-id/usb-cam:1"),
    ],
)
def test_a_usb_camera_is_named_by_number_or_path(seen: list[V4l2Options], driver: str, path: str) -> None:
    source = opened(driver, "--control", "gain=32", "--control", "white_balance_temperature=4600")
    assert isinstance(source, ReconnectingCamera)
    assert source.read() is not None
    source.close()
    assert str(seen[0].path) == path
    assert seen[0].controls == {"gain": 32, "white_balance_temperature": 4600}


def test_the_camera_of_a_wrist_device_is_grey_and_luma_only_by_name(seen: list[V4l2Options]) -> None:
    codes = ("--control", "gain=32", "--control", "white_balance_temperature=4600")
    with pytest.raises(CameraError, match=r"MJPG, YUYV, which are not grey; .* --luma takes the luma"):
        opened("v4l2", *codes, wrist=True)
    source = opened("v4l2", *codes, "--luma", wrist=True)
    assert source is not None
    frame = source.read()
    source.close()
    assert frame is not None
    assert frame.image.shape == (480, 640)
    assert [options.pixels for options in seen] == [Pixels.GREY, Pixels.LUMA]


def test_without_a_stop_a_lost_camera_is_an_error(seen: list[V4l2Options]) -> None:
    parser = argparse.ArgumentParser()
    add_camera(parser)
    options = parser.parse_args(["--control", "gain=32", "--control", "white_balance_temperature=4600"])
    source = devices.open_camera("v4l2", options, CALIBRATION, SystemClock(), None)
    assert isinstance(source, V4l2Camera)
    source.close()
    assert len(seen) == 1


def test_a_pi_camera_is_named_by_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = install(monkeypatch, Sensor())
    source = opened("picamera2", "--sync", "client")
    assert source is not None
    assert source.read() is not None
    source.close()
    assert sensor.opened[0].config["controls"]["SyncMode"] == 2
    with pytest.raises(CameraError, match="no such camera"):
        opened("picamera2:1")
    with pytest.raises(CameraError, match="the part behind the colon is a number"):
        opened("picamera2:left")


def test_other_drivers_are_not_its_business() -> None:
    assert opened("synthetic") is None
    assert opened("replay:folder") is None


@pytest.mark.parametrize(
    ("driver", "arguments", "expected"),
    [
        ("v4l2", ("--sync", "server"), "--sync is an option of --camera picamera2"),
        ("picamera2", ("--control", "gain=1"), "--control is an option of --camera v4l2"),
        (
            "synthetic",
            ("--sync-timeout", "5"),
            "--sync-timeout is an option of --camera picamera2, not of synthetic",
        ),
        ("synthetic", ("--allow-missing", "gain"), "--allow-missing is an option of --camera v4l2"),
        ("synthetic", ("--luma",), "--luma is an option of --camera picamera2 and v4l2, not of synthetic"),
        ("v4l2", ("--luma",), "this rig looks for painted markers, by colour"),
        ("v4l2", ("--control", "gain"), "write NAME=NUMBER"),
        ("v4l2", ("--control", "gain=1", "--control", "gain=2"), "--control gain is given twice"),
    ],
)
def test_an_option_that_would_be_ignored_is_refused(
    driver: str, arguments: tuple[str, ...], expected: str
) -> None:
    with pytest.raises(CameraError, match=expected):
        opened(driver, *arguments)


def test_a_missing_camera_at_the_start_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(CameraError, match="apt install python3-picamera2"):
        opened("picamera2")
    with pytest.raises(CameraError, match="cannot be opened"):
        opened("v4l2:/dev/there-is-none")


def test_an_unplugged_camera_comes_back_with_all_its_settings() -> None:
    first, second = Camera(gone_after=15), Camera()
    plugged = [first, second]
    asked = V4l2Options(controls={"gain": 32, "white_balance_temperature": 4600})
    clock = SystemClock()
    source = ReconnectingCamera(
        lambda file: V4l2Camera(file, asked, clock, lambda _path: FakeDevice(plugged.pop(0))),
        CALIBRATION,
        clock,
        threading.Event(),
        first_s=0.001,
    )
    seqs = [frame.seq for _ in range(6) if (frame := source.read()) is not None]
    assert len(seqs) == 6
    assert seqs == sorted(set(seqs)), "the numbers keep rising"
    assert source.counts()["camera.lost"] == 1
    assert (second.knob("Gain").value, second.knob("Exposure Time").value) == (32, 50)
    source.close()
    assert (first.closed, second.closed) == (1, 1)


def test_a_lost_grey_camera_comes_back_grey() -> None:
    formats = {"Y10P": {(640, 480): (30.0,)}}
    plugged = [Camera(formats=formats, gone_after=14, padding=16), Camera(formats=formats, padding=16)]
    asked = V4l2Options(controls={"gain": 32, "white_balance_temperature": 4600}, pixels=Pixels.GREY)
    clock = SystemClock()
    source = ReconnectingCamera(
        lambda file: V4l2Camera(file, asked, clock, lambda _path: FakeDevice(plugged.pop(0))),
        CALIBRATION,
        clock,
        threading.Event(),
        first_s=0.001,
    )
    shapes = [frame.image.shape for _ in range(4) if (frame := source.read()) is not None]
    source.close()
    assert shapes == [(480, 640)] * 4
    assert source.counts()["camera.lost"] == 1
