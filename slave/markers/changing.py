"""A detector that is replaced while it runs, by one for another camera file: between two frames, tracks go on.

A colour table takes as long as some tens of frames to make, so the new detector is made on another thread. Where it
follows the light it must know the light before it is of use: it looks at some frames beside the old one, on that thread
too, and takes over as soon as it may tell markers by their colours.
"""

from collections import deque
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration
from common.errors import CalibrationError, CameraError
from slave.cameras.passing import Passing
from slave.markers.colour_watch import ColourWarning
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.following import FollowingDetector
from slave.tuning import CameraFiles, Prepare

LOOKS = 60  # a first light takes some tens of frames to be proven, or is not there to be proven
TIMEOUT_S = 0.5
Changeable: TypeAlias = MarkerDetector | FollowingDetector


class ChangingDetector:
    """Holds the detector in use, the one that takes over with the next frame, and that frame's predecessor."""

    def __init__(self, detector: Changeable) -> None:
        """Begin with `detector`."""
        self._detector = detector
        self._next: deque[Changeable] = deque(maxlen=1)  # one thread fills it, another empties it
        self._frames = Passing[tuple[Image, int]]()

    def push(self, image: Image, t_ns: int) -> Detections:
        """Detect in one frame; arguments and errors as of `MarkerDetector.push`."""
        if self._next:
            coming = self._next.popleft()
            _hand_over(self._detector, coming)
            self._detector = coming
        self._frames.put((image, t_ns))
        return self._detector.push(image, t_ns)

    def expose(self, exposure_us: float) -> None:
        """The camera's exposure [us] has changed. From any thread."""
        self._detector.expose(exposure_us)

    def replace(self, detector: Changeable) -> None:
        """Let `detector`, of the same markers and kind, take over. Not from the loop's thread: it may take a second.

        Raises:
            ValueError: It follows the light and the one in use does not, or the other way round.
        """
        if type(detector) is not self.kind:
            raise ValueError(
                "a detector that follows the light and one that does not cannot replace each other"
            )
        if isinstance(detector, FollowingDetector):
            try:
                for image, t_ns in self._frames.following(LOOKS, TIMEOUT_S):
                    detector.push(image, t_ns)
                    if detector.trusted:
                        break
            except CameraError:
                pass  # no frames: it learns the light when they come, as at the start
        self._next.append(detector)

    @property
    def kind(self) -> type[Changeable]:
        """What the detector in use is, and every other must be."""
        return type(self._detector)

    @property
    def follows(self) -> bool:
        """Whether it follows the light."""
        return isinstance(self._detector, FollowingDetector)

    @property
    def warnings(self) -> list[ColourWarning]:
        """As of `FollowingDetector`; none where the colours are fixed."""
        return self._detector.warnings if isinstance(self._detector, FollowingDetector) else []

    @property
    def log_gains(self) -> Float:
        """Log gains (3,) of the light, blue, green, red; 0 where the colours are fixed."""
        return self._detector.log_gains if isinstance(self._detector, FollowingDetector) else np.zeros(3)

    @property
    def refused(self) -> int:
        """Frames in which nothing was reported because the colours were not fit for the light."""
        return self._detector.refused if isinstance(self._detector, FollowingDetector) else 0

    @property
    def tables(self) -> int:
        """Colour tables made for another light."""
        return self._detector.tables if isinstance(self._detector, FollowingDetector) else 0


def marker_changes(
    detector: ChangingDetector, make: Callable[[CameraCalibration, RigCalibration], Changeable]
) -> Prepare:
    """How changed files reach `detector`: what `make` makes of them takes over, where colours or markers changed."""

    def prepare(old: CameraFiles, new: CameraFiles) -> Callable[[], None] | None:
        made = None
        if (new.camera.markers, new.rig.free_markers) != (old.camera.markers, old.rig.free_markers):
            made = make(new.camera, new.rig)
            _refuse_other_kind(detector, made)
        if made is None and new.camera.exposure_us == old.camera.exposure_us:
            return None

        def switch() -> None:
            if made is not None:
                detector.replace(made)
            detector.expose(new.camera.exposure_us)

        return switch

    return prepare


def _refuse_other_kind(old: ChangingDetector, made: Changeable) -> None:
    if type(made) is not old.kind:
        change = "have" if old.follows else "did not have"
        raise CalibrationError(
            f"markers: reference_bgr_linear: the colours in use {change} it for every marker, and the light is "
            f"{'followed' if old.follows else 'not followed'}: restart the slave to change that"
        )


def _hand_over(old: Changeable, new: Changeable) -> None:
    match old, new:
        case (FollowingDetector(), FollowingDetector()):
            new.adopt(old)
        case (MarkerDetector(), MarkerDetector()):
            new.adopt(old)
        case _:
            raise AssertionError("`replace` lets no other kind in")
