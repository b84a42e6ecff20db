"""USB camera through OpenCV, where the kernel is not Linux: macOS and Windows.

Linux has a driver of its own (`v4l2`), which sets more and knows when a frame was taken. Here a frame has no stamp: it
was taken between one and two frame periods before it arrives, as USB cameras send what they have exposed, and OpenCV
hands on what was sent; `t_sigma_ns` says so. Exposure is in powers of two of a second on Windows (DirectShow,
`CameraControl_Exposure`); macOS lets no program set it through OpenCV. What the camera file wants and a system does not
set must be allowed by `--allow-missing`. Everything that is set is read back. No camera on such a system was tried.
"""

import sys
from collections.abc import Mapping
from itertools import pairwise
from math import log2, sqrt
from statistics import median

import cv2
import numpy as np

from common.arrays import Image
from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError
from slave.cameras.grey import Pixels
from slave.cameras.settings import Setting, demand
from slave.sources import Frame

_SYSTEMS = {"win32": cv2.CAP_DSHOW, "darwin": cv2.CAP_AVFOUNDATION}  # by `sys.platform`
_CODES = {
    "gain": cv2.CAP_PROP_GAIN,
    "white_balance_temperature": cv2.CAP_PROP_WB_TEMPERATURE,
    "focus_absolute": cv2.CAP_PROP_FOCUS,
    "brightness": cv2.CAP_PROP_BRIGHTNESS,
}
_AUTOMATICS = {"automatic white balance": cv2.CAP_PROP_AUTO_WB, "automatic focus": cv2.CAP_PROP_AUTOFOCUS}
# What the file wants -> the control whose code decides it
_NEEDS = {"gain": "gain", "white_balance": "white_balance_temperature"}


class OpencvCamera:
    """A `FrameSource` of a camera by its number."""

    def __init__(
        self,
        calibration: CameraCalibration,
        index: int,
        codes: Mapping[str, int],
        allow_missing: tuple[str, ...],
        clock: Clock,
        pixels: Pixels = Pixels.COLOUR,
        platform: str = sys.platform,
    ) -> None:
        """Open and configure the camera, and check what it really does."""
        self._calibration, self._clock = calibration, clock
        self._where = f"camera {calibration.name!r} (opencv:{index})"
        self._seq, self._last_ns = -1, 0
        if platform not in _SYSTEMS:
            raise CameraError(
                f"{self._where}: is for macOS and Windows; here it is --camera v4l2:/dev/video{index}"
            )
        if pixels is not Pixels.COLOUR:
            raise CameraError(f"{self._where}: a wrist device needs --camera v4l2 or picamera2")
        self._capture: cv2.VideoCapture | None = (capture := cv2.VideoCapture(index, _SYSTEMS[platform]))
        try:
            if not capture.isOpened():
                raise CameraError("cannot be opened: is it plugged in, and no other program has it?")
            self._set(capture, codes, allow_missing, exposes=platform == "win32")
            self._settle(capture)
        except CameraError as error:
            self.close()
            raise CameraError(f"{self._where}: {error}") from error

    def read(self) -> Frame | None:
        """Wait for the next frame; None once closed."""
        if self._capture is None:
            return None
        image = self._next(self._capture)
        camera, ready_ns = self._calibration, self._clock.now_ns()
        period_ns = 1e9 / camera.frame_rate_hz
        # A gap of one frame and a half is one that was dropped; OpenCV has no numbers.
        passed = 1 if self._seq < 0 else max(1, round((ready_ns - self._last_ns) / period_ns))
        self._seq, self._last_ns = self._seq + passed, ready_ns
        rows_ns = camera.height_px * camera.row_time_us * 1e3
        t_ns = ready_ns - round(1.5 * period_ns + rows_ns - 500.0 * camera.exposure_us)
        sigma_ns = period_ns / sqrt(12.0)
        return Frame(self._seq, t_ns, ready_ns, image, t_sigma_ns=sigma_ns, exposure_us=camera.exposure_us)

    def close(self) -> None:
        """Give the device back. Safe to call twice."""
        capture, self._capture = self._capture, None
        if capture is not None:
            capture.release()

    def _next(self, capture: cv2.VideoCapture) -> Image:
        arrived, image = capture.read()
        if not arrived:
            raise CameraError(f"{self._where}: gone: no frame comes; check its cable")
        return np.asarray(image, np.uint8)

    def _set(
        self, capture: cv2.VideoCapture, codes: Mapping[str, int], missing: tuple[str, ...], *, exposes: bool
    ) -> None:
        camera, wanted, got = self._calibration, list[Setting](), dict[str, object]()

        def want(name: str, number: int, value: float, source: str) -> None:
            capture.set(number, value)
            wanted.append(Setting(name, (value,), 0.0, "", source))
            got[name] = capture.get(number)

        want("width_px", cv2.CAP_PROP_FRAME_WIDTH, camera.width_px, "camera file")
        want("height_px", cv2.CAP_PROP_FRAME_HEIGHT, camera.height_px, "camera file")
        # What a driver says of its rate is not always true: it is measured.
        capture.set(cv2.CAP_PROP_FPS, camera.frame_rate_hz)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        for name, number in _AUTOMATICS.items():
            if capture.get(number) > 0.0:
                want(name, number, 0.0, "every automatic is off")
        if not exposes and "exposure" not in missing:
            raise CameraError(
                "exposure_us: this system sets none; --allow-missing exposure takes its automatic"
            )
        if "exposure" not in missing:
            manual = 0.0
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, manual)
            code = round(log2(camera.exposure_us * 1e-6))
            made_us, share = 1e6 * 2.0**code, 0.05
            if abs(made_us / camera.exposure_us - 1.0) > share:
                raise CameraError(
                    f"exposure_us {camera.exposure_us:g}: the nearest is {made_us:g}; write that"
                )
            want("exposure", cv2.CAP_PROP_EXPOSURE, code, f"exposure_us {camera.exposure_us:g}")
        if unknown := sorted({*codes} - {*_CODES}):
            raise CameraError(f"--control {unknown[0]}: not one of {', '.join(_CODES)}")
        for key, control in _NEEDS.items():
            if control not in codes and key not in missing:
                raise CameraError(
                    f"{key}: give its code, --control {control}=NUMBER, or --allow-missing {key}"
                )
        for control, code in codes.items():
            want(control, _CODES[control], code, f"--control {control}={code}")
        demand("the camera", wanted, got, "Another camera may: see docs/cameras.md")

    def _settle(self, capture: cv2.VideoCapture) -> None:
        """Take some frames, and see that they come at the rate that was asked for."""
        frames, of_before, share = 12, 4, 0.1  # a camera that halves its rate for the light is out by 1/2
        times: list[int] = []
        for _ in range(frames):
            self._next(capture)
            times.append(self._clock.now_ns())
        step_ns = median(later - one for one, later in pairwise(times[of_before:]))
        got_hz, rate_hz = 1e9 / max(step_ns, 1), self._calibration.frame_rate_hz
        if abs(got_hz - rate_hz) > share * rate_hz:
            raise CameraError(f"frame_rate_hz: wanted {rate_hz:g}, frames come at {got_hz:.4g} Hz")
