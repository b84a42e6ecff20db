"""USB cameras through OpenCV: set and read back on a stand-in of `cv2.VideoCapture`, as DirectShow behaves."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration
from common.errors import CameraError
from slave.cameras.grey import Pixels
from slave.cameras.opencv import OpencvCamera
from tests.network_helpers import ManualClock

FILE = CameraCalibration(1, "left", 64, 48, 30.0, 7812.5, 1.0, (1.0, 1.0), 20.0)
CODES = {"gain": 12, "white_balance_temperature": 4600}
PERIOD_NS = 33_333_333


class Device:
    """A camera: what it holds, what it does not take, and when frames come."""

    def __init__(
        self, clock: ManualClock, period_ns: int = PERIOD_NS, keeps: Mapping[int, float] | None = None
    ):
        self.clock, self.period_ns, self.keeps = clock, period_ns, keeps or {}
        self.values = {cv2.CAP_PROP_AUTO_WB: 1.0, cv2.CAP_PROP_AUTOFOCUS: 0.0} | dict(self.keeps)
        self.there, self.released, self.frames = True, False, 0
        self.opened: tuple[int, int] | None = None

    def __call__(self, index: int, api: int) -> "Device":
        self.opened = index, api
        return self

    def isOpened(self) -> bool:
        return self.there

    def set(self, number: int, value: float) -> bool:
        self.values[number] = self.keeps.get(number, float(value))
        return number not in self.keeps

    def get(self, number: int) -> float:
        return self.values.get(number, -1.0)

    def read(self) -> tuple[bool, Image]:
        self.clock.t_ns += self.period_ns
        self.frames += 1
        return self.there, np.full((48, 64, 3), self.frames, np.uint8)

    def release(self) -> None:
        self.released = True


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock(10**9)


def opened(
    device: Device,
    monkeypatch: pytest.MonkeyPatch,
    file: CameraCalibration = FILE,
    codes: Mapping[str, int] = CODES,
    missing: tuple[str, ...] = (),
    platform: str = "win32",
    pixels: Pixels = Pixels.COLOUR,
) -> OpencvCamera:
    monkeypatch.setattr("slave.cameras.opencv.cv2.VideoCapture", device)
    return OpencvCamera(file, 1, codes, missing, device.clock, pixels, platform)


def test_everything_is_set_and_automatics_are_off(
    clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = Device(clock)
    opened(device, monkeypatch)
    assert device.opened == (1, cv2.CAP_DSHOW)
    assert device.values[cv2.CAP_PROP_EXPOSURE] == -7.0  # 2**-7 s
    assert device.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 0.0
    assert device.values[cv2.CAP_PROP_AUTO_WB] == 0.0
    assert (device.values[cv2.CAP_PROP_GAIN], device.values[cv2.CAP_PROP_WB_TEMPERATURE]) == (12.0, 4600.0)


def test_a_frame_was_taken_before_it_came(clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Device(clock)
    camera = opened(device, monkeypatch)
    first, second = camera.read(), camera.read()
    device.clock.t_ns += 2 * PERIOD_NS  # two are lost
    third = camera.read()
    assert first is not None
    assert second is not None
    assert third is not None
    assert [first.seq, second.seq, third.seq] == [0, 1, 4]
    assert first.ready_t_ns - first.t_ns == pytest.approx(50e6 + 48 * 20e3 - 0.5 * 7812.5e3, abs=2)
    assert first.t_sigma_ns == pytest.approx(9.6e6, rel=0.01)
    assert first.image[0, 0, 0] + 1 == second.image[0, 0, 0]
    camera.close()
    camera.close()
    assert device.released
    assert camera.read() is None


def test_a_camera_that_is_gone_is_an_error(clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Device(clock)
    camera = opened(device, monkeypatch)
    device.there = False
    with pytest.raises(CameraError, match="gone"):
        camera.read()


REFUSED: dict[str, tuple[dict[str, Any], dict[int, float], str]] = {
    "an exposure between two steps": ({"file": replace(FILE, exposure_us=5000.0)}, {}, "nearest is 3906.25"),
    "an exposure that is not taken": ({}, {cv2.CAP_PROP_EXPOSURE: -6.0}, "exposure: wanted -7.* got -6"),
    "an automatic that stays on": ({}, {cv2.CAP_PROP_AUTO_WB: 1.0}, "automatic white balance: wanted 0"),
    "another size": ({}, {cv2.CAP_PROP_FRAME_WIDTH: 640.0}, "width_px: wanted 64.* got 640"),
    "no code of the gain": ({"codes": {"white_balance_temperature": 1}}, {}, "--control gain=NUMBER"),
    "an unknown control": ({"codes": CODES | {"gian": 1}}, {}, "--control gian: not one of gain"),
    "exposure on macOS": ({"platform": "darwin"}, {}, "--allow-missing exposure"),
    "Linux": ({"platform": "linux"}, {}, "--camera v4l2:/dev/video1"),
    "a wrist device": ({"pixels": Pixels.GREY}, {}, "wrist device needs"),
    "half of the rate": ({"file": replace(FILE, frame_rate_hz=60.0)}, {}, "wanted 60, frames come at 30 Hz"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_as_the_file_says_is_refused_and_given_back(
    case: str, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    how, keeps, text = REFUSED[case]
    device = Device(clock, keeps=keeps)
    with pytest.raises(CameraError, match=text):
        opened(device, monkeypatch, **how)
    assert device.released == (device.opened is not None)


def test_macos_with_its_automatic_allowed(clock: ManualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Device(clock)
    opened(device, monkeypatch, codes={}, missing=("exposure", "gain", "white_balance"), platform="darwin")
    assert device.opened == (1, cv2.CAP_AVFOUNDATION)
    assert cv2.CAP_PROP_EXPOSURE not in device.values
