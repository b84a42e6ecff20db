"""Which streams a Pi camera is configured with, and the image that a captured request holds.

Colour frames come through the image processor, as `main`, in BGR. Grey ones are the *raw* stream of a monochrome
sensor: `main` has gone through gamma, denoising and sharpening of the tuning file, after which a difference of two
frames is no light. libcamera makes no other size of a raw stream than the mode's, and picamera2 asks for a `main`
beside it, which nobody reads.

Names of libcamera (formats.yaml) and what picamera2 hands out (`Helpers._make_array_shared`, 0.3.38): raw streams are
(H, stride) bytes with the padding. Up to Pi 4 a mode of 10 bits comes as it is asked for, `R10`, in the low bits of
words; a Pi 5 makes `R16` of it, the sensor's bits on top. Modes of 8 bits are `R8` on both.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from common.arrays import Image
from common.errors import CameraError
from slave.cameras.grey import Pixels, grey, luma
from slave.cameras.picamera2_frames import without_padding
from slave.cameras.picamera2_library import Request
from slave.cameras.picamera2_modes import SensorMode

# Names of libcamera -> of the kernel; the others are packed or compressed, which nobody asked for.
_RAW = {"R8": "GREY", "R10": "Y10", "R12": "Y12", "R16": "Y16"}
_MAIN = {Pixels.COLOUR: "RGB888", Pixels.GREY: "YUV420", Pixels.LUMA: "YUV420"}  # RGB888: B, G, R in memory


@dataclass(frozen=True, slots=True)
class Streams:
    """What is asked for, and what came of it.

    Attributes:
        pixels: What the frames are to be.
        size: Width and height of the frames [px].
        mode: Mode of the sensor.
        lores: Width and height of the small image [px], or None.
        raw: Name and bytes per row of the raw stream as the camera makes it, once it is known.
    """

    pixels: Pixels
    size: tuple[int, int]
    mode: SensorMode
    lores: tuple[int, int] | None
    raw: tuple[str, int] | None = None

    def parts(self) -> dict[str, Any]:
        """Streams and sensor mode of the configuration."""
        raw = {"format": f"R{self.mode.bit_depth}", "size": self.mode.size}
        parts: dict[str, Any] = {
            "main": {"size": self.size, "format": _MAIN[self.pixels]},
            "raw": raw if self.pixels is Pixels.GREY else None,
            "sensor": {"output_size": self.mode.size, "bit_depth": self.mode.bit_depth},
        }
        if self.lores is not None:
            parts["lores"] = {"size": self.lores, "format": "YUV420"}
        return parts

    def taken(self, configuration: Mapping[str, Any]) -> "Streams":
        """The same with what the camera made of it; libcamera adjusts what it cannot do.

        Raises:
            CameraError: Another size or format: such frames were not calibrated.
        """
        expected: dict[str, tuple[tuple[int, int], tuple[str, ...]]] = {
            "main": (self.size, (_MAIN[self.pixels],))
        }
        if self.lores is not None:
            expected["lores"] = (self.lores, ("YUV420",))
        if self.pixels is Pixels.GREY:
            expected["raw"] = (self.mode.size, tuple(_RAW))
        for name, (size, formats) in expected.items():
            got = (tuple(configuration[name]["size"]), str(configuration[name]["format"]))
            if got[0] != size or got[1] not in formats:
                raise CameraError(
                    f"stream {name}: wanted {size[0]}x{size[1]} {' or '.join(formats)}, the camera makes "
                    f"{got[0][0]}x{got[0][1]} {got[1]} of it; use a size with even width and height"
                )
        raw = configuration["raw"] if self.pixels is Pixels.GREY else None
        named = None if raw is None else (str(raw["format"]), int(raw["stride"]))
        return Streams(self.pixels, self.size, self.mode, self.lores, named)

    def image(self, request: Request) -> Image:
        """The frame: (H, W, 3) BGR, or (H, W) grey.

        Raises:
            RuntimeError: It is not of the size or depth that was configured.
            CameraError: As of `grey`.
        """
        width, height = self.size
        if self.pixels is Pixels.COLOUR:
            image = np.asarray(request.make_array("main"))
            shape: tuple[int, ...] = (height, width, 3)
            if image.shape != shape or image.dtype != np.uint8:
                raise RuntimeError(f"a frame is {image.shape} {image.dtype}, not {shape} uint8")
            return image
        if self.pixels is Pixels.LUMA:
            array = np.asarray(request.make_array("main"))
            shape = (height * 3 // 2, array.shape[-1])
            found = luma(array.reshape(-1), "YU12", self.size, shape[1], full_range=False)
        else:
            assert self.raw is not None, "streams that were taken"
            name, stride = self.raw
            array = np.asarray(request.make_array("raw"))
            shape = (height, stride)
            found = (
                grey(array.reshape(-1), _RAW[name], self.size, stride) if array.dtype == np.uint8 else None
            )
        if found is None or array.shape != shape or array.dtype != np.uint8:
            raise RuntimeError(f"a frame is {array.shape} {array.dtype}, not {shape} uint8")
        return found

    def small(self, request: Request) -> Image | None:
        """The small image, where it was asked for."""
        return None if self.lores is None else without_padding(request.make_array("lores"), *self.lores)
