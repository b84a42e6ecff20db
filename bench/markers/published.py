"""The published marker pipeline, rebuilt as the baseline of the benchmarks: whole frame, one pass per colour.

Kalbfleisch: HSV, `inRange` per colour, Gaussian, erosion, dilation, largest white area, centre of gravity. The
mask is thresholded again after the Gaussian: taken literally (any non-zero pixel) it grows and picks wrong blobs.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from common.arrays import Float, Image
from common.calibration import HsvRange

KERNEL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))


def detect(image: Image, ranges: Sequence[HsvRange]) -> Float:
    """Centroids (M, 2) [px] of the largest blob of each colour in (H, W, 3) BGR, NaN: none; no range wraps."""
    uv = np.full((len(ranges), 2), np.nan)
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    for m, colour in enumerate(ranges):
        mask = cv2.inRange(hsv, colour.hsv_low, colour.hsv_high)
        mask = cv2.GaussianBlur(mask, (5, 5), 0)
        _, mask = cv2.threshold(mask, 127, 255, cv2.THRESH_BINARY)
        mask = cv2.dilate(cv2.erode(mask, KERNEL), KERNEL)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        if contours:
            moments = cv2.moments(max(contours, key=cv2.contourArea))
            if moments["m00"] > 0.0:
                uv[m] = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    return uv
