"""Reconnect a device that was unplugged, without restarting the slave.

An error at the first opening is an error. Later, losing the device, whatever its driver raises, is an event: the
driver is closed, and opened again after 0.2 s, 0.4 s ... with all settings, until the device is there or the slave
ends. `seq` goes on behind a gap of as many items as fit into the absence. Only that several devices are there and
none was selected goes on to the user.

Some cameras send one picture, or a few in turn, again and again with new stamps. The noise of reading a real sensor
makes no two pictures equal, so one that equals an earlier one, byte by byte or by its check sum, was not measured
again. A picture without contrast (a cap, full exposure) is no evidence; nor is a simulated scene or a recording.
"""

import threading
import zlib
from collections import Counter, deque
from collections.abc import Callable
from typing import Generic, TypeVar

import cv2
import numpy as np
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError, TrackerChoiceError
from common.messages import ImuSample, TrackerPose
from slave.service import ConnectionLost, nobody
from slave.sources import Failures, Frame, FrameSource, Reporting, Source, Tunable

ItemT = TypeVar("ItemT", Frame, ImuSample, TrackerPose)


class ReconnectingDriver(Reporting, Generic[ItemT]):
    """A driver around one whose device can be lost."""

    def __init__(
        self,
        device: str,
        opener: Callable[[], Source[ItemT]],
        clock: Clock,
        stop: threading.Event,
        connection_lost: ConnectionLost = nobody,
        *,
        rate_hz: float = 0.0,
        first_s: float = 0.2,
        longest_s: float = 1.0,
        prefix: str = "",
    ) -> None:
        """Open the device; `opener` is called again after each loss.

        Args:
            device: What log lines call it.
            clock: The clock of the items' times.
            stop: Set when the slave is to end; `read` then waits for the device no longer.
            connection_lost: Called when it is lost, and before each try to open it again.
            rate_hz: Counts the items of an absence; 0: numbers go on without a gap.
            first_s: Wait before the first try to open it again [s]; twice as long each time, up to `longest_s`.
            prefix: Stands before the names of its counts and metrics.
        """
        self._device, self._open, self._clock, self._stop = device, opener, clock, stop
        self._connection_lost, self._prefix = connection_lost, prefix
        self._rate_hz, self._first_s, self._longest_s = rate_hz, first_s, longest_s
        self._closed = threading.Event()
        self._source: Source[ItemT] | None = opener()
        self._offset = 0  # added to the driver's own numbers
        self._opened_again = False  # and no item was read since
        self._last: tuple[int, int] | None = None  # seq, t_ns
        self._lost_ns: int | None = None  # since when; until an item has come
        self._wait_s = self._left_s = first_s
        self._why = ""
        self._counts = Counter({"lost": 0, "back": 0})
        self._closed_counts: Counter[str] = Counter()  # of the drivers that were closed
        self._failures = Failures(device, clock.now_ns)

    def read(self) -> ItemT | None:
        """Next item, waiting for a lost device; None at the end, stopped or closed."""
        while not self._closed.is_set():
            source = self._source if self._source is not None else self._reconnected()
            if source is None:
                item = self._wait()
                if self._stop.is_set() or self._closed.is_set():
                    return None
                if item is not None:
                    return self._numbered(item)
                continue
            try:
                item = source.read()
                if item is None:
                    return None
                if self._is_measured(item):
                    return self._numbered(item)
            except TrackerChoiceError:
                raise
            except Exception as error:  # noqa: BLE001 - whatever a driver raises is its device's failure
                if self._closed.is_set():  # by another thread, while it was read
                    return None
                self._lose(error)
            if self._stop.is_set():
                return None
        return None

    def close(self) -> None:
        """Give the device back. Safe to call twice, and from another thread."""
        self._closed.set()
        self._drop()

    def counts(self) -> dict[str, int]:
        """`lost`, `back`; `late`: no later than the last item; `raised`: errors not ours."""
        own = {**self._counts, "raised": self._failures.raised}
        counts = Counter({self._prefix + event: count for event, count in own.items()})
        counts.update(self._closed_counts)
        counts.update(self._counts_of(self._source))
        return dict(counts)

    def metrics(self) -> dict[str, float]:
        """`away_s`, how long it has been lost, 0: it is there; those of the driver."""
        source, lost_ns = self._source, self._lost_ns
        away_s = 0.0 if lost_ns is None else (self._clock.now_ns() - lost_ns) * 1e-9
        own = {f"{self._prefix}away_s": away_s}
        return own | (self._failures.ask(source.metrics) if isinstance(source, Reporting) else {})

    def _wait(self) -> ItemT | None:
        """Wait until the next try; return a stand-in for an item, if there is one."""
        self._stop.wait(self._left_s)
        self._left_s = 0.0
        return None

    def _is_measured(self, item: ItemT) -> bool:
        """Whether an item is a new measurement: later than the last."""
        if self._last is not None and item.t_ns <= self._last[1]:
            self._counts["late"] += 1
            return False
        return True

    def _ends_absence(self, item: ItemT) -> bool:
        """Whether an item shows that the device is back."""
        del item
        return True

    def _lose(self, error: Exception) -> None:
        self._counts["lost"] += 1
        if self._lost_ns is None:
            self._lost_ns = self._clock.now_ns()
        self._why = self._failures.log("lost", error)
        self._connection_lost(f"{self._device} lost: {self._why}")
        self._left_s = self._wait_s
        self._drop()

    def _drop(self) -> None:
        source, self._source = self._source, None
        if source is None:
            return
        self._closed_counts.update(self._counts_of(source))
        self._failures.close(source.close)

    def _counts_of(self, source: Source[ItemT] | None) -> dict[str, int]:
        return self._failures.ask(source.counts) if isinstance(source, Reporting) else {}

    def _reconnected(self) -> Source[ItemT] | None:
        """The driver, opened again if a try is due; None: not yet, or not there."""
        if self._left_s > 0.0:
            return None
        self._connection_lost(f"{self._device} away: {self._why}")
        self._wait_s = min(2.0 * self._wait_s, self._longest_s)  # until an item has come
        self._left_s = self._wait_s
        try:
            self._source = self._open()
        except Exception as error:  # noqa: BLE001 - as above
            self._why = self._failures.log("still away", error)
            return None
        self._opened_again = True
        if self._closed.is_set():  # while it was being opened
            self._drop()
        return self._source

    def _numbered(self, item: ItemT) -> ItemT:
        """The item with a number that goes on where the last driver ended."""
        if self._lost_ns is not None and self._ends_absence(item):
            self._failures.over(f"back after loss number {self._counts['lost']}")
            self._counts["back"] += 1
            self._lost_ns, self._wait_s = None, self._first_s
        if self._last is not None and (self._opened_again or not self._rate_hz):
            seq, t_ns = self._last
            self._offset = seq + max(1, round((item.t_ns - t_ns) * 1e-9 * self._rate_hz)) - item.seq
        self._opened_again = False
        seq = item.seq + self._offset
        self._last = (seq, item.t_ns)
        return item if self._offset == 0 else replace(item, seq=seq)


class ReconnectingTracker(ReconnectingDriver[TrackerPose]):
    """Gives poses of NaN, four a second, while the tracker's system is away."""

    def __init__(
        self,
        name: str,
        opener: Callable[[], Source[TrackerPose]],
        clock: Clock,
        stop: threading.Event,
        connection_lost: ConnectionLost = nobody,
        *,
        longest_s: float = 10.0,
    ) -> None:
        """Open the tracker `name`.

        Tries are at most 10 s apart, as each leaves 100 kB in openvr (ValveSoftware/openvr, issue 1221).
        """
        self._name = name
        super().__init__("tracker", opener, clock, stop, connection_lost, longest_s=longest_s)

    def _wait(self) -> TrackerPose:
        absent_s = 0.25  # from one pose of NaN to the next
        self._stop.wait(absent_s)
        self._left_s -= absent_s
        t_ns = self._clock.now_ns() - round(0.5e9 * absent_s)
        if self._last is not None:
            t_ns = max(t_ns, self._last[1] + 1)
        return TrackerPose(self._name, 0, 0, t_ns, np.full(3, np.nan), np.full(4, np.nan))

    def _ends_absence(self, item: TrackerPose) -> bool:
        return bool(np.isfinite(item.position_m).all())


CONTRAST = 8  # levels in a channel, above what JPEG makes of an even picture


class RepeatedPictures:
    """Finds repeated pictures by the last one and check sums of those before."""

    def __init__(self) -> None:
        self._last: Image | None = None
        # A driver may hand eight buffers round: ours are asked for four and six
        self._sums: deque[tuple[tuple[int, ...], int, int | None]] = deque(maxlen=8)

    def push(self, image: Image) -> bool:
        """Whether a picture, (H, W, 3) or (H, W), is one of the last ones again."""
        last, self._last = self._last, image
        # Four rows are compared first; where one of their values differs, nothing else is
        step = max(1, len(image) // 4)
        rows = np.ascontiguousarray(image[step // 2 :: step])
        same_rows = last is not None and np.array_equal(rows, last[step // 2 :: step])
        if last is not None and same_rows and last.shape == image.shape and np.array_equal(image, last):
            return _has_contrast(image)
        return self._was_before(image, zlib.crc32(rows.data)) and _has_contrast(image)

    def _was_before(self, image: Image, rows: int) -> bool:
        """Whether a picture whose rows have this sum was there twice already."""
        key = image.shape, rows
        wholes = [whole for shape, before, whole in reversed(self._sums) if (shape, before) == key]
        whole = zlib.crc32(np.ascontiguousarray(image).data) if wholes else None
        self._sums.append((*key, whole))
        return bool(wholes) and wholes[0] == whole


def _has_contrast(image: Image) -> bool:
    """Whether any pixel is further from the first one than an even picture's are."""
    first = np.atleast_1d(image[0, 0]).astype(float)
    even = cv2.inRange(image, first - CONTRAST, first + CONTRAST)
    return cv2.countNonZero(even) < even.size


class ReconnectingCamera(ReconnectingDriver[Frame], Tunable):
    """A camera that is opened again with its last settings, also where it is frozen."""

    def __init__(
        self,
        opener: Callable[[CameraCalibration], FrameSource],
        camera: CameraCalibration,
        clock: Clock,
        stop: threading.Event,
        connection_lost: ConnectionLost = nobody,
        *,
        first_s: float = 0.2,
        longest_s: float = 1.0,
        frozen_s: float = 1.0,
    ) -> None:
        """Open the camera; one that repeats a picture for `frozen_s` [s] is lost."""
        self._camera = camera
        super().__init__(
            "camera",
            lambda: opener(self._camera),
            clock,
            stop,
            connection_lost,
            rate_hz=camera.frame_rate_hz,
            first_s=first_s,
            longest_s=longest_s,
            prefix="camera.",
        )
        self._pictures = RepeatedPictures()
        self._frozen_s = frozen_s
        self._frozen_ns: int | None = None  # since when it repeats one
        self._counts["frozen"] = 0  # frames that were copies of the one before

    def tune(self, camera: CameraCalibration) -> None:
        """Change the settings of the camera, now and whenever it is opened again."""
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
        self._camera, self._rate_hz = camera, camera.frame_rate_hz

    def _is_measured(self, item: Frame) -> bool:
        """Whether a frame is no copy; raises `CameraError` where all were for too long."""
        if not self._pictures.push(item.image):
            self._frozen_ns = None
            return True
        self._counts["frozen"] += 1
        now_ns = self._clock.now_ns()
        if self._frozen_ns is None:
            self._frozen_ns = now_ns
        if now_ns - self._frozen_ns >= self._frozen_s * 1e9:
            raise CameraError(
                "it has repeated one picture, with new stamps, for a second: it is opened again"
            )
        return False

    def _drop(self) -> None:
        self._frozen_ns = None
        super()._drop()
