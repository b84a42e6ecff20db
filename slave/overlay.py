"""Overlay of the detections on a preview image.

Pixels in the range of a marker are tinted, detections are marked by crosses.

It is drawn on the thread of the previews, while somebody asks for it; the loop does nothing for it but keep what it
found in its last frames.
"""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from common.arrays import Float, Image
from common.calibration import HsvRange
from slave.markers.classify import HUES
from slave.markers.reloadable import ReloadableDetector
from slave.sources import Frame
from slave.wrist.detector import WristDetector

TINT = 0.7  # of the tint in a tinted pixel: what lies below stays to be seen
SEVERAL = (255, 255, 255)  # a pixel in the ranges of several markers: they collide
ARM_PX = 6, 9  # of a cross, from and to; its middle is left free, for a far marker is as small
WHITE, BLACK = (255, 255, 255), (0, 0, 0)
LASER, TIP = (60, 60, 255), (80, 255, 80)


class MarkerOverlay:
    """Overlay of a camera that looks for markers, by the detector in use.

    Has no state of its own.
    """

    def __init__(self, detector: ReloadableDetector, markers: tuple[str, ...]) -> None:
        """Draw what `detector` finds of the rig's `markers`."""
        self._detector, self._markers = detector, markers

    @property
    def markers(self) -> tuple[str, ...]:
        """Those of the rig."""
        return self._markers

    def draw(self, small: Image, frame: Frame, mask: Sequence[str], found: bool) -> Image:
        """Return a new image (h, w, 3) with tinted markers and crosses at centroids.

        Tinted by the colour table in use, which follows the light.

        Args:
            small: (h, w, 3) BGR or (h, w) grey: the frame shrunk.
            frame: The frame itself.
            mask: Markers to tint.
            found: Whether to cross what was found in that frame.
        """
        drawn, plain = small.copy(), self._detector.plain
        if mask and plain is not None:
            height, width = small.shape[:2]
            points = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_NEAREST)
            codes = plain.table.codes(np.asarray(points, np.uint8))
            bits = dict(zip(plain.markers, plain.table.bits, strict=True))
            _tint(drawn, {name: codes & bits[name] != 0 for name in mask if name in bits}, plain.ranges)
        if found and (uv := self._detector.found(frame.t_ns)) is not None:
            _cross(drawn, uv, frame.image, WHITE)
        return drawn


class WristOverlay:
    """Overlay of the camera of a wrist device. Holds nothing of its own."""

    def __init__(self, detector: WristDetector) -> None:
        """Draw what `detector` finds."""
        self._detector = detector

    @property
    def markers(self) -> tuple[str, ...]:
        """None: it looks for fingers."""
        return ()

    def draw(self, small: Image, frame: Frame, mask: Sequence[str], found: bool) -> Image:
        """Return a new image with crosses at laser points (red) and tips (green).

        As of `MarkerOverlay`.
        """
        del mask
        drawn = (
            np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), np.uint8) if small.ndim == 2 else small.copy()
        )
        if found and (both := self._detector.found(frame.t_ns)) is not None:
            for uv, colour in zip(both, (LASER, TIP), strict=True):
                _cross(drawn, uv, frame.image, colour)
        return drawn


def contrast_of(colour: HsvRange) -> tuple[int, int, int]:
    """Return the tint (BGR) for the pixels of a marker colour.

    It is the hue across the circle from the middle of its range.
    """
    low, high = colour.hsv_low[0], colour.hsv_high[0]
    middle = low + (high - low) % HUES // 2
    pixel = np.array([[[(middle + HUES // 2) % HUES, 255, 255]]], np.uint8)
    blue, green, red = cv2.cvtColor(pixel, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    return blue, green, red


def _tint(drawn: Image, inside: Mapping[str, np.ndarray], ranges: Mapping[str, HsvRange]) -> None:
    """Tint the pixels (h, w) of each marker, in place.

    Those of several markers are white; a dark rim sets each area off.
    """
    count = np.zeros(drawn.shape[:2], np.uint8)
    for name, where in inside.items():
        tint = np.array(contrast_of(ranges[name]), np.float64)
        drawn[where] = np.rint((1.0 - TINT) * drawn[where] + TINT * tint).astype(np.uint8)
        count += where
    drawn[count > 1] = SEVERAL
    tinted = (count > 0).astype(np.uint8)
    drawn[cv2.dilate(tinted, np.ones((3, 3), np.uint8)) != tinted] = BLACK


def _cross(drawn: Image, uv: Float, whole: Image, colour: tuple[int, int, int]) -> None:
    """Draw upright crosses at uv (K, 2) [px of the whole image], in place.

    NaN: none. Dark below, so that they show.
    """
    scale = np.array([drawn.shape[1] / whole.shape[1], drawn.shape[0] / whole.shape[0]])
    near, far = ARM_PX
    for u, v in np.rint((uv[np.isfinite(uv).all(axis=1)] + 0.5) * scale - 0.5).astype(int).tolist():
        for shade, thickness in ((BLACK, 3), (colour, 1)):
            for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                ends = (u + near * x, v + near * y), (u + far * x, v + far * y)
                cv2.line(drawn, *ends, shade, thickness)
