"""State what a driver has to be, and log why a device or a frame failed.

Nothing behind this seam can distinguish which device it is. A driver opens its device in its constructor. It may also
have counts and metrics (`Reporting`), and a camera settings that change (`Tunable`). A `PhalanxError` is logged by
its message; whatever else a driver raises is a fault in a program: counted, and logged with its traceback.
"""

import logging
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
from msgspec import Struct

from common.arrays import Float, Image
from common.calibration import CameraCalibration
from common.clock import Clock, now_ns
from common.errors import ImuError, PhalanxError
from common.messages import ImuSample, TrackerPose
from common.recording.frame_recording import Illumination
from slave.clocks import ClockSteppedError, DeviceClock

ItemT_co = TypeVar("ItemT_co", covariant=True)


class Frame(Struct, frozen=True, eq=False):
    """One image and when it was taken.

    Attributes:
        seq: Frame counter of this camera; a gap is a frame the camera dropped.
        t_ns: Middle of the exposure of row 0 [ns], slave's clock.
        ready_t_ns: When the frame was handed to the slave [ns], same clock.
        image: (H, W, 3) BGR, or (H, W) grey, uint8. Nobody writes to it any more: others may still look at it.
        illumination: What lit the scene; NONE: not known.
        t_sigma_ns: Standard deviation of `t_ns` [ns], as far as the driver knows its camera; 0: exact.
        exposure_us: Exposure time [us]; 0: not known.
    """

    seq: int
    t_ns: int
    ready_t_ns: int
    image: Image
    illumination: Illumination = Illumination.AMBIENT
    t_sigma_ns: float = 0.0
    exposure_us: float = 0.0


class Source(Protocol[ItemT_co]):
    """A driver: frames of a camera, samples of an IMU, poses of a tracker."""

    def read(self) -> ItemT_co | None:
        """Block until the next item, or return None at the end of the stream.

        `t_ns` is on the slave's clock; a gap in `seq` is an item that was dropped. `session` is 0: the sender fills
        it in. A tracker that does not know where it is gives poses of NaN, a few in a second.

        Raises:
            PhalanxError: The device is gone, or an item is broken. Never replaced by a fake one.
            TrackerChoiceError: Several devices are there, and none was selected.
        """
        ...

    def close(self) -> None:
        """Give the device back. Safe to call twice."""
        ...


FrameSource: TypeAlias = Source[Frame]
ImuSource: TypeAlias = Source[ImuSample]
TrackerSource: TypeAlias = Source[TrackerPose]


class Reporting(ABC):
    """What has counts and metrics for `Health`; asked by the thread of the reports."""

    @abstractmethod
    def counts(self) -> Mapping[str, int]:
        """Event -> how often since it was opened."""

    @abstractmethod
    def metrics(self) -> Mapping[str, float]:
        """Quantity with its unit -> value now; names of `calibration.camera_settings`."""


class Tunable(Reporting):
    """A camera whose settings may be changed by another thread while it is read."""

    @abstractmethod
    def tune(self, camera: CameraCalibration) -> None:
        """Take exposure, gains and rate of `camera`; its size is that it was opened with.

        Raises:
            CameraError: Refused, or not taken. The text names setting, wanted and got; the old settings are back, or
                the text states that they are not.
        """


LOG_EVERY_NS = 10_000_000_000
_LOG = logging.getLogger(__name__)

ValueT = TypeVar("ValueT", int, float)


class Failures:
    """Counts and logs the errors `of` a device, one line in 10 s; `raised`: not ours."""

    def __init__(self, of: str, clock: Callable[[], int] = now_ns) -> None:
        self._of, self._clock = of, clock
        self._logged_ns: int | None = None
        self._silent = 0
        self._open = False  # a failure was logged, and not yet that it is over
        self.raised = 0

    def log(self, event: str, error: Exception) -> str:
        """Count an error, log `event` with it if a line is due; the error in words."""
        ours = isinstance(error, PhalanxError)
        why = str(error) if ours else f"{type(error).__name__}: {error}"
        self.raised += not ours
        if self._is_due():
            more = f" ({self._silent} more since the last such line)" if self._silent else ""
            _LOG.warning("%s: %s: %s%s", self._of, event, why, more, exc_info=None if ours else error)
            self._silent, self._open = 0, True
        else:
            self._silent += 1
        return why

    def ask(self, query: Callable[[], Mapping[str, ValueT]]) -> dict[str, ValueT]:
        """Query a driver for its state; nothing where it raises: the reports go on."""
        try:
            return dict(query())
        except Exception as error:  # noqa: BLE001 - whatever a driver raises is its device's failure
            self.log("does not report its state", error)
            return {}

    def close(self, close: Callable[[], None]) -> None:
        """Close a driver; one that cannot be closed is opened again nevertheless."""
        try:
            close()
        except Exception as error:  # noqa: BLE001 - as above
            self.log("could not be given back", error)

    def over(self, event: str) -> None:
        """Log that all is well again, unless the failure itself was not logged, too."""
        if self._open:
            _LOG.warning("%s: %s", self._of, event)
        self._open = False

    def _is_due(self) -> bool:
        t_ns = self._clock()
        if self._logged_ns is not None and t_ns - self._logged_ns < LOG_EVERY_NS:
            return False
        self._logged_ns = t_ns
        return True


NO_FIELD = np.full(3, np.nan)
NO_ORIENTATION = np.full(4, np.nan)


class ClockedImu(Reporting):
    """What is alike in the drivers; `device` is called so in messages, `where` it is."""

    def __init__(
        self,
        name: str,
        device: str,
        where: str,
        clock: Clock,
        stop: threading.Event,
        device_clock: DeviceClock,
    ) -> None:
        self._name, self._device, self._where = name, device, where
        self._clock, self._stop, self._device_clock = clock, stop, device_clock
        self._counts: Counter[str] = Counter()
        self._metrics: dict[str, float] = {}
        self._seq, self._stamp_ns = -1, 0
        self._closed = False

    def counts(self) -> Mapping[str, int]:
        """`broken` in all and by reason, and what else the driver counts."""
        counts = dict(self._counts)
        return {"broken": sum(v for k, v in counts.items() if k.startswith("broken.")), **counts}

    def metrics(self) -> Mapping[str, float]:
        """Return what the device last reported of itself, such as `temperature_c`."""
        return dict(self._metrics)

    def _possible(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Whether a stamp can be (counted if not); ImuError: the device began anew."""
        try:
            possible = self._device_clock.observe(stamp_ns, arrival_ns)
        except ClockSteppedError:
            raise ImuError(f"{self._where}: the {self._device} began anew, or its clock was set") from None
        self._counts["broken.time"] += not possible
        return possible

    def _sample(self, stamp_ns: int, period_ns: float, gyro: Float, accel: Float, mag: Float) -> ImuSample:
        """The sample of an observed stamp [ns], numbered by the time since the last."""
        passed = max(1, round((stamp_ns - self._stamp_ns) / period_ns)) if self._seq >= 0 else 1
        self._seq, self._stamp_ns = self._seq + passed, stamp_ns
        t_ns = self._device_clock.at(stamp_ns)
        return ImuSample(self._name, 0, self._seq, t_ns, gyro, accel, mag, NO_ORIENTATION)
