"""Find a camera that sends one picture, or a few in turn, again and again with new stamps.

Two pictures of a real sensor are never equal: of a million pixels the noise of reading changes many. So a picture that
equals the one before, byte by byte, was not measured again. Nor was one that equals an earlier one, as where a driver
hands the same buffers round: of those not the pictures are kept but check sums. Only a real camera can be judged so: a
simulated scene without noise, or a recording, may well repeat itself.

A picture without contrast is no evidence: behind a cap, or fully exposed, all values may be cut off at black or white.
There is nothing to find in it either.
"""

import zlib
from collections import deque

import cv2
import numpy as np

from common.arrays import Image

ROWS = 4  # looked at first; where one of their values differs, nothing else is
BUFFERS = 8  # that a driver may hand round: ours are asked for four and six
CONTRAST = 8  # levels in a channel, above what JPEG makes of an even picture


class RepeatedPictures:
    """Holds the last picture, to which nobody writes any more, and check sums of those before.

    The sums: shape, that of a few rows, and that of the whole where such rows had been there before.
    """

    def __init__(self) -> None:
        """There was none yet."""
        self._last: Image | None = None
        self._sums: deque[tuple[tuple[int, ...], int, int | None]] = deque(maxlen=BUFFERS)

    def push(self, image: Image) -> bool:
        """Whether a picture, (H, W, 3) or (H, W), is the one before, or one of those in turn, over again."""
        last, self._last = self._last, image
        step = max(1, len(image) // ROWS)
        rows = np.ascontiguousarray(image[step // 2 :: step])
        same_rows = last is not None and np.array_equal(rows, last[step // 2 :: step])
        if last is not None and same_rows and last.shape == image.shape and np.array_equal(image, last):
            return _has_contrast(image)
        return self._was_before(image, zlib.crc32(rows.data)) and _has_contrast(image)

    def _was_before(self, image: Image, rows: int) -> bool:
        """Whether a picture whose rows have this sum was there twice already, among the last ones."""
        key = image.shape, rows
        wholes = [whole for shape, before, whole in reversed(self._sums) if (shape, before) == key]
        whole = zlib.crc32(np.ascontiguousarray(image).data) if wholes else None
        self._sums.append((*key, whole))
        return bool(wholes) and wholes[0] == whole


def _has_contrast(image: Image) -> bool:
    """Whether any pixel is further from the first one than an even picture's are."""
    first = np.atleast_1d(image[0, 0]).astype(float)
    even = cv2.inRange(image, first - CONTRAST, first + CONTRAST)
    return cv2.countNonZero(even) < even.size
