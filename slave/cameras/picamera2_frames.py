"""When a frame of a Pi camera was taken, its number, and its small image.

libcamera documents `SensorTimestamp` as the time at which row 0 is exposed, on the boot clock. The kernel's receivers
(bcm2835-unicam, rp1-cfe) take it, with `ktime_get_ns`, the monotonic clock, when the frame starts to arrive: a row is
read out when its exposure *ends* (picamera2 issue 821; picamera2's own `flush` subtracts the exposure). So the middle
of the exposure of row 0 is `SensorTimestamp` - `ExposureTime` / 2. `FrameWallClock` is the same moment after a
regression from the boot clock to the wall clock (libcamera's ClockRecovery); it follows a stepped wall clock only
slowly, and is used only where there is no `SensorTimestamp`.

How far a stamp scatters. Between the interrupt and the reading of the clock lies the interrupt's latency: under load
up to 50 to 200 us on a Pi with the usual kernel, mostly 10 to 30 us; and the first byte leaves the sensor within two
rows (some 40 us) of the end of the exposure. 50 us cover both. The regression behind `FrameWallClock` follows the wall
clock to about a millisecond.

The library has no frame number that counts what the sensor dropped. Frames come at a fixed duration, so the number
follows from the time.
"""

import math
from collections.abc import Mapping
from math import hypot
from typing import Any

import numpy as np
import numpy.typing as npt

from common.arrays import Image
from common.clock import Clock
from common.errors import CameraError
from slave.cameras.stamps import ForeignClock, clock_of, system_clock

SIGMA_NS: Mapping[str, float] = {"SensorTimestamp": 50e3, "FrameWallClock": 1e6}  # standard deviations
MICROSECONDS_BELOW = 10**17  # wall clock: such a number of ns would be 1973, so it is in us


class Timeline:
    """Number and time of each frame from its metadata.

    Holds the conversion of the camera's clock, and number and time of the last frame.
    """

    def __init__(self, frame_rate_hz: float, clock: Clock) -> None:
        """Begin with number 0; times are on `clock`."""
        self._rate_hz = frame_rate_hz
        self._clock = clock
        self._stamps: tuple[str, ForeignClock] | None = None  # of which key in the metadata
        self._last: tuple[int, int] | None = None

    @property
    def sigma_ns(self) -> float:
        """Standard deviation of the last time [ns]; 0 before the first."""
        return 0.0 if self._stamps is None else hypot(SIGMA_NS[self._stamps[0]], self._stamps[1].sigma_ns)

    def place(self, metadata: Mapping[str, object]) -> tuple[int, int] | None:
        """Number, and middle of the exposure of row 0 [ns], of the next frame; None for a frame without a time.

        Raises:
            CameraError: Its time is on no clock of this machine.
        """
        t_ns = self._row_zero_ns(metadata)
        if t_ns is None:
            return None
        self._last = (self._number(t_ns, metadata), t_ns)
        return self._last

    def _row_zero_ns(self, metadata: Mapping[str, object]) -> int | None:
        key = "SensorTimestamp" if "SensorTimestamp" in metadata else "FrameWallClock"
        stamp, exposure = metadata.get(key), metadata.get("ExposureTime")
        # Under load the receiver of Pi 4 and older can deliver a frame with time 0 (raspberrypi/linux 5118).
        if not isinstance(stamp, int) or stamp <= 0 or not isinstance(exposure, (int, float)):
            return None
        if key == "FrameWallClock" and stamp < MICROSECONDS_BELOW:
            stamp *= 1000
        if self._stamps is None or self._stamps[0] != key:
            name = clock_of(stamp)
            if name is None:
                raise CameraError(f"{key} {stamp} ns is on no clock of this machine")
            self._stamps = (key, ForeignClock(self._clock, system_clock(name)))
        return self._stamps[1].to_own(stamp) - round(exposure * 500.0)

    def _number(self, t_ns: int, metadata: Mapping[str, object]) -> int:
        """As many further than the last one as whole frame durations have passed."""
        if self._last is None:
            return 0
        seq, before_ns = self._last
        duration = metadata.get("FrameDuration")
        period_us = 1e6 / self._rate_hz
        if isinstance(duration, (int, float)) and duration > 0:
            period_us = float(duration)
        return seq + max(1, math.floor((t_ns - before_ns) / (period_us * 1e3) + 0.5))


def without_padding(image: npt.NDArray[Any], width: int, height: int) -> Image:
    """Planar YUV420 (3 height / 2, width) uint8 from an array whose rows are padded to the stride.

    picamera2 hands out (3 height / 2, stride): rows of Y, then those of U and of V, two of which lie in one row of
    the array, each half a stride long (`CompletedRequest.save` in picamera2 0.3.38).

    Raises:
        RuntimeError: The array has another shape.
    """
    stride = image.shape[1]
    if image.shape[0] != height * 3 // 2 or stride < width or stride % 2:
        raise RuntimeError(f"a small frame is {image.shape}, not ({height * 3 // 2}, at least {width})")
    luma = image[:height, :width]
    chroma = image[height:].reshape(height, stride // 2)[:, : width // 2]
    return (
        np.concatenate([luma.ravel(), chroma.ravel()])
        .reshape(height * 3 // 2, width)
        .astype(np.uint8, copy=False)
    )
