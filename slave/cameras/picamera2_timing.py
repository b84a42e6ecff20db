"""Date and number the frames of a Pi camera; see whether cameras are in step.

libcamera documents `SensorTimestamp` as the time at which row 0 is exposed, on the boot clock. The kernel's receivers
(bcm2835-unicam, rp1-cfe) take it, with `ktime_get_ns`, the monotonic clock, when the frame starts to arrive: a row is
read out when its exposure *ends* (picamera2 issue 821; picamera2's own `flush` subtracts the exposure). So the middle
of the exposure of row 0 is `SensorTimestamp` - `ExposureTime` / 2. `FrameWallClock` is the same moment after a
regression from the boot clock to the wall clock (libcamera's ClockRecovery); it follows a stepped wall clock only
slowly, and is used only where there is no `SensorTimestamp`.

Scatter of a stamp: the interrupt's latency, under load up to 50 to 200 us on a Pi with the usual kernel, mostly 10 to
30 us, and the first byte leaves the sensor within two rows (some 40 us) of the end of the exposure: 50 us cover both.
The regression behind `FrameWallClock` follows the wall clock to about a millisecond. The library has no frame number
that counts what the sensor dropped; frames come at a fixed duration, so the number follows from the time.

In step (src/ipa/rpi/controller/rpi/sync.cpp): every 30 frames the server sends when one of its frames began and when
all shall be ready. A client that finds itself 50 us or more off makes one single frame shorter or longer by that
much. `SyncReady` shows that the agreed moment has passed, and stays; `SyncTimer` is the time from the frame to that
moment, after which it does not measure the lag: the server reckons the moment back over all frames since. The
evidence is

    that the server is received  the agreed moment, FrameWallClock + SyncTimer, is recomputed with every message, and
                                 stands still without any
    how far the client was off   the frame it made shorter or longer: FrameDuration against that of its neighbours

A server knows nothing of its clients: it is in step when it is ready. Stamps on no known clock, and cameras that are
not in step in time, raise `CameraError`.
"""

import logging
import math
from collections.abc import Callable, Mapping
from math import hypot

from common.clock import Clock
from common.errors import CameraError
from slave.clocks import ForeignClock, clock_of, system_clock

SIGMA_NS: Mapping[str, float] = {"SensorTimestamp": 50e3, "FrameWallClock": 1e6}  # standard deviations
MICROSECONDS_BELOW = 10**17  # wall clock: such a number of ns would be 1973, so it is in us


class Timeline:
    """Number and time of each frame from its metadata."""

    def __init__(self, frame_rate_hz: float, clock: Clock) -> None:
        self._rate_hz = frame_rate_hz
        self._clock = clock
        self._stamps: tuple[str, ForeignClock] | None = None  # of which key in the metadata
        self._last: tuple[int, int] | None = None

    @property
    def sigma_ns(self) -> float:
        """Standard deviation of the last time [ns]; 0 before the first."""
        return 0.0 if self._stamps is None else hypot(SIGMA_NS[self._stamps[0]], self._stamps[1].sigma_ns)

    def place(self, metadata: Mapping[str, object]) -> tuple[int, int] | None:
        """Number and mid-exposure of row 0 [ns] of the next frame; None: without a time."""
        t_ns = self._row_zero_ns(metadata)
        if t_ns is None:
            return None
        self._last = (self._number(t_ns, metadata), t_ns)
        return self._last

    def _row_zero_ns(self, metadata: Mapping[str, object]) -> int | None:
        key = "SensorTimestamp" if "SensorTimestamp" in metadata else "FrameWallClock"
        stamp, exposure = metadata.get(key), metadata.get("ExposureTime")
        # Under load the receiver of Pi 4 and older can deliver a frame with time 0 (raspberrypi/linux 5118).
        if not isinstance(stamp, int) or stamp <= 0 or not isinstance(exposure, (int, float)):
            return None
        if key == "FrameWallClock" and stamp < MICROSECONDS_BELOW:
            stamp *= 1000
        if self._stamps is None or self._stamps[0] != key:
            name = clock_of(stamp)
            if name is None:
                raise CameraError(f"{key} {stamp} ns is on no clock of this machine")
            self._stamps = (key, ForeignClock(self._clock, system_clock(name)))
        return self._stamps[1].to_own(stamp) - round(exposure * 500.0)

    def _number(self, t_ns: int, metadata: Mapping[str, object]) -> int:
        """As many further than the last one as whole frame durations have passed."""
        if self._last is None:
            return 0
        seq, before_ns = self._last
        duration = metadata.get("FrameDuration")
        period_us = 1e6 / self._rate_hz
        if isinstance(duration, (int, float)) and duration > 0:
            period_us = float(duration)
        return seq + max(1, math.floor((t_ns - before_ns) / (period_us * 1e3) + 0.5))


PERIOD_FRAMES = 30  # from message to message
# some are lost on a wireless network; crystals drift 0.25 ms in 300 frames
SILENT_FRAMES = 10 * PERIOD_FRAMES
MOST_OFF_US = 1000.0  # further off in one correction, and it had not been in step
_LOG = logging.getLogger(__name__)


class SyncMonitor:
    """Watches a camera's metadata for whether it is in step."""

    def __init__(self, where: str, *, client: bool) -> None:
        self._where, self._client = where, client
        self._ready_us: int | None = None  # the agreed moment, wall clock
        self._silent = 0  # frames since it was reckoned anew
        self._durations: tuple[float, float] = (0.0, 0.0)  # of the last frame, and of an uncorrected one
        self._since_error = 0
        self._was_locked = False
        self.lost = 0
        self.locked = False
        self.error_us = 0.0

    def push(self, metadata: Mapping[str, object]) -> None:
        """Take in one frame."""
        if self._client:
            self._listen(metadata)
            self._measure(metadata)
        near = abs(self.error_us) <= MOST_OFF_US
        self.locked = bool(metadata.get("SyncReady")) and self._silent < SILENT_FRAMES and near
        if self.locked == self._was_locked:
            return
        if self.locked:
            _LOG.info(
                "%s: in step%s", self._where, f" again, after loss number {self.lost}" if self.lost else ""
            )
        else:
            self.lost += 1
            _LOG.warning("%s: no longer in step with the others: %s", self._where, self._why(metadata))
        self._was_locked = self.locked

    def metrics(self) -> dict[str, float]:
        """`sync_locked` 0 or 1; of a client the last correction; 0 is below 50 us."""
        found = {"sync_locked": float(self.locked)}
        return found | {"sync_error_us": self.error_us} if self._client else found

    def _listen(self, metadata: Mapping[str, object]) -> None:
        timer, wall = metadata.get("SyncTimer"), metadata.get("FrameWallClock")
        self._silent += 1
        if isinstance(timer, int) and isinstance(wall, int):
            # libcamera rounds as well: without a message the sum is the same to the microsecond.
            ready_us = (wall if wall < MICROSECONDS_BELOW else wall // 1000) + timer
            if ready_us != self._ready_us:
                self._ready_us, self._silent = ready_us, 0

    def _measure(self, metadata: Mapping[str, object]) -> None:
        """A corrected frame stands alone; two alike are the usual length."""
        duration = metadata.get("FrameDuration")
        self._since_error += 1
        if self._since_error > PERIOD_FRAMES + PERIOD_FRAMES // 2:  # a message later nothing was corrected
            self.error_us = 0.0
        if not isinstance(duration, (int, float)):
            return
        last, typical = self._durations
        if duration == last:
            typical = float(duration)
        off_us = typical - duration if typical else 0.0
        if abs(off_us) >= 50.0:  # us: less libcamera does not correct
            self.error_us, self._since_error = off_us, 0
        self._durations = (float(duration), typical)

    def _why(self, metadata: Mapping[str, object]) -> str:
        if not metadata.get("SyncReady"):
            return "libcamera began anew"
        if self._silent >= SILENT_FRAMES:
            return f"nothing was received from the server for {self._silent} frames"
        return f"it was {self.error_us:.0f} us off"


def wait_in_step(
    capture: Callable[[], Mapping[str, object]],
    where: str,
    role: str,
    timeout_s: float,
    clock: Clock,
    stopped: Callable[[], bool],
) -> None:
    """Read metadata until all cameras are in step; `role` is "server" or "client"."""
    other = "clients" if role == "server" else "the server"
    end_ns = clock.now_ns() + round(timeout_s * 1e9)
    count = 0
    while True:
        metadata = capture()
        # us until the agreed moment; a client that received from no server has none
        timer = metadata.get("SyncTimer")
        if metadata.get("SyncReady"):
            wall = metadata.get("FrameWallClock", "unknown")
            _LOG.info("%s: in step, %s us off; first frame at wall clock %s ns", where, timer, wall)
            return
        if stopped():
            raise CameraError(f"{where}: stopped while it waited for {other}")
        if clock.now_ns() > end_ns:
            received = "nothing was received from a server" if timer is None else f"{timer} us were left"
            raise CameraError(
                f"{where}: --sync {role}: not in step after {timeout_s:g} s, {received}. "
                "Exactly one camera of the rig is the server, all have the same frame_rate_hz, clients start "
                "first, and UDP multicast 239.255.255.250:10000 must pass between the machines"
            )
        if count % 120 == 0:  # frames, two seconds at 60 Hz
            _LOG.info("%s: --sync %s: waiting for %s, timer %s us", where, role, other, timer)
        count += 1
