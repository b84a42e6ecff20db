"""Detector that is replaced at run time by one for another camera file.

The change happens between two frames; tracks are kept.

A colour table takes as long as some tens of frames to make, so the new detector is made on another thread. Where it
follows the light it must know the light before it is of use: it looks at some frames beside the old one, on that thread
too, and takes over as soon as it may distinguish markers by their colours.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration
from common.errors import CalibrationError, CameraError
from slave.cameras.settings import FrameObserver
from slave.markers.calibrated import CalibratedDetector
from slave.markers.colour_monitor import ColourWarning
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.light_adaptive import LightAdaptiveDetector
from slave.markers.scan_choice import ScanChoice
from slave.tuning import CameraFiles, Prepare

TIMEOUT_S = 0.5
AnyDetector: TypeAlias = MarkerDetector | LightAdaptiveDetector | CalibratedDetector


class ReloadableDetector:
    """Marker detector that can be replaced between two frames.

    Holds the detector in use, the one that takes over with the next frame, that frame's predecessor, and recent
    detections. Attribute `choice`: whether whole frames are scanned; None: they are.
    """

    def __init__(
        self,
        detector: AnyDetector,
        choice: ScanChoice | None = None,
        processor_ns: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        """Begin with `detector`.

        `processor_ns` returns the processor time [ns] that this thread has had.
        """
        self._detector = detector
        self.choice, self._processor_ns = choice, processor_ns
        self._next: deque[AnyDetector] = deque(maxlen=1)  # one thread fills it, another empties it
        self._frames = FrameObserver[tuple[Image, int]]()
        recent = 8  # frames whose detections are kept for whoever shows one of them
        self._found: deque[tuple[int, Float]] = deque(maxlen=recent)

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame; arguments and errors as of `MarkerDetector.push`."""
        if self._next:
            coming = self._next.popleft()
            _hand_over(self._detector, coming)
            self._detector = coming
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
        """Let `detector`, of the same markers, take over.

        Not from the loop's thread: it may take a second.
        """
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
        """Return the centroids (M, 2) [px] in the frame of a time [ns].

        NaN: not seen; None: too long ago. From any thread.
        """
        return next((uv for at_ns, uv in tuple(self._found) if at_ns == t_ns), None)

    @property
    def plain(self) -> MarkerDetector | None:
        """Return the present plain detector with its colour table.

        None: no colour is known. From any thread.
        """
        return plain_of(self._detector)

    @property
    def missing(self) -> tuple[str, ...]:
        """Return the markers without a colour, which are not sought.

        Or will not be sought from the next frame on. From any thread.
        """
        coming = tuple(self._next)
        latest = coming[-1] if coming else self._detector
        return latest.missing if isinstance(latest, CalibratedDetector) else ()

    @property
    def adapts(self) -> bool:
        """Whether it follows the light."""
        return isinstance(self._detector, LightAdaptiveDetector)

    @property
    def warnings(self) -> list[ColourWarning]:
        """As of `LightAdaptiveDetector`; none where the colours are fixed."""
        return self._detector.warnings if isinstance(self._detector, LightAdaptiveDetector) else []

    @property
    def log_gains(self) -> Float:
        """Log gains (3,) of the light, blue, green, red; 0 where the colours are fixed."""
        return self._detector.log_gains if isinstance(self._detector, LightAdaptiveDetector) else np.zeros(3)

    @property
    def refused(self) -> int:
        """Count the frames without a report because the colours did not fit the light."""
        return self._detector.refused if isinstance(self._detector, LightAdaptiveDetector) else 0

    @property
    def tables(self) -> int:
        """Colour tables made for another light."""
        return self._detector.tables if isinstance(self._detector, LightAdaptiveDetector) else 0


def marker_changes(
    detector: ReloadableDetector, make: Callable[[CameraCalibration, RigCalibration], AnyDetector]
) -> Prepare:
    """Return how changed files reach `detector`.

    What `make` makes of them takes over, where colours or markers changed.
    """

    def prepare(old: CameraFiles, new: CameraFiles) -> Callable[[], None] | None:
        made = None
        looks = [(files.camera.markers, files.rig.free_markers) for files in (old, new)]
        if looks[0] != looks[1]:
            made = make(new.camera, new.rig)
            _refuse_blinding(detector, made)
        tuned = [
            (files.camera.exposure_us, files.camera.roi_margin, files.camera.frame_rate_hz)
            for files in (old, new)
        ]
        if made is None and tuned[0] == tuned[1]:
            return None

        def switch() -> None:
            if made is not None:
                detector.replace(made)
            detector.tune(new.camera)

        return switch

    return prepare


def _refuse_blinding(old: ReloadableDetector, made: AnyDetector) -> None:
    if old.adapts and isinstance(made, MarkerDetector):
        raise CalibrationError(
            "markers: reference_bgr_linear: the colours in use have it for every marker, and the light is followed: "
            "restart the slave to change that"
        )


def plain_of(detector: AnyDetector) -> MarkerDetector | None:
    """What detects; None: nothing does."""
    return detector if isinstance(detector, MarkerDetector) else detector.plain


def _hand_over(old: AnyDetector, new: AnyDetector) -> None:
    if isinstance(old, LightAdaptiveDetector) and isinstance(new, LightAdaptiveDetector):
        new.adopt(old)
        return
    before, after = plain_of(old), plain_of(new)
    if before is not None and after is not None:
        after.adopt(before)
