"""Lights of the simulated wrist device: they write into a timeline what was on when, and its camera looks it up."""

import threading
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

from common.clock import Clock
from common.frame_recording import Illumination

KEPT = 512  # switchings; four per cycle of the strobe, so some seconds


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
    """What was on when. Holds the last switchings; written by the lights, read by the camera, from any thread."""

    def __init__(self) -> None:
        """Begin dark."""
        self._lock = threading.Lock()
        self._switched: deque[tuple[int, Illumination]] = deque(maxlen=KEPT)

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
