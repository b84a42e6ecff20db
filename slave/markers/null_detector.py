"""Detector that sees no marker, for a slave without calibrated colours.

Its lens or its place is being measured meanwhile.
"""

import numpy as np

from common.arrays import Image
from slave.markers.detector import Detections


class NullDetector:
    """A detector that detects nothing. Holds the answer."""

    def __init__(self, markers: int) -> None:
        """Answer for so many markers."""
        one = np.full(markers, np.nan)
        uv = np.full((markers, 2), np.nan)
        self._nothing = Detections(uv, one, one, one, uv, one, np.full((markers, 3), np.nan))

    def push(self, image: Image, t_ns: int) -> Detections:
        """Nothing, whatever there is."""
        del image, t_ns
        return self._nothing
