"""Decide for every pixel which markers' colours it may belong to, by one table look-up for all colours.

The table holds one entry per possible 24-bit pixel and one bit per marker. It is *built from* the HSV ranges of
the camera file by running OpenCV's own conversion over all 2^24 colours, so a look-up equals `cvtColor` +
`inRange` exactly and the thresholds stay the user's HSV thresholds; no frame is ever converted to HSV. One look-up
costs the same for one colour and for eight (Bruce, Balch, Veloso, CMVision, 2000, do the same with one table
per axis; a packed table also carries ranges that are no boxes).
"""

from collections.abc import Mapping, Sequence
from copy import copy
from typing import TypeAlias, cast

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Image
from common.calibration import HsvRange
from common.errors import CalibrationError

Codes: TypeAlias = npt.NDArray[np.unsignedinteger]
HUES = 180


class ColourTable:
    """Which markers a colour may belong to: bit m of an entry belongs to marker m.

    Holds the table (2^24 entries of 1, 2, 4 or 8 bytes) and the work buffers of the scan.
    """

    def __init__(self, ranges: Sequence[HsvRange]) -> None:
        """Build the table, about 0.3 s for six markers.

        Args:
            ranges: HSV range of each marker, in marker order, at most 64.

        Raises:
            ValueError: No range, or more than 64.
        """
        if not 1 <= len(ranges) <= 64:
            raise ValueError(f"{len(ranges)} colour ranges, from 1 to 64 are possible")
        self.count = len(ranges)
        self._table = _build(ranges)
        self._index = np.empty((0, 0), np.int64)
        self._codes: Codes = np.empty((0, 0), self._table.dtype)

    def relit(self, tables: Image) -> "ColourTable":
        """The table for pictures whose bytes must be mapped before these ranges hold, about 50 ms.

        Colours that belong to one marker before belong to one marker after: no ranges can come to overlap.

        Args:
            tables: (3, 256) byte -> byte of blue, green and red.
        """
        blue, green, red = tables
        cube = self._table.reshape(256, 256, 256)
        made = np.empty_like(cube)
        for plane, source in zip(made, red, strict=True):
            cube[source].take(green, axis=0).take(blue, axis=1, out=plane)
        other = copy(self)
        other._table = made.reshape(-1)
        other._index, other._codes = np.empty((0, 0), np.int64), np.empty((0, 0), made.dtype)
        return other

    @property
    def bits(self) -> tuple[int, ...]:
        """Bit mask of each marker in a code."""
        return tuple(1 << m for m in range(self.count))

    def codes(self, image: Image) -> Codes:
        """Class codes of every pixel of a window.

        Args:
            image: (H, W, 3) BGR, any strides.

        Returns:
            (H, W) codes; bit m is set where the pixel is in the range of marker m.
        """
        packed = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA).view(np.uint32)[..., 0]
        return self._table.take(packed & 0xFFFFFF)

    def half_codes(self, image: Image) -> Codes:
        """Class codes of every second pixel of every second row: the scan of a whole frame.

        Decimated, not averaged: an averaged pixel on the rim of a marker has a hue that no paint has.

        Args:
            image: (H, W, 3) BGR, C-contiguous.

        Returns:
            (H // 2, W // 2) codes of the pixels (2 v, 2 u). The array is reused by the next call.
        """
        height, width = image.shape[0] // 2, image.shape[1] // 2
        row = image.shape[1] * 3
        # A pixel is read as four bytes, of which the last belongs to its neighbour; since the neighbour of a
        # pixel with an even column exists, the read never leaves the image.
        words = np.ndarray((height, width), "<u4", buffer=image, strides=(2 * row, 6))
        if self._index.shape != words.shape:
            self._index = np.empty(words.shape, np.int64)
            self._codes = np.empty(words.shape, self._table.dtype)
        np.bitwise_and(words, 0xFFFFFF, out=self._index, casting="unsafe")
        return self._table.take(self._index, out=self._codes, mode="wrap")


def table_of(markers: Sequence[str], ranges: Mapping[str, HsvRange] | None, where: str) -> ColourTable:
    """The table of a camera's markers, in the order of the rig.

    Raises:
        CalibrationError: A marker has no range; the text says where and which, and how to make it.
    """
    missing = [name for name in markers if name not in (ranges or {})]
    if missing or ranges is None:
        raise CalibrationError(
            f"{where}: markers: no HSV range for {', '.join(missing)}; make them with "
            f"`phalanx-slave colours RECORDING --camera NAME -o FILE`"
        )
    return ColourTable([ranges[name] for name in markers])


def in_range(hsv: Image, colour: HsvRange) -> npt.NDArray[np.bool_]:
    """Pixels inside a range, hue wrapping through 0 where the low hue is above the high one.

    Args:
        hsv: (..., 3) OpenCV HSV, H 0-179.
    """
    h, s, v = hsv[..., 0], hsv[..., 1], hsv[..., 2]
    low, high = colour.hsv_low, colour.hsv_high
    hue = (h >= low[0]) & (h <= high[0]) if low[0] <= high[0] else (h >= low[0]) | (h <= high[0])
    return hue & (s >= low[1]) & (s <= high[1]) & (v >= low[2]) & (v <= high[2])


def _build(ranges: Sequence[HsvRange]) -> Codes:
    kind = next(
        t for t, n in ((np.uint8, 8), (np.uint16, 16), (np.uint32, 32), (np.uint64, 64)) if len(ranges) <= n
    )
    table = np.zeros(
        (256, 256, 256), kind
    )  # red, green, blue: the byte order of a packed little-endian pixel
    plane = np.empty((256, 256, 3), np.uint8)
    plane[..., 0] = np.arange(256)[None, :]
    plane[..., 1] = np.arange(256)[:, None]
    for red in range(256):
        plane[..., 2] = red
        hsv = cv2.cvtColor(plane, cv2.COLOR_BGR2HSV)
        for m, colour in enumerate(ranges):
            for low, high in _spans(colour):
                inside = cast(Image, cv2.inRange(hsv, low, high))
                table[red] |= (inside & 1).astype(kind) << kind(m)
    return table.reshape(-1)


def _spans(colour: HsvRange) -> list[tuple[tuple[int, int, int], tuple[int, int, int]]]:
    low, high = colour.hsv_low, colour.hsv_high
    if low[0] <= high[0]:
        return [(low, high)]
    return [(low, (HUES - 1, high[1], high[2])), ((0, low[1], low[2]), high)]
