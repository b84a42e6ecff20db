"""A real camera that is unplugged and comes back: opened anew without restarting the slave.

An error while the camera is opened for the first time is an error. Once it has run, losing it is an event: it is
given back, and opened again after 0.2 s, 0.4 s … at most 2 s, until it is there or the slave is told to stop. Every
opening writes and checks all settings again, as they were last changed. `seq` keeps rising, by as many frames as fit
into the absence, so that those count as dropped.
"""

import logging
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError
from slave.cameras.settings import Tunable
from slave.cameras.source import Frame, FrameSource
from slave.service import Away, nobody

FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 1.0  # what is plugged in again tracks within two seconds
LOG_EVERY_NS = 10_000_000_000
_LOG = logging.getLogger(__name__)


class ReopeningCamera:
    """A `FrameSource` around one that can be lost.

    Holds the open camera, if there is one, its settings, the number and time of the last frame, and in `lost` how
    often the camera went away.
    """

    def __init__(
        self,
        opener: Callable[[CameraCalibration], FrameSource],
        camera: CameraCalibration,
        clock: Clock,
        stop: threading.Event,
        away: Away = nobody,
    ) -> None:
        """Open the camera.

        Args:
            opener: Opens the camera with these settings; called again after each loss.
            camera: Its settings at first. Its rate counts the frames of an absence.
            clock: The clock of the frames' times.
            stop: Set when the slave is to end; `read` then gives up waiting for a camera.
            away: Told that it is lost, and of each try to open it again.

        Raises:
            CameraError: The camera is not there or refused a setting.
        """
        self._open = opener
        self._camera = camera
        self._clock = clock
        self._stop = stop
        self._away = away
        self._closed = threading.Event()
        self._source: FrameSource | None = opener(camera)
        self._base = 0  # added to the camera's own numbers
        self._fresh = False  # the next frame is the first one after a loss
        self._last: tuple[int, int] | None = None  # seq, t_ns
        self._wait_s = FIRST_WAIT_S
        self._said_ns: int | None = None
        self._past: Counter[str] = Counter()  # of the cameras that were given back
        self.lost = 0

    def read(self) -> Frame | None:
        """Next frame; waits for a lost camera. None at the end of the stream, when stopped, or once closed."""
        while True:
            source = self._source if self._source is not None else self._return()
            if source is None or self._closed.is_set():
                return None
            try:
                frame = source.read()
            except CameraError as error:
                self.lost += 1
                self._away(f"camera lost: {error}")
                self._say(f"lost: {error}")
                self._drop()
                continue
            return None if frame is None else self._number(frame)

    def close(self) -> None:
        """Give the camera back. Safe to call twice, and from another thread that ends a wait."""
        self._closed.set()
        self._drop()

    def tune(self, camera: CameraCalibration) -> None:
        """Change the settings of the open camera, and of every one that is opened from now on.

        Raises:
            CameraError: It is away, or did not take them.
        """
        source = self._source
        if not isinstance(source, Tunable):
            raise CameraError(f"camera {camera.name!r} is away: its settings can be changed when it is back")
        source.tune(camera)
        self._camera = camera

    def figures(self) -> dict[str, float]:
        """Those of the open camera; none while it is away."""
        source = self._source
        return source.figures() if isinstance(source, Tunable) else {}

    def counts(self) -> dict[str, int]:
        """`camera.lost`, and the events of all cameras that were opened."""
        source = self._source
        counts = Counter({"camera.lost": self.lost})
        counts.update(self._past)
        counts.update(source.counts() if isinstance(source, Tunable) else {})
        return dict(counts)

    def _drop(self) -> None:
        source, self._source = self._source, None
        if source is None:
            return
        if isinstance(source, Tunable):
            self._past.update(source.counts())
        try:
            source.close()
        except CameraError as error:
            self._say(f"could not be given back: {error}")

    def _return(self) -> FrameSource | None:
        """Open until it works; None when told to stop."""
        while not (self._stop.wait(self._wait_s) or self._closed.is_set()):
            self._wait_s = min(2.0 * self._wait_s, LONGEST_WAIT_S)  # until a frame has come
            try:
                self._source, self._fresh = self._open(self._camera), True
            except CameraError as error:
                self._away(f"camera away: {error}")
                self._say(f"still away: {error}")
                continue
            if self._closed.is_set():  # while it was being opened
                self._drop()
            return self._source
        return None

    def _number(self, frame: Frame) -> Frame:
        """The frame with a number that goes on where the last camera ended."""
        if self._fresh:
            _LOG.warning("camera: back after loss number %d", self.lost)
            self._said_ns, self._wait_s, self._fresh = None, FIRST_WAIT_S, False
            if self._last is not None:
                seq, t_ns = self._last
                self._base = (
                    seq + max(1, round((frame.t_ns - t_ns) * 1e-9 * self._camera.frame_rate_hz)) - frame.seq
                )
        seq = frame.seq + self._base
        self._last = (seq, frame.t_ns)
        return frame if self._base == 0 else replace(frame, seq=seq)

    def _say(self, text: str) -> None:
        """Log the first event of an absence at once, further ones every ten seconds."""
        now_ns = self._clock.now_ns()
        if self._said_ns is None or now_ns - self._said_ns >= LOG_EVERY_NS:
            self._said_ns = now_ns
            _LOG.warning("camera: %s", text)
