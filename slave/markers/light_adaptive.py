"""A marker detector whose colours follow the light.

The ranges of a camera file hold under the light of calibration. Here the detector is given, as the light moves, tables
that see the picture as under that light. A table takes a few frames to make on a small machine, so it is made by
`workers`: a thread of its own on a live slave, `Inline` where every run must give the same.

Where the table is far from the light, or the light is not known and the markers do not fit it, one marker could be
taken for another: then nothing is reported seen, and a warning states why.
"""

from collections.abc import Collection, Mapping
from concurrent.futures import Future
from copy import copy
from functools import partial

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration
from common.geometry.srgb import gain_tables
from slave.markers.classify import ColourTable, table_of
from slave.markers.colour_monitor import ColourMonitor, ColourWarning
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.engine import NUMPY, Engine
from slave.markers.white_balance import WhiteBalance, apart
from slave.markers.workers import Workers

REFUSE = 0.2  # and from which the old one may take one marker for another: three to six hues


class LightAdaptiveDetector:
    """Marker detector whose colours follow the light.

    Holds the light, the table in use and the one being made.

    Attributes:
        warnings: What is to be warned of as of the last frame.
        refused: Frames in which nothing was reported because the colours were not fit for the light.
        tables: How many tables were made.
    """

    def __init__(
        self,
        camera: CameraCalibration,
        markers: tuple[str, ...],
        workers: Workers,
        initial_uv: Mapping[str, tuple[float, float]] | None = None,
        engine: Engine = NUMPY,
        free: Collection[str] = (),
    ) -> None:
        """Build the detector and its colour table (0.3 s).

        Args:
            camera: Camera file; every marker has a range with its reference colour.
            markers: Marker names in the order of the rig.
            workers: Where tables are made and a first light is sought.
            seeds: As of `MarkerDetector`.
            engine, free: As of `MarkerDetector`.

        Raises:
            CalibrationError: The camera has no colour range for a marker.
            ValueError: A range has no reference colour; see `can_adapt`.
        """
        self._table = table_of(markers, camera.markers, f"camera {camera.name!r}")
        ranges = camera.markers or {}
        reference = np.array([ranges[name].reference_bgr_linear or (np.nan,) * 3 for name in markers])
        self._detector = MarkerDetector(camera, markers, initial_uv, self._table, engine, free)
        self._light = WhiteBalance(self._table, reference, (camera.width_px, camera.height_px), workers)
        self._watch = ColourMonitor(markers, ranges)
        self._workers, self._engine = workers, engine
        self._in_use = np.zeros(3)  # log gains of the table in use
        self._making: tuple[Float, Future[ColourTable]] | None = None
        self._look_next = False
        self._near: list[ColourWarning] = []
        self.warnings: list[ColourWarning] = []
        self.refused = 0
        self.tables = 0

    @property
    def log_gains(self) -> Float:
        """Log gains (3,) of the light against calibration, blue, green, red."""
        return self._light.log_gains

    @property
    def trusted(self) -> bool:
        """Return whether markers may be distinguished by their colours.

        The light must be known and the table made for it.
        """
        return self._light.trusted and apart(self.log_gains, self._in_use) <= REFUSE

    @property
    def plain(self) -> MarkerDetector:
        """What detects, with the colours of the light as far as they are followed."""
        return self._detector

    def adopt(self, other: "LightAdaptiveDetector") -> None:
        """Take over the tracks and counts of another detector.

        The light stays the one that this detector knows.
        """
        self._detector.adopt(other._detector)
        self.refused, self.tables = other.refused, other.tables + self.tables

    def tune(self, camera: CameraCalibration) -> None:
        """Apply a changed camera file, as `MarkerDetector` does.

        What an exposure does to the colours is seen as a change of the light.
        """
        self._detector.tune(camera)

    def fresh(self, initial_uv: Mapping[str, tuple[float, float]] | None = None) -> "LightAdaptiveDetector":
        """Return a detector of the same camera and light that has seen no marker yet."""
        other = copy(self)
        other._detector = self._detector.fresh(initial_uv)
        return other

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame.

        Args:
            image: (H, W, 3) BGR of the camera's size.
            t_ns: Time of the frame [ns], rising; only differences matter.

        Raises:
            ValueError: The image is not of the camera's size, or not 8-bit colour.
        """
        image = np.ascontiguousarray(image)
        self._light.look(image, t_ns)
        self._adapt()
        found = self._detector.push(image, t_ns)
        stale = apart(self.log_gains, self._in_use) > REFUSE
        if self._light.proven and not stale:
            self._learn(found, t_ns)
        self.warnings = [*self._near, *self._light.warnings()]
        if stale or not self._light.trusted:
            self.refused += 1
            return found.nothing()
        return found

    def _learn(self, found: Detections, t_ns: int) -> None:
        """Learn the light, and check the colour margins in the next frame.

        Split over two frames so that none takes long.
        """
        if self._look_next:
            undone = found.colour * np.exp(-self.log_gains)
            self._near = self._watch.push(undone, found.clarity, t_ns)
            self._look_next = False
        else:
            self._look_next = self._light.learn(found.colour, found.clarity, t_ns) is not None

    def _adapt(self) -> None:
        """Have a table made where the light has moved; use the one that is ready."""
        step = 0.08  # log gains of red or blue against green from which a new table is made: one or two hues
        if self._making is None and apart(self.log_gains, self._in_use) > step:
            gains = self.log_gains
            self._making = (
                gains,
                self._workers.submit(partial(_white_balanced, self._table, gains, self._engine)),
            )
        if self._making is not None and self._making[1].done():
            (self._in_use, job), self._making = self._making, None
            blue, green, red = np.exp(self._in_use).tolist()
            self._detector.recolour(job.result(), (blue, green, red))
            self.tables += 1


def _white_balanced(table: ColourTable, log_gains: Float, engine: Engine) -> ColourTable:
    """A table for pictures under a light of these log gains (3,), ready for use."""
    white_balanced = table.white_balanced(gain_tables(np.exp(-log_gains)))
    engine.prepare(white_balanced)
    return white_balanced


def detector_for(
    camera: CameraCalibration,
    markers: tuple[str, ...],
    workers: Workers,
    initial_uv: Mapping[str, tuple[float, float]] | None = None,
    engine: Engine = NUMPY,
    free: Collection[str] = (),
) -> LightAdaptiveDetector | MarkerDetector:
    """Return a light-adaptive detector where the camera file allows it.

    Else one with fixed colours.

    Raises:
        CalibrationError: The camera has no colour range for a marker.
    """
    if can_adapt(camera, markers):
        return LightAdaptiveDetector(camera, markers, workers, initial_uv, engine, free)
    return MarkerDetector(camera, markers, initial_uv, None, engine, free)


def can_adapt(camera: CameraCalibration, markers: tuple[str, ...]) -> bool:
    """Return whether the camera file has every marker's look at calibration."""
    ranges = camera.markers or {}
    return all(name in ranges and ranges[name].reference_bgr_linear is not None for name in markers)
