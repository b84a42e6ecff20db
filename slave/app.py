"""The slave's loop: frame in, one sealed datagram out; where camera, detector and uplink meet."""

import threading
import time
from collections.abc import Callable
from typing import Protocol

from common.arrays import Image
from common.messages import MarkerDetections, Message
from slave.cameras.source import Frame, FrameSource
from slave.markers.detector import Detections
from slave.tally import Tally


class Detector(Protocol):
    """What finds the markers; a `MarkerDetector` or a `FollowingDetector`."""

    def push(self, image: Image, t_ns: int) -> Detections:
        """Markers of one frame; times [ns] rise."""
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


def wait_for_start(barrier: Barrier, stop: threading.Event) -> bool:
    """Wait for the master as long as it takes; False if told to stop before."""
    while not stop.is_set():
        if barrier.wait_for_start(POLL_S):
            return True
    return False


def run(
    source: FrameSource,
    detector: Detector,
    sender: Sender,
    camera: str,
    tally: Tally,
    stop: threading.Event,
    show: Callable[[Frame], None] = lambda _frame: None,
) -> None:
    """Detect and send until the source ends or `stop` is set. A frame without any marker is sent as well.

    `show` is offered every frame once its message is sent; it must not wait.

    Raises:
        CameraError: The camera is gone.
    """
    while not stop.is_set() and (frame := source.read()) is not None:
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
            found.rival_uv,
            frame.t_sigma_ns,
        )
        sender.send(message)
        tally.frame(frame.seq, detect_ns, found.uv)
        show(frame)
