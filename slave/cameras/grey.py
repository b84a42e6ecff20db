"""Convert frames of monochrome sensors, or luma of colour ones, to 8-bit grey.

The camera of a wrist device has a monochrome sensor. Its values are linear in the light, which differences of frames
(Kim et al. 2012) and the fall-off of the LEDs need, and they stay so: the highest 8 bits are taken, black level and
saturation stay where the sensor has them. Byte orders are those of the kernel's documentation (media/uapi/v4l,
pixfmt-yuv-luma): Y10 and Y12 in the low bits of a 16-bit word, little-endian; Y10P and Y12P four pixels in five
bytes, two in three, first the highest 8 bits of each; Y16 with the sensor's bits on top, as Raspberry Pi's receivers
put them.

A colour camera without an infrared filter can stand in, by name: its luma. That is coded for screens, so it is *not*
linear, and behind each pixel stands the mosaic of several. The mosaic itself is never taken for a grey image.
"""

from enum import StrEnum

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Image
from common.errors import CameraError
from common.recording.frame_recording import Illumination


class Pixels(StrEnum):
    """Frames: (H, W, 3) BGR; (H, W) of a monochrome sensor; (H, W) luma of colours."""

    COLOUR = "colour"
    GREY = "grey"
    LUMA = "luma"

    @property
    def illumination(self) -> Illumination:
        """What a driver knows of what lit its frames: of a strobed camera, nothing."""
        return Illumination.AMBIENT if self is Pixels.COLOUR else Illumination.NONE


_DEPTH = {"Y10": 10, "Y12": 12, "Y16": 16}  # bits, in words of two bytes
# bytes of a group; its first ones, each the highest 8 bits of a pixel
_PACKED = {"Y10P": (5, 4), "Y12P": (3, 2)}
_LUMA = {
    "NV12": (1, 0),
    "YU12": (1, 0),
    "YUYV": (2, 0),
    "UYVY": (2, 1),
}  # bytes from pixel to pixel, the first
# The best first: without conversion, then with the fewest bytes; JPEG where nothing else is fast enough.
GREY_FORMATS = ("GREY", "Y10P", "Y12P", "Y10", "Y12", "Y16")
LUMA_FORMATS = tuple(_LUMA)
JPEG_FORMATS = ("MJPG", "JPEG")
_LIMITED = 255.0 / 219.0  # luma of 16 to 235 (ITU-R BT.601, 2.5.3) as 0 to 255
_FULL_RANGE = np.clip(np.round((np.arange(256) - 16.0) * _LIMITED), 0, 255).astype(np.uint8)


def grey(data: npt.NDArray[np.uint8], name: str, size: tuple[int, int], stride: int) -> Image | None:
    """New grey image (H, W) from the bytes (N,) of one frame; None: truncated.

    `name` of `GREY_FORMATS`; `size`: width and height [px]; `stride`: bytes from row to row.

    Raises:
        CameraError: Its words of 16 bits hold fewer, in their low ends.
    """
    width, height = size
    if name in _PACKED:
        group, pixels = _PACKED[name]
        groups = -(-width // pixels)
        rows = rows_of(data, height, stride, groups * group)
        if rows is None:
            return None
        highest = np.ascontiguousarray(rows).reshape(height, groups, group)[..., :pixels].reshape(height, -1)
        return np.ascontiguousarray(highest[:, :width])
    depth = _DEPTH.get(name, 8)
    rows = rows_of(data, height, stride, width * (1 if depth == 8 else 2))
    if rows is None:
        return None
    if depth == 8:
        return rows.copy()
    words = np.ascontiguousarray(rows).view("<u2")
    if depth == 16:
        _refuse_low(words)
        return np.ascontiguousarray(rows[:, 1::2])
    # Rounded to the nearest less just under a half: the highest 8 bits; what lies above the depth saturates.
    step = 1 << (depth - 8)
    return np.asarray(cv2.convertScaleAbs(words, alpha=1.0 / step, beta=-0.5 * (step - 1) / step), np.uint8)


def luma(
    data: npt.NDArray[np.uint8], name: str, size: tuple[int, int], stride: int, *, full_range: bool
) -> Image | None:
    """New image (H, W) of the luma of a colour format, 0 to 255; None: truncated.

    Arguments as of `grey`, `name` of `LUMA_FORMATS`; `full_range`: coded as 0 to 255, and not as 16 to 235.
    """
    width, height = size
    step, first = _LUMA[name]
    rows = rows_of(data, height, stride, width * step)
    if rows is None:
        return None
    plane = np.ascontiguousarray(rows[:, first::step])
    return plane if full_range else np.asarray(cv2.LUT(plane, _FULL_RANGE), np.uint8)


def _refuse_low(words: npt.NDArray[np.uint16]) -> None:
    """Refuse words (H, W) that hold fewer bits in their low ends: nearly black.

    The kernel lets a driver call them Y16 and does not state at which end they lie. Values on top end with zeros.
    """
    row = words[len(words) // 2]
    used = int(np.bitwise_or.reduce(row))
    if used & 0xF and not int(np.bitwise_or.reduce(words, axis=None)) >> 12:
        raise CameraError(
            f"its Y16 has no value above {used:#x}: fewer bits than 16, in the low end of the word. Phalanx reads Y16 "
            "with the sensor's bits on top; choose a mode that the driver calls Y10 or Y12"
        )


def rows_of(data: npt.NDArray[np.uint8], height: int, stride: int, used: int) -> Image | None:
    """The bytes (height, used) of the rows without padding; None: too few."""
    if stride < used or data.size < stride * (height - 1) + used:
        return None
    return np.lib.stride_tricks.as_strided(data, (height, used), (stride, data.strides[0]), writeable=False)
