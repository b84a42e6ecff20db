r"""Detect five fingers in the frames of a wrist camera.

frame -> strobe -> cycle --- LED less ambient ---> seams between the fingers
                         \-- laser less ambient -> where the laser meets each finger -> fingertips

Two strobe cycles have nothing to do with each other: no pose is kept.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.messages import WristDetections
from slave.sources import Frame
from slave.tuning import CameraFiles, Prepare
from slave.wrist.engine import NUMPY, Engine
from slave.wrist.fingertips import NO_TIPS, Fingertips, fingertips
from slave.wrist.laser import LaserLines, laser_lines, separate
from slave.wrist.led_image import WristView
from slave.wrist.palm_pose import prepare
from slave.wrist.postures import postures_of
from slave.wrist.seams import search_bands_of
from slave.wrist.strobe import Strobe, StrobeCycle, lit, lit_line
from slave.wrist.workspace import workspace_of


@dataclass(frozen=True, slots=True, eq=False)
class WristFound:
    """Detections in one strobe cycle."""

    cycle: StrobeCycle  # the frames
    laser: LaserLines  # where the laser meets each finger
    tips: Fingertips

    def message(self, camera: str, session: int) -> WristDetections:
        """What the camera called `camera` of process `session` sends of it."""
        cycle = self.cycle
        return WristDetections(
            camera,
            session,
            cycle.laser.seq,
            cycle.laser.t_ns,
            max(frame.ready_t_ns for frame in (cycle.ambient, cycle.laser, cycle.led)),
            self.laser.uv,
            self.laser.sigma_px,
            self.laser.length_px,
            self.tips.uv,
            self.tips.sigma_px,
            self.tips.depth,
            cycle.laser.t_sigma_ns,
            cycle.laser.exposure_us,
        )


class WristDetector:
    """Detector of a wrist camera, with recent detections for whoever shows them."""

    def __init__(self, view: WristView, frame_rate_hz: float, engine: Engine = NUMPY) -> None:
        """Begin with no frame; it takes a second or two to prepare the view."""
        self._strobe = Strobe(frame_rate_hz)
        self._engine = engine
        recent = 4  # strobe cycles
        self._found: deque[tuple[int, Float, Float]] = deque(maxlen=recent)
        self._view = prepared(view, engine)

    @property
    def counts(self) -> dict[str, int]:
        """Those of the strobe: event -> how often. From any thread."""
        return dict(self._strobe.counts)

    def push(self, frame: Frame) -> WristFound | None:
        """Take the next frame; return detections where it completes a strobe cycle."""
        cycle = self._strobe.push(frame)
        if cycle is None:
            return None
        found = find(cycle, self._view, self._engine)
        self._found.append((cycle.led.t_ns, found.laser.uv, found.tips.uv))
        return found

    def found(self, t_ns: int) -> tuple[Float, Float] | None:
        """Laser points, tips (5, 2) [px] by LED time; NaN: not seen; None: none so old."""
        return next(((laser, tips) for at_ns, laser, tips in tuple(self._found) if at_ns == t_ns), None)

    def replace(self, view: WristView) -> None:
        """Use another, prepared view from the next strobe cycle on. From any thread."""
        self._view = view


def prepared(view: WristView, engine: Engine = NUMPY) -> WristView:
    """Return the same view once all that depends on it alone is made and cached.

    A cycle in which all is dark goes through the whole line, so that the first real one takes no longer than others.
    """
    postures_of(view)
    for rotated_view in prepare(view):
        search_bands_of(rotated_view)
        workspace_of(rotated_view)
    dark = Frame(0, 0, 0, np.zeros((view.optics.height_px, view.optics.width_px), np.uint8))
    find(StrobeCycle(dark, dark, dark), view, engine)
    return view


def find(cycle: StrobeCycle, view: WristView, engine: Engine = NUMPY) -> WristFound:
    """Detect the five fingers in one strobe cycle."""
    ambient = cycle.ambient.image
    led = lit(cycle.led.image, ambient)
    fingers = separate(led, view, engine)
    laser = laser_lines(lit_line(cycle.laser.image, ambient), fingers, view, engine)
    # A bent wrist turns fingers before the camera in ways that no posture of the tables has.
    tips = NO_TIPS
    if fingers.palm_pose.straight:
        tips = fingertips(led, cycle.led.image, laser.uv, view, engine.candidates)
    return WristFound(cycle, laser, tips)


def view_of(files: CameraFiles) -> WristView:
    """View of camera, rig and hand; CalibrationError names file and key it lacks."""
    if files.hand is None:
        raise CalibrationError(
            f"{files.rig_path}: hand: the profile {files.rig.hand!r} of a wrist rig is not loaded"
        )
    try:
        return WristView.of(files.rig, files.camera, files.hand)
    except CalibrationError as error:
        raise CalibrationError(f"{', '.join(map(str, files.paths))}: {error}") from error


def wrist_changes(detector: WristDetector) -> Prepare:
    """Return how changed files reach `detector`: with the next strobe cycle."""

    def prepare(old: CameraFiles, new: CameraFiles) -> Callable[[], None] | None:
        if (old.camera.intrinsics, old.rig, old.hand) == (new.camera.intrinsics, new.rig, new.hand):
            return None
        view = prepared(view_of(new))  # a second or two, and the last thing that may refuse
        return lambda: detector.replace(view)

    return prepare
