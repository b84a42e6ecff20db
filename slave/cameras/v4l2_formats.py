"""Choose an image format of a V4L2 camera, and make images of its bytes.

Uncompressed formats are preferred because JPEG moves colours at the edges of the markers; it is taken where only it
reaches size and rate, as with most USB 2 cameras above 640x480 at 30 Hz. The size must be offered exactly and the
rate to 1 %: a camera that rounds silently would deliver frames that were never calibrated. What is not offered or not
taken raises `CameraError`, which lists what there is.
"""

import errno
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from common.arrays import Image
from common.errors import CameraError, PictureError
from common.recording.pictures import decode
from slave.cameras import v4l2_abi as abi
from slave.cameras.grey import GREY_FORMATS, JPEG_FORMATS, LUMA_FORMATS, Pixels, grey, luma, rows_of
from slave.cameras.settings import how_far

PREFERENCE = {
    Pixels.COLOUR: ("BGR3", "RGB3", "YUYV", "UYVY", *JPEG_FORMATS),
    Pixels.GREY: GREY_FORMATS,
    Pixels.LUMA: (*LUMA_FORMATS, *JPEG_FORMATS),
}

_WHY_NOT = {
    Pixels.COLOUR: "which Phalanx does not read",
    Pixels.GREY: "which are not grey; of a colour camera without infrared filter --luma takes the luma",
    Pixels.LUMA: "which hold no luma",
}

EntryT = TypeVar("EntryT", abi.FormatDescription, abi.FrameSizes, abi.FrameIntervals)


@dataclass(frozen=True, slots=True)
class Offer:
    """One format in one size."""

    pixel_format: int
    size: tuple[int, int]  # width and height [px]
    # frame rates [Hz], rising; of a continuous range its ends; empty where the driver does not state them
    rates_hz: tuple[float, ...]
    continuous: bool = False  # whether everything between the ends is offered, too

    def reaches(self, rate_hz: float) -> bool:
        """Whether this rate [Hz] is offered; a driver that lists none may reach it."""
        if not self.rates_hz:
            return True
        slack = 0.01 * rate_hz  # 59.94 Hz serves 60 Hz
        if self.continuous:
            return self.rates_hz[0] - slack <= rate_hz <= self.rates_hz[-1] + slack
        return any(abs(offered - rate_hz) <= slack for offered in self.rates_hz)

    def text(self) -> str:
        """The offer in words."""
        join = " to " if self.continuous else ", "
        rates = join.join(f"{rate:.4g}" for rate in self.rates_hz) or "unknown"
        return f"{abi.fourcc_text(self.pixel_format)} {self.size[0]}x{self.size[1]} at {rates} Hz"


def read_offers(device: abi.KernelDevice, wanted: tuple[int, int]) -> tuple[Offer, ...]:
    """All formats, sizes and rates; of a range of sizes its ends and the wanted one."""
    formats = _enumerate(
        device, abi.ENUM_FMT, lambda i: abi.FormatDescription(index=i, type=abi.V4L2.capture)
    )
    return tuple(
        _with_rates(device, int(one.pixelformat), size)
        for one in formats
        for size in _sizes(device, int(one.pixelformat), wanted)
    )


def choose_offer(
    offers: Sequence[Offer], size: tuple[int, int], rate_hz: float, pixels: Pixels = Pixels.COLOUR
) -> Offer:
    """Choose the best format for these pixels with exactly this size [px] and rate."""
    wanted = [abi.fourcc(name) for name in PREFERENCE[pixels]]
    able = [o for o in offers if o.pixel_format in wanted and o.size == size and o.reaches(rate_hz)]
    if not able:
        read = [offer for offer in offers if offer.pixel_format in wanted]
        read.sort(key=lambda offer: how_far(size, rate_hz, offer.size, offer.rates_hz))
        most = 6  # in an error: a webcam offers some forty
        listed = "; ".join(offer.text() for offer in read[:most]) or "nothing"
        foreign = sorted({abi.fourcc_text(o.pixel_format) for o in offers if o.pixel_format not in wanted})
        unread = f" (and {', '.join(foreign)}, {_WHY_NOT[pixels]})" if foreign else ""
        raise CameraError(
            f"does not offer {size[0]}x{size[1]} at {rate_hz:g} Hz in a known format "
            f"({', '.join(PREFERENCE[pixels])}). Nearest of {len(read)}: {listed}{unread}. "
            "Set width_px, height_px and frame_rate_hz of the camera file to one of these"
        )
    return min(able, key=lambda offer: wanted.index(offer.pixel_format))


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the bytes of a frame."""

    pixels: Pixels
    name: str  # four letters of the format, one of `PREFERENCE[pixels]`
    size: tuple[int, int]  # width and height [px]
    stride: int  # bytes from row to row; meaningless for JPEG
    full_range: bool = False  # whether luma is coded as 0 to 255, and not as 16 to 235

    def image(self, data: memoryview) -> Image | None:
        """New image, BGR (H, W, 3) or grey (H, W); None: truncated or broken."""
        if self.name in JPEG_FORMATS:
            return self._decoded(bytes(data))
        raw = np.frombuffer(data, np.uint8)
        if self.pixels is Pixels.COLOUR:
            return _colours(raw, self.name, self.size, self.stride)
        if self.pixels is Pixels.LUMA:
            return luma(raw, self.name, self.size, self.stride, full_range=self.full_range)
        return grey(raw, self.name, self.size, self.stride)

    def _decoded(self, jpeg: bytes) -> Image | None:
        try:
            return decode(jpeg, self.size, grey=self.pixels is not Pixels.COLOUR)
        except PictureError:
            return None  # the caller counts it as broken


def set_format(device: abi.KernelDevice, offer: Offer, pixels: Pixels) -> Layout:
    """Set size and format, and see what the driver made of them."""
    asked = abi.Format(type=abi.V4L2.capture)
    pix = asked.fmt.pix
    pix.width, pix.height = offer.size
    pix.pixelformat, pix.field = offer.pixel_format, abi.V4L2.field_none
    device.ioctl(abi.S_FMT, asked)
    name = abi.fourcc_text(pix.pixelformat)
    if (pix.width, pix.height, pix.pixelformat) != (*offer.size, offer.pixel_format):
        raise CameraError(f"format: wanted {offer.text()}, got {name} {pix.width}x{pix.height}")
    of_jpeg = pix.quantization == abi.V4L2.default_range and pix.colorspace == abi.V4L2.colorspace_jpeg
    full_range = of_jpeg or pix.quantization == abi.V4L2.full_range
    return Layout(pixels, name, offer.size, int(pix.bytesperline), full_range)


def _colours(raw: Image, name: str, size: tuple[int, int], stride: int) -> Image | None:
    width, height = size
    rows = rows_of(raw, height, stride, width * (3 if name in ("BGR3", "RGB3") else 2))
    if rows is None:
        return None
    if name == "BGR3":
        return rows.reshape(height, width, 3).copy()
    if name == "RGB3":
        return np.ascontiguousarray(rows.reshape(height, width, 3)[..., ::-1])
    code = cv2.COLOR_YUV2BGR_YUYV if name == "YUYV" else cv2.COLOR_YUV2BGR_UYVY
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows).reshape(height, width, 2), code), np.uint8)


def _enumerate(device: abi.KernelDevice, request: int, entry: Callable[[int], EntryT]) -> Iterator[EntryT]:
    """Yield the entries 0, 1, … until the driver reports that there is no more."""
    for index in range(256):  # a driver that never ends its enumeration is broken
        item = entry(index)
        try:
            device.ioctl(request, item)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):  # the end; or it does not enumerate this at all
                return
            raise
        yield item


def _sizes(device: abi.KernelDevice, pixel_format: int, wanted: tuple[int, int]) -> list[tuple[int, int]]:
    found: list[tuple[int, int]] = []
    for entry in _enumerate(
        device, abi.ENUM_FRAMESIZES, lambda i: abi.FrameSizes(index=i, pixel_format=pixel_format)
    ):
        if entry.type == abi.V4L2.discrete:
            found.append((int(entry.size[0]), int(entry.size[1])))
            continue
        low_w, high_w, step_w, low_h, high_h, step_h = (int(value) for value in entry.size)
        fits = _on_grid(wanted[0], low_w, high_w, step_w) and _on_grid(wanted[1], low_h, high_h, step_h)
        found += [(low_w, low_h), *([wanted] if fits else []), (high_w, high_h)]
        break  # a range has one entry; some drivers repeat it for ever
    return found


def _on_grid(value: int, low: int, high: int, step: int) -> bool:
    return low <= value <= high and (value - low) % max(step, 1) == 0


def _with_rates(device: abi.KernelDevice, pixel_format: int, size: tuple[int, int]) -> Offer:
    rates: list[float] = []
    width, height = size
    for entry in _enumerate(
        device,
        abi.ENUM_FRAMEINTERVALS,
        lambda i: abi.FrameIntervals(index=i, pixel_format=pixel_format, width=width, height=height),
    ):
        values = [int(value) for value in entry.interval]
        if entry.type != abi.V4L2.discrete:
            slowest, fastest = _rate(values[2], values[3]), _rate(values[0], values[1])
            return Offer(pixel_format, size, (slowest, fastest), continuous=True)
        rates.append(_rate(values[0], values[1]))
    return Offer(pixel_format, size, tuple(sorted(rates)))


def _rate(numerator: int, denominator: int) -> float:
    """Rate [Hz] of an interval [s]."""
    return denominator / max(numerator, 1)
