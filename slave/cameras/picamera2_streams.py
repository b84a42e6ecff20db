"""Choose mode and streams of a Pi camera, and take the image of a request.

A sensor offers a few modes, each with its own crop of the pixel array and its own highest rate. Faster modes often
see less: the same lens then has a longer focal length in pixels, and a calibration made in another mode is wrong. So
the widest view wins. Where no mode or stream fits, `CameraError` lists what there is.

Colour frames come through the image processor, as `main`, in BGR. Grey ones are the *raw* stream of a monochrome
sensor: `main` has gone through gamma, denoising and sharpening, after which a difference of two frames is no light.
libcamera makes no other size of a raw stream than the mode's, and picamera2 asks for a `main` beside it, which nobody
reads. Raw streams are (H, stride) bytes with the padding (formats.yaml; `Helpers._make_array_shared`, picamera2
0.3.38). Up to Pi 4 a mode of 10 bits comes as `R10`, in the low bits of words; a Pi 5 makes `R16` of it, the sensor's
bits on top. Modes of 8 bits are `R8` on both.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from common.arrays import Image
from common.calibration.camera import Sensor
from common.errors import CameraError
from slave.cameras.grey import Pixels, grey, luma
from slave.cameras.picamera2_settings import Request
from slave.cameras.settings import how_far

# libcamera's R8, R10_CSI2P, MONO_PISP_COMP1; mosaics are SRGGB10, RGGB_PISP_COMP1 and so on.
MONO = re.compile(r"R\d|MONO")


@dataclass(frozen=True, slots=True)
class SensorMode:
    """One mode of the sensor."""

    size: tuple[int, int]  # width and height of what the sensor delivers [px]
    bit_depth: int
    rate_hz: float  # highest frame rate [Hz]
    crop: tuple[int, int, int, int]  # x, y, width and height on the pixel array [px of the array]
    mono: bool = False  # whether the sensor has no colour filters

    @property
    def area(self) -> int:
        """Pixels of the array that the mode sees."""
        return self.crop[2] * self.crop[3]

    def text(self, modes: "Sequence[SensorMode]") -> str:
        """The mode in words, as one of all `modes`."""
        width, height = self.size
        share = 100.0 * self.area / max(mode.area for mode in modes)
        return f"{width}x{height} {self.bit_depth} bit, up to {self.rate_hz:.1f} Hz, {share:.0f} % of the full view"

    def reaches(self, rate_hz: float) -> bool:
        """Whether it is so fast; picamera2 rounds rates to two digits."""
        return self.rate_hz + 0.005 >= rate_hz


def read_modes(modes: Sequence[Mapping[str, Any]]) -> tuple[SensorMode, ...]:
    """Modes from `Picamera2.sensor_modes`; none of a camera without raw modes."""
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


def check_model(sensor: Sensor | None, model: str, modes: Sequence[SensorMode], rate_hz: float) -> None:
    """Refuse a camera file of another sensor."""
    if sensor is not None and not sensor.fits(model):
        raise CameraError(
            f"the camera file is one of {sensor.model} ({sensor.title}), the camera is {model}. Nearest modes: "
            f"{listed(modes, sensor.mode_px, rate_hz)}. `phalanx-slave doctor` names the files that fit"
        )


def choose_mode(
    modes: Sequence[SensorMode], rate_hz: float, size: tuple[int, int], sensor: Sensor | None = None
) -> SensorMode:
    """Mode of `sensor`; of an unknown one that with the widest view.

    It is fast enough and not smaller than `size`. Of modes with the same view the one with the fewest pixels is taken
    (binned: less noise, less to read out), then the one with the most bits.
    """
    if not modes:
        raise CameraError(
            "the camera has no raw sensor modes; a USB camera is opened with --camera v4l2:DEVICE"
        )
    width, height = size
    able = [m for m in modes if m.reaches(rate_hz) and m.size[0] >= width and m.size[1] >= height]
    wanted = f"{width}x{height} at {rate_hz:g} Hz"
    if sensor is not None:
        able = [m for m in able if (m.size, m.bit_depth) == (sensor.mode_px, sensor.bits)]
        wanted += f" from {sensor.mode_px[0]}x{sensor.mode_px[1]} {sensor.bits} bit"
    if not able:
        raise CameraError(
            f"no mode of the camera delivers {wanted}. Nearest: "
            f"{listed(modes, size if sensor is None else sensor.mode_px, rate_hz)}. Change frame_rate_hz, width_px, "
            "height_px of the camera file; `phalanx-slave doctor` names the shipped files that fit"
        )
    return min(_widest(able), key=lambda mode: (mode.size[0] * mode.size[1], -mode.bit_depth))


def _widest(modes: Sequence[SensorMode]) -> list[SensorMode]:
    """Those with the widest view; crops that differ by a few rows show the same."""
    view = max(mode.area for mode in modes)
    return [mode for mode in modes if mode.area >= 0.98 * view]


def listed(modes: Sequence[SensorMode], size: tuple[int, int], rate_hz: float) -> str:
    """Modes in words, those nearest to a size [px] and rate [Hz] first."""
    near = sorted(modes, key=lambda mode: how_far(size, rate_hz, mode.size, (max(mode.rate_hz, rate_hz),)))
    return "; ".join(mode.text(modes) for mode in near) or "none"


def choose_raw_mode(modes: Sequence[SensorMode], rate_hz: float, size: tuple[int, int]) -> SensorMode:
    """Mode of a monochrome sensor of exactly this size [px], and fast enough.

    Of modes with the widest view that of fewest bits, but no fewer than 8: a frame has 8 bits, the rest would be read
    out for nothing.
    """
    if modes and not any(mode.mono for mode in modes):
        raise CameraError(
            "its sensor has colour filters, so that its values are a mosaic and no grey image: use a monochrome "
            "sensor (OV9281, OV7251, IMX296 mono), or, without an infrared filter before it, --luma"
        )
    able = [m for m in modes if m.mono and m.size == size and m.reaches(rate_hz) and m.bit_depth >= 8]
    if not able:
        raise CameraError(
            f"no mode of the sensor is {size[0]}x{size[1]} at {rate_hz:g} Hz. Nearest: "
            f"{listed(modes, size, rate_hz)}. A grey image is what the sensor delivers, pixel by pixel: set width_px, "
            "height_px, frame_rate_hz of the camera file to a mode"
        )
    return min(_widest(able), key=lambda mode: mode.bit_depth)


# Names of libcamera -> of the kernel; the others are packed or compressed, which nobody asked for.
_RAW = {"R8": "GREY", "R10": "Y10", "R12": "Y12", "R16": "Y16"}
_MAIN = {Pixels.COLOUR: "RGB888", Pixels.GREY: "YUV420", Pixels.LUMA: "YUV420"}  # RGB888: B, G, R in memory


@dataclass(frozen=True, slots=True)
class Streams:
    """What is asked for, and what came of it."""

    pixels: Pixels  # what the frames are to be
    size: tuple[int, int]  # width and height of the frames [px]
    mode: SensorMode
    lores: tuple[int, int] | None
    # name and bytes per row of the raw stream as the camera makes it, once it is known
    raw: tuple[str, int] | None = None

    def parts(self) -> dict[str, Any]:
        """Streams and sensor mode of the configuration."""
        raw = {"format": f"R{self.mode.bit_depth}", "size": self.mode.size}
        lores = {} if self.lores is None else {"lores": {"size": self.lores, "format": "YUV420"}}
        return lores | {
            "main": {"size": self.size, "format": _MAIN[self.pixels]},
            "raw": raw if self.pixels is Pixels.GREY else None,
            "sensor": {"output_size": self.mode.size, "bit_depth": self.mode.bit_depth},
        }

    def taken(self, configuration: Mapping[str, Any]) -> "Streams":
        """The same with what the camera made of it; libcamera adjusts what it cannot do."""
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
        return replace(self, raw=None if raw is None else (str(raw["format"]), int(raw["stride"])))

    def image(self, request: Request) -> Image:
        """The frame: (H, W, 3) BGR, or (H, W) grey; `RuntimeError`: of another size."""
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


def without_padding(image: npt.NDArray[Any], width: int, height: int) -> Image:
    """Planar YUV420 (3 height / 2, width) uint8 without the padding of rows.

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
