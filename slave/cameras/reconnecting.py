"""A real camera that is unplugged and comes back: opened anew without restarting the slave.

An error while the camera is opened for the first time is an error. Once it has run, losing it is an event: it is
given back, and opened again after 0.2 s, 0.4 s … at most 2 s, until it is there or the slave is told to stop. Every
opening writes and checks all settings again, as they were last changed. `seq` keeps rising, by as many frames as fit
into the absence, so that those count as dropped.

Whatever a driver raises is a loss of its camera, also what is no `CameraError`. A camera that repeats one picture with
new stamps measures nothing: the copies are left out, and after a second of them it is opened again as one that is lost.
"""

import threading
from collections import Counter
from collections.abc import Callable

from msgspec.structs import replace

from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError
from slave.cameras.repeated import RepeatedPictures
from slave.failures import Failures
from slave.service import ConnectionLost, nobody
from slave.sources import Frame, FrameSource, Tunable

FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 1.0  # what is plugged in again tracks within two seconds
FROZEN_NS = 1_000_000_000


class ReconnectingCamera:
    """A `FrameSource` around one that can be lost.

    Holds the open camera, if there is one, its settings, the number and time of the last frame, its picture, in `lost`
    how often the camera went away, and in `frozen` how many frames were copies of the one before.
    """

    def __init__(
        self,
        opener: Callable[[CameraCalibration], FrameSource],
        camera: CameraCalibration,
        clock: Clock,
        stop: threading.Event,
        connection_lost: ConnectionLost = nobody,
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
        self._connection_lost = connection_lost
        self._closed = threading.Event()
        self._source: FrameSource | None = opener(camera)
        self._base = 0  # added to the camera's own numbers
        self._fresh = False  # the next frame is the first one after a loss
        self._last: tuple[int, int] | None = None  # seq, t_ns
        self._wait_s = FIRST_WAIT_S
        self._past: Counter[str] = Counter()  # of the cameras that were given back
        self._pictures = RepeatedPictures()
        self._frozen_ns: int | None = None  # since when it repeats one
        self._failures = Failures("camera", clock.now_ns)
        self.lost = self.frozen = 0

    def read(self) -> Frame | None:
        """Next frame; waits for a lost camera. None at the end of the stream, when stopped, or once closed."""
        while True:
            source = self._source if self._source is not None else self._return()
            if source is None or self._closed.is_set():
                return None
            try:
                frame = source.read()
                if frame is None:
                    return None
                if not self._repeats(frame):
                    return self._number(frame)
            except Exception as error:  # noqa: BLE001 - whatever a driver raises is its camera's failure
                if self._closed.is_set():  # under its hands
                    return None
                self.lost += 1
                self._connection_lost(f"camera lost: {self._failures.log('lost', error)}")
                self._drop()
            if self._stop.is_set():
                return None

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
        try:
            source.tune(camera)
        except CameraError:
            raise
        except Exception as error:
            why = self._failures.log("its settings cannot be changed", error)
            raise CameraError(f"camera {camera.name!r}: its settings cannot be changed: {why}") from error
        self._camera = camera

    def metrics(self) -> dict[str, float]:
        """Those of the open camera; none while it is away, or does not tell them."""
        source = self._source
        return self._failures.ask(source.metrics) if isinstance(source, Tunable) else {}

    def counts(self) -> dict[str, int]:
        """Event -> how often, of this camera and of all that were opened.

        `camera.lost`; `.frozen`: copies of the frame before; `.raised`: what a driver raised that is no error
        of ours; and the events of all cameras that were opened.
        """
        own = {"camera.lost": self.lost, "camera.frozen": self.frozen, "camera.raised": self._failures.raised}
        counts = Counter(own)
        counts.update(self._past)
        counts.update(self._events(self._source))
        return dict(counts)

    def _drop(self) -> None:
        source, self._source = self._source, None
        if source is None:
            return
        self._past.update(self._events(source))
        self._frozen_ns = None
        self._failures.close(source)

    def _events(self, source: FrameSource | None) -> dict[str, int]:
        """What a camera counted."""
        return self._failures.ask(source.counts) if isinstance(source, Tunable) else {}

    def _repeats(self, frame: Frame) -> bool:
        """Whether a frame has the picture of the one before, and so is no measurement.

        Raises:
            CameraError: All have had it for a second.
        """
        if not self._pictures.push(frame.image):
            self._frozen_ns = None
            return False
        self.frozen += 1
        now_ns = self._clock.now_ns()
        if self._frozen_ns is None:
            self._frozen_ns = now_ns
        if now_ns - self._frozen_ns >= FROZEN_NS:
            raise CameraError(
                "it has repeated one picture, with new stamps, for a second: it is opened again"
            )
        return True

    def _return(self) -> FrameSource | None:
        """Open until it works; None when told to stop."""
        while not (self._stop.wait(self._wait_s) or self._closed.is_set()):
            self._wait_s = min(2.0 * self._wait_s, LONGEST_WAIT_S)  # until a frame has come
            try:
                self._source, self._fresh = self._open(self._camera), True
            except Exception as error:  # noqa: BLE001 - as above
                self._connection_lost(f"camera away: {self._failures.log('still lost', error)}")
                continue
            if self._closed.is_set():  # while it was being opened
                self._drop()
            return self._source
        return None

    def _number(self, frame: Frame) -> Frame:
        """The frame with a number that goes on where the last camera ended."""
        if self._fresh:
            self._failures.over(f"back after loss number {self.lost}")
            self._wait_s, self._fresh = FIRST_WAIT_S, False
            if self._last is not None:
                seq, t_ns = self._last
                self._base = (
                    seq + max(1, round((frame.t_ns - t_ns) * 1e-9 * self._camera.frame_rate_hz)) - frame.seq
                )
        seq = frame.seq + self._base
        self._last = (seq, frame.t_ns)
        return frame if self._base == 0 else replace(frame, seq=seq)
