"""Subtraction of the ambient frame of a strobe cycle.

The device's own light is left.
"""

import cv2
import numpy as np

from common.arrays import Image


def lit_line(frame: Image, ambient: Image) -> Image:
    """Return the image (H, W) of the laser's line, as `lit` does.

    White where the light that was added made the frame white.

    In the sun a line has less room up to white the brighter the skin is: what is left of it does not measure the line.
    """
    out = lit(frame, ambient)
    # grey levels of a frame: as bright or brighter
    white = cv2.threshold(frame, 250 - 1, 255, cv2.THRESH_BINARY)[1]
    least = 16  # grey levels that were added: less is noise beside what is white anyway
    added = cv2.threshold(out, least, 255, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.max(out, cv2.bitwise_and(white, added)), np.uint8)


def lit(frame: Image, ambient: Image) -> Image:
    """Subtract the ambient frame; the difference saturates at 0 (Kim et al. 2012).

    The black level cancels. Where the ambient frame is saturated the light that was added cannot be measured, and
    the difference is 0 there by itself.

    Args:
        frame: (H, W) laser or LED frame, uint8.
        ambient: (H, W) ambient frame of the same strobe cycle, uint8.

    Returns:
        (H, W) uint8.

    Raises:
        ValueError: The two are not of one size.
    """
    if frame.shape != ambient.shape:
        raise ValueError(f"frame of {frame.shape} and ambient frame of {ambient.shape} are not of one size")
    return np.asarray(cv2.subtract(frame, ambient), np.uint8)
