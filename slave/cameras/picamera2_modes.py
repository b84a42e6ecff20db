"""Which mode of the sensor to use: the widest view that reaches the frame rate.

A sensor offers a few modes, each with its own crop of the pixel array and its own highest rate. Faster modes often
see less: the same lens then has a longer focal length in pixels, and a calibration made in another mode is wrong.
So the widest view wins, and how much of the array it shows is said at every start.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from common.errors import CameraError

ROUNDING_HZ = 0.005  # picamera2 rounds rates to two digits
SAME_VIEW = 0.98  # crops that differ by a few rows of alignment show the same
# libcamera's R8, R10_CSI2P, MONO_PISP_COMP1; mosaics are SRGGB10, RGGB_PISP_COMP1 and so on.
MONO = re.compile(r"R\d|MONO")
FACTS = (
    "Known cameras: Camera v1 (OV5647) 58.9 Hz at 640x480 with the full view; v2 (IMX219) 41.9 Hz with the full view, "
    "206 Hz only from a centre crop of 26 degrees; v3 (IMX708) 56 Hz with the full view, 120 Hz at 1536x864 from two "
    "thirds of it; Global Shutter (IMX296) 60 Hz with the full view"
)


@dataclass(frozen=True, slots=True)
class SensorMode:
    """One mode.

    Attributes:
        size: Width and height of what the sensor delivers [px].
        bit_depth: Bits of one raw value.
        rate_hz: Highest frame rate [Hz].
        crop: x, y, width and height on the pixel array [px of the array].
        mono: Whether the sensor has no colour filters.
    """

    size: tuple[int, int]
    bit_depth: int
    rate_hz: float
    crop: tuple[int, int, int, int]
    mono: bool = False

    @property
    def area(self) -> int:
        """Pixels of the array that the mode sees."""
        return self.crop[2] * self.crop[3]

    def text(self, widest: int) -> str:
        """The mode in words; `widest` is the area of the widest mode."""
        width, height = self.size
        share = 100.0 * self.area / widest
        return f"{width}x{height} {self.bit_depth} bit, up to {self.rate_hz:.1f} Hz, {share:.0f} % of the full view"


def read_modes(modes: Sequence[Mapping[str, Any]]) -> tuple[SensorMode, ...]:
    """Modes from `Picamera2.sensor_modes`; a camera without raw modes (USB) gives none."""
    return tuple(
        SensorMode(
            tuple(mode["size"]),
            int(mode["bit_depth"]),
            float(mode["fps"]),
            tuple(mode["crop_limits"]),
            mono=MONO.match(str(mode["format"])) is not None,
        )
        for mode in modes
        if "crop_limits" in mode
    )


def choose_mode(modes: Sequence[SensorMode], rate_hz: float, size: tuple[int, int]) -> SensorMode:
    """Mode with the widest view among those that reach `rate_hz` and are no smaller than `size`.

    Of modes with the same view the one with the fewest pixels is taken (binned: less noise, less to read out), then
    the one with the most bits. Where every fast enough mode is smaller than `size` the image would be blown up, so
    that is an error as well.

    Raises:
        CameraError: No mode is fast and large enough; the text lists the modes.
    """
    if not modes:
        raise CameraError(
            "the camera has no raw sensor modes; a USB camera is opened with --camera v4l2:DEVICE"
        )
    widest = max(mode.area for mode in modes)
    able = [
        mode
        for mode in modes
        if mode.rate_hz + ROUNDING_HZ >= rate_hz and mode.size[0] >= size[0] and mode.size[1] >= size[1]
    ]
    if not able:
        listed = "; ".join(mode.text(widest) for mode in modes)
        raise CameraError(
            f"no mode of the camera delivers {size[0]}x{size[1]} at {rate_hz:g} Hz. It has: {listed}. Lower "
            f"frame_rate_hz, width_px or height_px in the camera file, or use another camera. {FACTS}"
        )
    view = max(mode.area for mode in able)
    same = [mode for mode in able if mode.area >= SAME_VIEW * view]
    return min(same, key=lambda mode: (mode.size[0] * mode.size[1], -mode.bit_depth))


def choose_raw_mode(modes: Sequence[SensorMode], rate_hz: float, size: tuple[int, int]) -> SensorMode:
    """Mode of a monochrome sensor whose values are the image: of exactly this size [px], and fast enough.

    Of modes with the widest view that of fewest bits, but no fewer than 8: a frame has 8 bits, and the rest would be
    read out for nothing.

    Raises:
        CameraError: The sensor has colour filters, or no such mode; the text lists the modes.
    """
    if modes and not any(mode.mono for mode in modes):
        raise CameraError(
            "its sensor has colour filters, so that its values are a mosaic and no grey image: use a monochrome "
            "sensor (OV9281, OV7251, IMX296 mono), or, without an infrared filter before it, --luma"
        )
    able = [
        mode
        for mode in modes
        if mode.mono and mode.size == size and mode.rate_hz + ROUNDING_HZ >= rate_hz and mode.bit_depth >= 8
    ]
    if not able:
        widest = max((mode.area for mode in modes), default=1)
        listed = "; ".join(mode.text(widest) for mode in modes) or "none"
        raise CameraError(
            f"no mode of the sensor is {size[0]}x{size[1]} at {rate_hz:g} Hz. It has: {listed}. A grey image is what "
            "the sensor delivers, pixel by pixel: set width_px, height_px, frame_rate_hz of the camera file to a mode"
        )
    view = max(mode.area for mode in able)
    return min((mode for mode in able if mode.area >= SAME_VIEW * view), key=lambda mode: mode.bit_depth)


def view_text(mode: SensorMode, modes: Sequence[SensorMode]) -> str:
    """The chosen mode in words, for the log."""
    return mode.text(max(other.area for other in modes))
