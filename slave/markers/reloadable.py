"""Wrap the detector: colours follow the light, and the camera file may change.

`CalibratedDetector` detects the markers whose colours are known, by fixed colours: few markers cannot separate light
from their colour. `LightAdaptiveDetector` reads the ranges as under the light of calibration; a table takes a few
frames to make, so `workers` make it: a thread on a live slave, `Inline` where every run must give the same. Where the
table is far from the light, or the light is not known, nothing is reported seen, and a warning states why.
`ReloadableDetector` switches to the detector of a changed camera file between two frames and keeps the tracks. One
that follows the light first looks at some frames on another thread, until it may distinguish markers by their
colours.
"""

import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Executor, Future
from copy import copy
from typing import TypeAlias

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration
from common.errors import CalibrationError, CameraError
from common.geometry.srgb import gain_tables
from slave.cameras.settings import FrameObserver
from slave.markers.classify import ColourTable, table_of
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.engine import NUMPY, Engine
from slave.markers.illuminant import gain_difference
from slave.markers.scan import ScanChoice
from slave.markers.white_balance import ColourMonitor, ColourWarning, WhiteBalance
from slave.tuning import CameraFiles, Prepare


class CalibratedDetector:
    """Detector of the markers that have a colour; those `missing` are never seen.

    `plain`: what detects; None: nothing does.
    """

    def __init__(
        self,
        camera: CameraCalibration,
        markers: tuple[str, ...],
        engine: Engine = NUMPY,
        free: Collection[str] = (),
    ) -> None:
        """Build it as `MarkerDetector` is built; the camera may lack colours."""
        calibrated = tuple(name for name in markers if name in (camera.markers or {}))
        self.missing = tuple(name for name in markers if name not in calibrated)
        self._rows = [markers.index(name) for name in calibrated]
        self._count = len(markers)
        self.plain: MarkerDetector | None = None
        if calibrated:
            mine = [name for name in free if name in calibrated]
            self.plain = MarkerDetector(camera, calibrated, engine=engine, free=mine)

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame; arguments and errors as of `MarkerDetector.push`."""
        every = Detections.none(self._count)
        if self.plain is not None:
            found = self.plain.push(image, t_ns)
            for name in Detections.__slots__:
                getattr(every, name)[self._rows] = getattr(found, name)
        return every

    def tune(self, camera: CameraCalibration) -> None:
        """As of `MarkerDetector`."""
        if self.plain is not None:
            self.plain.tune(camera)


# log gains of red or blue against green by which a table may take one marker for another: three to six hues
REFUSE = 0.2


class LightAdaptiveDetector:
    """Marker detector whose colours follow the light.

    Attributes:
        plain: What detects, with the colours of the light as far as they are followed.
        warnings: What is to be warned of as of the last frame.
        refused: Frames in which nothing was reported because the colours were not fit for the light.
        tables: How many tables were made.
    """

    def __init__(
        self,
        camera: CameraCalibration,
        markers: tuple[str, ...],
        workers: Executor,
        initial_uv: Mapping[str, tuple[float, float]] | None = None,
        engine: Engine = NUMPY,
        free: Collection[str] = (),
    ) -> None:
        """Build the detector and its colour table (0.3 s), as `MarkerDetector`.

        Tables are made, and a first light is sought, by `workers`. Raises CalibrationError: the camera has no colour
        range for a marker; ValueError: a range has no reference colour, see `can_adapt`.
        """
        self._table = table_of(markers, camera.markers, f"camera {camera.name!r}")
        ranges = camera.markers or {}
        reference = np.array([ranges[name].reference_bgr_linear or (np.nan,) * 3 for name in markers])
        self.plain = MarkerDetector(camera, markers, initial_uv, self._table, engine, free)
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
        """Whether colours distinguish markers: light known, and table made for it."""
        return self._light.trusted and gain_difference(self.log_gains, self._in_use) <= REFUSE

    def adopt(self, other: "LightAdaptiveDetector") -> None:
        """Take over the tracks and counts, not the light, of another detector."""
        self.plain.adopt(other.plain)
        self.refused, self.tables = other.refused, other.tables + self.tables

    def tune(self, camera: CameraCalibration) -> None:
        """As of `MarkerDetector`; colours see an exposure as a change of the light."""
        self.plain.tune(camera)

    def fresh(self, initial_uv: Mapping[str, tuple[float, float]] | None = None) -> "LightAdaptiveDetector":
        """Return a detector of the same camera and light that has seen no marker yet."""
        other = copy(self)
        other.plain = self.plain.fresh(initial_uv)
        return other

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame; arguments and errors as of `MarkerDetector.push`."""
        image = np.ascontiguousarray(image)
        self._light.look(image, t_ns)
        self._adapt()
        found = self.plain.push(image, t_ns)
        stale = gain_difference(self.log_gains, self._in_use) > REFUSE
        if self._light.proven and not stale:
            self._learn(found, t_ns)
        self.warnings = [*self._near, *self._light.warnings()]
        if stale or not self._light.trusted:
            self.refused += 1
            return Detections.none(len(found.area))
        return found

    def _learn(self, found: Detections, t_ns: int) -> None:
        """Learn the light, and check the colour margins in the frame after."""
        if self._look_next:
            undone = found.colour * np.exp(-self.log_gains)
            self._near = self._watch.push(undone, found.clarity, t_ns)
            self._look_next = False
        else:
            self._look_next = self._light.learn(found.colour, found.clarity, t_ns)

    def _adapt(self) -> None:
        """Have a table made where the light has moved; use the one that is ready."""
        step = 0.08  # log gains of red or blue against green from which a new table is made: one or two hues
        if self._making is None and gain_difference(self.log_gains, self._in_use) > step:
            gains = self.log_gains
            self._making = gains, self._workers.submit(_white_balanced, self._table, gains, self._engine)
        if self._making is not None and self._making[1].done():
            (self._in_use, job), self._making = self._making, None
            blue, green, red = np.exp(self._in_use).tolist()
            self.plain.recolour(job.result(), (blue, green, red))
            self.tables += 1


def _white_balanced(table: ColourTable, log_gains: Float, engine: Engine) -> ColourTable:
    """A table for pictures under a light of these log gains (3,), ready for use."""
    white_balanced = table.white_balanced(gain_tables(np.exp(-log_gains)))
    engine.prepare(white_balanced)
    return white_balanced


def detector_for(
    camera: CameraCalibration,
    markers: tuple[str, ...],
    workers: Executor,
    initial_uv: Mapping[str, tuple[float, float]] | None = None,
    engine: Engine = NUMPY,
    free: Collection[str] = (),
) -> LightAdaptiveDetector | MarkerDetector:
    """A light-adaptive detector, or one of fixed colours; CalibrationError as those."""
    if can_adapt(camera, markers):
        return LightAdaptiveDetector(camera, markers, workers, initial_uv, engine, free)
    return MarkerDetector(camera, markers, initial_uv, None, engine, free)


def can_adapt(camera: CameraCalibration, markers: tuple[str, ...]) -> bool:
    """Return whether the camera file has every marker's look at calibration."""
    ranges = camera.markers or {}
    return all(name in ranges and ranges[name].reference_bgr_linear is not None for name in markers)


TIMEOUT_S = 0.5
AnyDetector: TypeAlias = MarkerDetector | LightAdaptiveDetector | CalibratedDetector


class ReloadableDetector:
    """Detector that can be replaced; `choice`: to scan whole frames, None: always."""

    def __init__(
        self,
        detector: AnyDetector,
        choice: ScanChoice | None = None,
        processor_ns: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        """Begin with `detector`; `processor_ns`: processor time [ns] of this thread."""
        self._detector = detector
        self.choice, self._processor_ns = choice, processor_ns
        self._next: deque[AnyDetector] = deque(maxlen=1)  # one thread fills it, another empties it
        self._frames = FrameObserver[tuple[Image, int]]()
        recent = 8  # frames whose detections are kept for whoever shows one of them
        self._found: deque[tuple[int, Float]] = deque(maxlen=recent)

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame; arguments and errors as of `MarkerDetector.push`."""
        if self._next:
            old, new = self._detector, self._next.popleft()
            if isinstance(old, LightAdaptiveDetector) and isinstance(new, LightAdaptiveDetector):
                new.adopt(old)
            elif old.plain is not None and new.plain is not None:
                new.plain.adopt(old.plain)
            self._detector = new
        self._frames.put((image, t_ns))
        found = self._detect(image, t_ns)
        self._found.append((t_ns, found.uv))
        return found

    def _detect(self, image: Image, t_ns: int) -> Detections:
        plain, choice = self.plain, self.choice
        if plain is None or choice is None:
            return self._detector.push(image, t_ns)
        plain.windows_only = choice.windows
        began_ns = self._processor_ns()
        found = self._detector.push(image, t_ns)
        choice.push(self._processor_ns() - began_ns)
        return found

    def tune(self, camera: CameraCalibration) -> None:
        """The camera has another exposure, rate or margin. From any thread."""
        self._detector.tune(camera)
        if self.choice is not None:
            self.choice.tune(camera)

    def replace(self, detector: AnyDetector) -> None:
        """Let `detector` take over. Not from the loop's thread: it may take a second."""
        if isinstance(detector, LightAdaptiveDetector):
            try:
                # a first light takes some tens of frames to be proven, or is not there to be proven
                looks = 60
                for image, t_ns in self._frames.following(looks, TIMEOUT_S):
                    detector.push(image, t_ns)
                    if detector.trusted:
                        break
            except CameraError:
                pass  # no frames: it learns the light when they come, as at the start
        self._next.append(detector)

    @property
    def newest(self) -> tuple[Image, int] | None:
        """The last frame and its time [ns]; None before the first. From any thread."""
        return self._frames.newest

    def found(self, t_ns: int) -> Float | None:
        """Centroids (M, 2) [px] at `t_ns`, NaN: not seen; None: too old. From any thread."""
        return next((uv for at_ns, uv in tuple(self._found) if at_ns == t_ns), None)

    @property
    def plain(self) -> MarkerDetector | None:
        """The present plain detector; None: no colour is known. From any thread."""
        return self._detector.plain

    @property
    def adaptive(self) -> LightAdaptiveDetector | None:
        """The present detector if it follows the light. From any thread."""
        return self._detector if isinstance(self._detector, LightAdaptiveDetector) else None

    @property
    def missing(self) -> tuple[str, ...]:
        """Markers without a colour, not sought as of the next frame. From any thread."""
        coming = tuple(self._next)
        latest = coming[-1] if coming else self._detector
        return latest.missing if isinstance(latest, CalibratedDetector) else ()


def marker_changes(
    detector: ReloadableDetector, make: Callable[[CameraCalibration, RigCalibration], AnyDetector]
) -> Prepare:
    """Return how changed files reach `detector`: `make` where colours changed."""

    def prepare(old: CameraFiles, new: CameraFiles) -> Callable[[], None] | None:
        made = None
        if (old.camera.markers, old.rig.free_markers) != (new.camera.markers, new.rig.free_markers):
            made = make(new.camera, new.rig)
            if detector.adaptive is not None and isinstance(made, MarkerDetector):
                raise CalibrationError(
                    "markers: reference_bgr_linear: the colours in use have it for every marker, and the light is "
                    "followed: restart the slave to change that"
                )
        tuned = any(
            getattr(old.camera, name) != getattr(new.camera, name)
            for name in ("exposure_us", "roi_margin", "frame_rate_hz")
        )
        if made is None and not tuned:
            return None

        def switch() -> None:
            if made is not None:
                detector.replace(made)
            detector.tune(new.camera)

        return switch

    return prepare
