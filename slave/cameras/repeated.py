"""Find a camera that sends one picture again and again, with new stamps.

Two pictures of a real sensor are never equal: of a million pixels the noise of reading changes many. So a picture that
equals the one before, byte by byte, was not measured again. Only a real camera can be judged so: a simulated scene
without noise, or a recording, may well repeat itself.

A picture without contrast is no evidence: behind a cap, or fully exposed, all values may be cut off at black or white.
There is nothing to find in it either.
"""

import cv2
import numpy as np

from common.arrays import Image

ROWS = 4  # looked at first; where one of their values differs, nothing else is
CONTRAST = 8  # levels in a channel, above what JPEG makes of an even picture


class RepeatedPictures:
    """Holds the last picture, to which nobody writes any more."""

    def __init__(self) -> None:
        """There was none yet."""
        self._last: Image | None = None

    def push(self, image: Image) -> bool:
        """Whether a picture, (H, W, 3) or (H, W), is the one before over again."""
        last, self._last = self._last, image
        if last is None or last.shape != image.shape:
            return False
        step = max(1, len(image) // ROWS)
        if not np.array_equal(image[step // 2 :: step], last[step // 2 :: step]):
            return False
        return cv2.norm(image, last, cv2.NORM_INF) == 0.0 and _has_contrast(image)


def _has_contrast(image: Image) -> bool:
    """Whether any pixel is further from the first one than an even picture's are."""
    first = np.atleast_1d(image[0, 0]).astype(float)
    even = cv2.inRange(image, first - CONTRAST, first + CONTRAST)
    return cv2.countNonZero(even) < even.size
