"""The slave's loop: frame in, one sealed datagram out; where camera, detector and uplink meet.

A camera that looks for markers sends of every frame, the camera of a wrist device of every strobed triple.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np

from common.arrays import Image
from common.messages import MarkerDetections, Message, TagDetections
from slave.counters import Counters
from slave.markers.detector import Detections
from slave.sources import Frame, FrameSource
from slave.wrist.detector import WristFound


class Detector(Protocol):
    """What finds the markers; a `MarkerDetector` or a `LightAdaptiveDetector`."""

    def push(self, image: Image, t_ns: int) -> Detections:
        """Markers of one frame; times [ns] rise."""
        ...


class StrobedDetector(Protocol):
    """What finds the fingers before a wrist device; a `WristDetector`."""

    def push(self, frame: Frame) -> WristFound | None:
        """What was found, where the frame completes a strobed triple."""
        ...


class Tags(Protocol):
    """What finds the tags of objects; a `LiveTags`."""

    def push(self, frame: Frame, session: int, spent_ns: int) -> TagDetections | None:
        """Tags of a frame whose markers took `spent_ns`; None: not searched."""
        ...


class Sender(Protocol):
    """Where detections go; an `Uplink`."""

    @property
    def session(self) -> int:
        """Random id of this process."""
        ...

    def send(self, message: Message) -> None:
        """Send or count as unsent; never waits."""
        ...


class Barrier(Protocol):
    """What the master's start is waited for with; an `Uplink`."""

    def wait_for_start(self, timeout_s: float) -> bool:
        """Whether the start has come within the time."""
        ...


POLL_S = 0.2
DARK_AFTER = 9  # frames without a triple, 0.1 s at 90 Hz: then every frame is shown, lit or not


def nothing() -> None:
    """For whom nobody needs to be told that a loop came round."""


def wait_for_start(barrier: Barrier, stop: threading.Event, alive: Callable[[], None] = nothing) -> bool:
    """Wait for the master as long as it takes; False if told to stop before. `alive` is called every `POLL_S`."""
    while not stop.is_set():
        alive()
        if barrier.wait_for_start(POLL_S):
            return True
    return False


def run(
    source: FrameSource,
    detector: Detector,
    sender: Sender,
    camera: str,
    counters: Counters,
    stop: threading.Event,
    show: Callable[[Frame], None] = lambda _frame: None,
    tags: Tags | None = None,
    alive: Callable[[], None] = nothing,
) -> None:
    """Detect and send until the source ends or `stop` is set. A frame without any marker is sent as well.

    Tags are sought once the markers of the frame are sent. `show` is offered every frame after that; it must not wait.
    `alive` is called when a frame is done with. Whatever these raise costs that frame alone; where every frame fails,
    `alive` is not called, and a watchdog begins the process anew.

    Raises:
        CameraError: The camera is gone.
    """

    def work(frame: Frame) -> None:
        began_ns = time.perf_counter_ns()
        found = detector.push(frame.image, frame.t_ns)
        detect_ns = time.perf_counter_ns() - began_ns
        message = MarkerDetections(
            camera,
            sender.session,
            frame.seq,
            frame.t_ns,
            frame.ready_t_ns,
            found.uv,
            found.area,
            found.quality,
            found.sigma_px,
            found.alt_uv,
            frame.t_sigma_ns,
        )
        sender.send(message)
        counters.frame(frame.seq, detect_ns, found.uv)
        if tags is not None and (seen := tags.push(frame, sender.session, detect_ns)) is not None:
            sender.send(seen)
        show(frame)
        alive()

    _each_frame(source, stop, counters, work)


def run_wrist(
    source: FrameSource,
    detector: StrobedDetector,
    sender: Sender,
    camera: str,
    counters: Counters,
    stop: threading.Event,
    show: Callable[[Frame], None] = lambda _frame: None,
    alive: Callable[[], None] = nothing,
) -> None:
    """Detect and send until the source ends or `stop` is set. A triple without any finger is sent as well.

    `show` is offered the frame under the LEDs of every triple, and every frame while there are no triples. `alive` is
    called for every frame. Whatever these raise costs that frame alone, as in `run`.

    Raises:
        CameraError: The camera is gone.
    """
    took_ns: deque[int] = deque(maxlen=3)  # of the frames that may be a triple; those before are none of it
    parts = 0

    def work(frame: Frame) -> None:
        nonlocal parts
        began_ns = time.perf_counter_ns()
        found = detector.push(frame)
        took_ns.append(time.perf_counter_ns() - began_ns)
        if found is None:
            counters.part(frame.seq)
            parts += 1
            if parts > DARK_AFTER:
                show(frame)
        else:
            sender.send(found.message(camera, sender.session))
            counters.frame(frame.seq, sum(took_ns), np.vstack([found.laser.uv, found.tips.uv]))
            parts = 0
            show(found.cycle.led)
        alive()

    _each_frame(source, stop, counters, work)


def _each_frame(
    source: FrameSource, stop: threading.Event, counters: Counters, work: Callable[[Frame], None]
) -> None:
    """Do `work` with every frame until the source ends or `stop` is set.

    What it raises costs that frame alone.

    Raises:
        CameraError: The camera is gone.
    """
    while not stop.is_set() and (frame := source.read()) is not None:
        try:
            work(frame)
        except Exception as error:  # noqa: BLE001 - one frame; it is counted and logged
            counters.failed(frame.seq, error)
