"""Light a simulated wrist device by the strobe of real lights.

The camera waits for the strobe: before a frame is drawn, everything that the strobe would have done up to the end of
its exposure is done, each at the moment it asked for, or later where lateness is part of the simulation. A thread
would be as late as the drawing of pictures in the same process makes it, which no real device suffers from. The lights
write into a timeline what was on when, and the camera looks it up.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from common.calibration.strobe import StrobeCalibration
from common.clock import Clock
from common.recording.frame_recording import Illumination
from slave.lights.controller import Strobe
from slave.lights.interlock import Interlock
from slave.lights.schedule import StrobeSchedule


@dataclass(frozen=True, slots=True)
class Lit:
    """How much of an exposure each light was on, 0 to 1."""

    laser: float
    led: float

    @property
    def mostly(self) -> Illumination:
        """What a frame is called that was exposed so."""
        if max(self.laser, self.led) <= 0.0:
            return Illumination.AMBIENT
        return Illumination.LASER if self.laser >= self.led else Illumination.LED


class Timeline:
    """What was on when, from any thread.

    Holds the last switchings; written by the lights, read by the camera.
    """

    def __init__(self) -> None:
        """Begin dark."""
        self._lock = threading.Lock()
        # Four switchings per cycle of the strobe, so some seconds
        self._switched: deque[tuple[int, Illumination]] = deque(maxlen=512)

    def add(self, t_ns: int, lit: Illumination) -> None:
        """From `t_ns` on this is on; times rise."""
        with self._lock:
            self._switched.append((t_ns, lit))

    def during(self, start_ns: int, stop_ns: int) -> Lit:
        """What was on from `start_ns` to `stop_ns`, which is later [ns]."""
        with self._lock:
            switched = list(self._switched)
        on_ns = {Illumination.LASER: 0, Illumination.LED: 0}
        for (t_ns, lit), (end_ns, _) in pairwise([*switched, (stop_ns, Illumination.AMBIENT)]):
            if lit in on_ns:
                on_ns[lit] += max(min(end_ns, stop_ns) - max(t_ns, start_ns), 0)
        whole_ns = stop_ns - start_ns
        return Lit(on_ns[Illumination.LASER] / whole_ns, on_ns[Illumination.LED] / whole_ns)


class SyntheticLights:
    """`Lights` that only take note. Holds whether it was closed."""

    def __init__(self, timeline: Timeline, clock: Clock) -> None:
        """Switch on `timeline`, at the times of `clock`, that of the camera's stamps."""
        self._timeline, self._clock = timeline, clock
        self._closed = False

    def switch(self, lit: Illumination) -> None:
        """Have it on from now on."""
        if not self._closed:
            self._timeline.add(self._clock.now_ns(), lit)

    def off(self) -> None:
        """Have nothing on from now on."""
        self.switch(Illumination.AMBIENT)

    def close(self) -> None:
        """Go dark for good."""
        self.off()
        self._closed = True

    def counts(self) -> dict[str, int]:
        """Nothing can happen to it."""
        return {}


class _SetClock:
    """A clock that is set."""

    def __init__(self) -> None:
        self.t_ns = 0

    def now_ns(self) -> int:
        return self.t_ns


class SimulatedStrobe(Strobe):
    """Keeps a synthetic camera lit, without a thread.

    Holds the time up to which all is done.
    """

    def __init__(
        self, schedule: StrobeSchedule, strobe: StrobeCalibration, late_ns: Callable[[], int] = lambda: 0
    ) -> None:
        """Begin dark.

        Args:
            schedule: Fed by `push`.
            strobe: The limits.
            late_ns: How much later than asked for the strober comes this time [ns].
        """
        self._late_ns, self._set_clock, self._timeline = late_ns, _SetClock(), Timeline()
        lights = SyntheticLights(self._timeline, self._set_clock)
        super().__init__(schedule, Interlock(lights, strobe, self._set_clock, watch=False), self._set_clock)
        self._again_ns: int | None = None

    def during(self, start_ns: int, stop_ns: int) -> Lit:
        """What is on from `start_ns` to `stop_ns` [ns].

        That is not before the times asked for until now.
        """
        while self._again_ns is not None and self._again_ns <= stop_ns:
            self._monitored(self._again_ns)
            self._set_clock.t_ns = max(self._again_ns, self._set_clock.t_ns)
            self._ask()
        self._monitored(stop_ns)
        self._set_clock.t_ns = max(stop_ns, self._set_clock.t_ns)
        return self._timeline.during(start_ns, stop_ns)

    def push(self, seq: int, t_ns: int) -> None:
        """As of `Strobe`."""
        super().push(seq, t_ns)
        if self._again_ns is None:
            self._ask()

    def stalled(self) -> None:
        """As of `Strobe`."""
        super().stalled()
        self._again_ns = None

    def _ask(self) -> None:
        again_ns = self._strober.step()
        self._again_ns = None if again_ns is None else again_ns + self._late_ns()

    def _monitored(self, until_ns: int) -> None:
        """What the watchdog does until then."""
        while (left_s := self._interlock.look()) is not None:
            at_ns = self._set_clock.t_ns + max(round(left_s * 1e9), 1)
            if at_ns > until_ns:
                return
            self._set_clock.t_ns = at_ns
