"""Settings of one open V4L2 camera.

They are written and checked at the start; the exposure is changed while frames are read.

A change comes from another thread than the loop's. It writes the control, lets some frames pass and reads everything
back. Gain and white balance are codes of the camera's maker, given by `--control`: they stay as they are.
"""

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

from common.calibration import CameraCalibration
from common.errors import CameraError
from slave.cameras.grey import Pixels
from slave.cameras.settings import FrameObserver, change, demand, differences
from slave.cameras.v4l2_abi import Device
from slave.cameras.v4l2_controls import (
    AUTOMATICS,
    EXPOSURE,
    EXPOSURE_UNIT_US,
    FILE_KEYS,
    plan,
    read_back,
    read_controls,
    write,
)

TIMEOUT_S = 2.0
SETTLE_FRAMES = 12  # UVC cameras apply settings within a few frames, or fall back
FIX = "Take values that the camera keeps, and see that no other program controls it"
T = TypeVar("T")


class V4l2Settings:
    """Holds the device until `end`, its controls, and what they are to be."""

    def __init__(
        self,
        device: Device,
        camera: CameraCalibration,
        given: Mapping[str, int],
        missing: Iterable[str],
        pixels: Pixels = Pixels.COLOUR,
    ) -> None:
        """Write all settings, before the stream starts.

        Args:
            device: Open.
            camera: The camera file.
            given: Control -> value, from the command line.
            missing: Which of exposure, gain, white_balance the camera may lack.
            pixels: What its frames are.

        Raises:
            CameraError: A control is unknown, out of range, refused, or needed and not given.
            OSError: The device is gone.
        """
        self._device: Device | None = device
        self._given, self._missing, self._pixels = given, tuple(missing), pixels
        self._controls = read_controls(device)
        self._wanted = plan(camera, self._controls, given, self._missing, pixels)
        self._asking = threading.Lock()  # the device is not closed while another thread asks it
        write(device, self._controls, self._wanted)

    def __len__(self) -> int:
        """How many settings there are."""
        return len(self._wanted)

    def check(self, settle: Callable[[], None]) -> None:
        """Compare all settings once the stream runs.

        A camera that fell back to its own values gets them once more.

        Args:
            settle: Lets some frames pass.

        Raises:
            CameraError: A setting differs; it is named with wanted and got.
            OSError: The device is gone.
        """
        assert self._device is not None  # `end` comes later
        if differences(self._wanted, read_back(self._device, self._controls, self._wanted)):
            write(self._device, self._controls, self._wanted)
            settle()
        demand("it", self._wanted, read_back(self._device, self._controls, self._wanted), FIX)

    def tune(
        self, old: CameraCalibration, new: CameraCalibration, frames: FrameObserver[tuple[int, int]]
    ) -> None:
        """Change the exposure of the running camera; see `Tunable.tune`.

        Args:
            old: The settings it has.
            new: Those it is to have.
            frames: What the loop reads meanwhile.

        Raises:
            CameraError: It cannot, did not take it, or no frames are read; or `new` has another gain or white balance.
        """
        fixed = [FILE_KEYS["gain"], FILE_KEYS["white_balance"]]
        if changed := [key for key in fixed if getattr(new, key) != getattr(old, key)]:
            raise CameraError(
                f"{' and '.join(changed)} cannot be changed: with a USB camera they are codes of its maker, fixed at "
                "the start by --control"
            )
        if EXPOSURE not in self._controls:
            raise CameraError("exposure_us cannot be changed: the camera has no control for it")
        change(lambda camera: self._apply(camera, frames), old, new)

    def metrics(self) -> dict[str, float]:
        """Exposure and codes as the camera has them now; nothing where it is gone."""
        shown = [setting for setting in self._wanted if setting.name not in AUTOMATICS]
        try:
            got = self.ask(lambda device: read_back(device, self._controls, shown))
        except CameraError:  # the loop will report it
            return {}
        found = {f"control.{name}"[:64]: float(value) for name, value in got.items() if name != EXPOSURE}
        if EXPOSURE in got:
            found["exposure_us"] = got[EXPOSURE] * EXPOSURE_UNIT_US
        return found

    def end(self) -> None:
        """Ask the device no more; waits for a question under way."""
        with self._asking:
            self._device = None

    def _apply(self, camera: CameraCalibration, frames: FrameObserver[tuple[int, int]]) -> None:
        period_us = 1e6 / camera.frame_rate_hz
        if camera.exposure_us >= period_us:
            raise CameraError(
                f"exposure_us {camera.exposure_us:g} does not fit into a frame of {period_us:.0f} us"
            )
        controls = self._controls
        wanted = plan(camera, controls, self._given, self._missing, self._pixels)
        exposure = [setting for setting in wanted if setting.name == EXPOSURE]
        self.ask(lambda device: write(device, controls, exposure))
        for _ in frames.following(SETTLE_FRAMES, TIMEOUT_S):
            pass
        demand("it", wanted, self.ask(lambda device: read_back(device, controls, wanted)), FIX)
        self._wanted = wanted

    def ask(self, question: Callable[[Device], T]) -> T:
        """What the open device answers, from any thread.

        Raises:
            CameraError: It is closed or gone, or what the question raises.
        """
        with self._asking:
            if self._device is None:
                raise CameraError("it was closed meanwhile")
            try:
                return question(self._device)
            except OSError as error:
                raise CameraError(f"it cannot be asked: {error.strerror}") from error
