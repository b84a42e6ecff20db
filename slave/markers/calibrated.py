"""Detector of the markers whose colours are known.

It finds none while no colour is known: for a slave that is still being set up.

Its colours are fixed: few markers cannot separate light from their colour. With the last colour another detector takes
over (`changing`), which follows the light.
"""

from collections.abc import Collection

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.engine import NUMPY, Engine
from slave.markers.null_detector import NullDetector


class CalibratedDetector:
    """Holds the detector of the markers that have a colour, if any has.

    Attributes:
        missing: Markers without a colour, which are never seen.
    """

    def __init__(
        self,
        camera: CameraCalibration,
        markers: tuple[str, ...],
        engine: Engine = NUMPY,
        free: Collection[str] = (),
    ) -> None:
        """Build the detector.

        Arguments are as of `MarkerDetector`, but the camera may lack colours.
        """
        calibrated = tuple(name for name in markers if name in (camera.markers or {}))
        self.missing = tuple(name for name in markers if name not in calibrated)
        self._rows = [markers.index(name) for name in calibrated]
        self._count = len(markers)
        self._nothing = NullDetector(len(markers))
        self._plain = None
        if calibrated:
            mine = [name for name in free if name in calibrated]
            self._plain = MarkerDetector(camera, calibrated, engine=engine, free=mine)

    @property
    def plain(self) -> MarkerDetector | None:
        """What detects; None: nothing does."""
        return self._plain

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame; arguments and errors as of `MarkerDetector.push`."""
        if self._plain is None:
            return self._nothing.push(image, t_ns)
        found = self._plain.push(image, t_ns)
        return Detections(*(self._spread(getattr(found, name)) for name in Detections.__slots__))

    def tune(self, camera: CameraCalibration) -> None:
        """As of `MarkerDetector`."""
        if self._plain is not None:
            self._plain.tune(camera)

    def _spread(self, rows: Float) -> Float:
        """Rows of all markers, NaN where the colour is not known."""
        every = np.full((self._count, *rows.shape[1:]), np.nan)
        every[self._rows] = rows
        return every
