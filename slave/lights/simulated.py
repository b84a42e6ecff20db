"""The strobe of a simulated wrist device: schedule, strober and guard as before real lights, in the time of the frames.

Here the camera waits for the strobe: before a frame is drawn, everything that the strobe would have done up to the end
of its exposure is done, each at the moment it asked for, or later where lateness is part of the simulation. A thread
would be as late as the drawing of pictures in the same process makes it, which no real device suffers from.
"""

from collections.abc import Callable

from common.strobe_calibration import StrobeCalibration
from slave.lights.controller import Strober, light_counts
from slave.lights.interlock import Interlock
from slave.lights.schedule import StrobeSchedule
from slave.lights.synthetic import Lit, SyntheticLights, Timeline


class _SetClock:
    """A clock that is set."""

    def __init__(self) -> None:
        self.t_ns = 0

    def now_ns(self) -> int:
        return self.t_ns


class SimulatedStrobe:
    """Keeps a synthetic camera lit, as a `StrobeController` a real one. Holds the time up to which all is done."""

    def __init__(
        self, schedule: StrobeSchedule, strobe: StrobeCalibration, late_ns: Callable[[], int] = lambda: 0
    ) -> None:
        """Begin dark.

        Args:
            schedule: Fed by `push`.
            strobe: The limits.
            late_ns: How much later than asked for the strober comes this time [ns].
        """
        self._schedule, self._late_ns = schedule, late_ns
        self._clock = _SetClock()
        self._timeline = Timeline()
        self._interlock = Interlock(
            SyntheticLights(self._timeline, self._clock), strobe, self._clock, watch=False
        )
        self._strober = Strober(schedule, self._interlock, self._clock)
        self._again_ns: int | None = None

    def during(self, start_ns: int, stop_ns: int) -> Lit:
        """What is on from `start_ns` to `stop_ns` [ns], which is not before the times asked for until now."""
        while self._again_ns is not None and self._again_ns <= stop_ns:
            self._monitored(self._again_ns)
            self._clock.t_ns = max(self._again_ns, self._clock.t_ns)
            self._ask()
        self._monitored(stop_ns)
        self._clock.t_ns = max(stop_ns, self._clock.t_ns)
        return self._timeline.during(start_ns, stop_ns)

    def push(self, seq: int, t_ns: int) -> None:
        """A frame came; its mid-exposure [ns]."""
        if self._schedule.push(seq, t_ns):
            self._strober.renumber()
        if self._again_ns is None:
            self._ask()

    def expose(self, exposure_us: float) -> None:
        """The camera exposes for so long from now on [us]."""
        self._schedule.expose(exposure_us)

    def stalled(self) -> None:
        """There are no frames any more."""
        self._schedule.forget()
        self._strober.renumber()
        self._strober.dark()
        self._again_ns = None

    def counts(self) -> dict[str, int]:
        """`lights.<event>` -> how often."""
        return light_counts(self._interlock, self._strober, self._schedule)

    def close(self) -> None:
        """Go dark. Safe to call twice."""
        self._strober.dark()
        self._interlock.close()

    def _ask(self) -> None:
        again_ns = self._strober.step()
        self._again_ns = None if again_ns is None else again_ns + self._late_ns()

    def _monitored(self, until_ns: int) -> None:
        """What the watchdog does until then."""
        while (left_s := self._interlock.look()) is not None:
            at_ns = self._clock.t_ns + max(round(left_s * 1e9), 1)
            if at_ns > until_ns:
                return
            self._clock.t_ns = at_ns
