"""Switch ambient -> laser -> LED in step with a camera.

`Strober.step` does what is due and returns when to call it again; it never waits. The thread only waits and steps.
A light goes on a lead before its exposure and off right after it. Whoever comes too late for the beginning of an
exposure skips that pulse (`skipped`): a frame without its light makes no cycle, a light that smears into the next
frame might become a wrong one. A light that came on only after the exposure had begun goes off at once (`late`).
"""

import logging
import threading
from collections import Counter

from common.clock import Clock
from common.errors import LightsError
from slave.lights.interlock import Interlock
from slave.lights.schedule import Pulse, StrobeSchedule

FAILED_NS = 500_000_000  # after a driver has failed, no light for so long; then it is tried again
EVENTS = ("skipped", "late")
_LOG = logging.getLogger(__name__)


class Strober:
    """Makes the light of each frame.

    Holds the pulse that is on, and the number of the last frame that was lit or skipped.

    Attributes:
        counts: Event -> how often.
            skipped: pulses not begun, as it was too late for them.
            late: pulses ended at once, as the driver took too long.
    """

    def __init__(self, schedule: StrobeSchedule, interlock: Interlock, clock: Clock) -> None:
        """Begin dark.

        Args:
            schedule: Knows the exposures.
            guard: The lights.
            clock: That of the frames' stamps.
        """
        self._schedule, self._interlock, self._clock = schedule, interlock, clock
        self._on: Pulse | None = None
        self._number = -1
        self._rest_until_ns: int | None = None
        self._logged_ns: int | None = None
        self.counts: Counter[str] = Counter(dict.fromkeys(EVENTS, 0))

    def step(self) -> int | None:
        """Do what is due; when to come again [ns], None: when there is another frame."""
        now_ns = self._clock.now_ns()
        if self._rest_until_ns is not None and now_ns < self._rest_until_ns:
            return self._rest_until_ns
        try:
            return self._step(now_ns)
        except LightsError as error:
            self._rest_until_ns = now_ns + FAILED_NS
            self._on = None
            self._log_fault(now_ns, error)
            return self._rest_until_ns

    def dark(self) -> None:
        """End what is on, now: the camera has stopped, or all ends."""
        self._on = None
        try:
            self._interlock.end()
        except LightsError as error:
            self._log_fault(self._clock.now_ns(), error)

    def _step(self, now_ns: int) -> int | None:
        if self._on is not None:
            if now_ns < self._on.off_ns:
                return self._on.off_ns
            self._interlock.end()
            self._on = None
        if self._number < 0:
            self._number = self._schedule.before(now_ns)
        pulse = self._schedule.after(self._number)
        while pulse is not None and now_ns > pulse.latest_ns:
            self.counts["skipped"] += 1
            self._number = pulse.number
            pulse = self._schedule.after(self._number)
        if pulse is None or now_ns < pulse.on_ns:
            return None if pulse is None else pulse.on_ns
        self._number = pulse.number
        if not self._interlock.begin(pulse.lit, pulse.off_ns - now_ns):
            return pulse.off_ns
        if self._clock.now_ns() > pulse.latest_ns:
            self.counts["late"] += 1
            self._interlock.end()
        else:
            self._on = pulse
        return pulse.off_ns

    def renumber(self) -> None:
        """The frames are counted anew."""
        self._number = -1

    def _log_fault(self, now_ns: int, error: LightsError) -> None:
        if self._logged_ns is None or now_ns - self._logged_ns >= 10_000_000_000:  # one line in ten seconds
            self._logged_ns = now_ns
            _LOG.warning("lights: %s", error)


class Strobe:
    """Keeps a camera lit: schedule of exposures, strober, lights."""

    def __init__(self, schedule: StrobeSchedule, interlock: Interlock, clock: Clock) -> None:
        """Begin dark.

        Args:
            schedule: Fed by `push`.
            interlock: The lights; closed by `close`.
            clock: That of the frames' stamps.
        """
        self._schedule, self._interlock, self._clock = schedule, interlock, clock
        self._strober = Strober(schedule, interlock, clock)

    def push(self, seq: int, t_ns: int) -> None:
        """A frame came; its mid-exposure [ns]."""
        if self._schedule.push(seq, t_ns):
            self._strober.renumber()

    def expose(self, exposure_us: float) -> None:
        """The camera exposes for so long from now on [us]."""
        self._schedule.expose(exposure_us)

    def stalled(self) -> None:
        """There are no frames any more: go dark, and know nothing."""
        self._schedule.forget()
        self._strober.renumber()
        self._strober.dark()

    def counts(self) -> dict[str, int]:
        """`lights.<event>` -> how often, of lights, strober and schedule."""
        own = {**self._interlock.events(), **self._strober.counts, "restarts": self._schedule.restarts}
        return {f"lights.{event}": count for event, count in own.items()}

    def close(self) -> None:
        """Go dark, give the lights back. Safe to call twice.

        Raises:
            LightsError: The lights could not be darkened.
        """
        self._strober.dark()
        self._interlock.close()


class StrobeController(Strobe):
    """A strobe that works on a thread of its own.

    Holds the strober and its schedule under one lock.
    """

    def __init__(self, schedule: StrobeSchedule, interlock: Interlock, clock: Clock) -> None:
        """Start the thread; arguments as of `Strobe`."""
        super().__init__(schedule, interlock, clock)
        self._news = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="strobe", daemon=True)
        self._thread.start()

    def push(self, seq: int, t_ns: int) -> None:
        """As of `Strobe`."""
        with self._news:
            super().push(seq, t_ns)
            self._news.notify_all()

    def expose(self, exposure_us: float) -> None:
        """As of `Strobe`."""
        with self._news:
            super().expose(exposure_us)

    def stalled(self) -> None:
        """As of `Strobe`."""
        with self._news:
            super().stalled()
            self._news.notify_all()

    def close(self) -> None:
        """Go dark, end the thread, give the lights back; as of `Strobe`."""
        with self._news:
            self._closed = True
            self._strober.dark()
            self._news.notify_all()
        self._thread.join()
        self._interlock.close()

    def _work(self) -> None:
        with self._news:
            try:
                while not self._closed:
                    again_ns = self._strober.step()
                    if again_ns is None:
                        self._news.wait(0.5)  # there are no frames
                    elif (left_s := (again_ns - self._clock.now_ns()) * 1e-9) > 0.0:
                        self._news.wait(left_s)
            finally:
                self._strober.dark()
