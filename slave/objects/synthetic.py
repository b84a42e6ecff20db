"""A tracker on the object of the simulated scene, in real time: the first-class stand-in for hardware."""

import threading

import numpy as np

from common.clock import SkewedClock
from common.geometry import matrix_to_quaternion
from common.messages import TrackerPose
from common.sim.tracker import SimulatedTracker

RATE_HZ = 100.0


class SyntheticTracker:
    """A `TrackerSource` on the object that synthetic cameras see. Holds the number of the next pose."""

    def __init__(
        self,
        name: str,
        tracker: SimulatedTracker,
        epoch_ns: int,
        clock: SkewedClock,
        stop: threading.Event,
        rate_hz: float = RATE_HZ,
    ) -> None:
        """Get ready. It may join at any time: `seq` counts from the epoch.

        Args:
            name: Of the device in our messages.
            tracker: What it says at any moment of the scene.
            epoch_ns: Scene time 0, on the true clock [ns].
            clock: The slave's clock; stamps are on it.
            stop: Ends the stream, also while a pose is waited for.
            rate_hz: Poses per second.
        """
        self._name, self._tracker, self._epoch_ns = name, tracker, epoch_ns
        self._clock, self._stop, self._rate_hz = clock, stop, rate_hz
        self._next = 0
        self._started = self._closed = False

    def read(self) -> TrackerPose | None:
        """Reckon the next pose, wait until it is due, hand it over; None once closed or stopped."""
        seq = self._due_next()
        t_ns = self._measured_ns(seq)
        pose = self._tracker.pose((self._clock.to_true(t_ns) - self._epoch_ns) * 1e-9)
        place = np.full(3, np.nan) if pose is None else pose[:3, 3]
        quaternion = np.full(4, np.nan) if pose is None else matrix_to_quaternion(pose[:3, :3])
        while not (self._closed or self._stop.is_set()):
            if (left_ns := t_ns - self._clock.now_ns()) <= 0:
                self._next, self._started = seq + 1, True
                return TrackerPose(self._name, 0, seq, t_ns, place, quaternion)
            self._stop.wait(left_ns * 1e-9)
        return None

    def close(self) -> None:
        """End the stream."""
        self._closed = True

    def _due_next(self) -> int:
        """Number of the next pose: the one after the last, or the first to come where that is half a period late."""
        late_ns = self._clock.now_ns() - self._measured_ns(self._next)
        period_ns = 1e9 / self._rate_hz
        if late_ns <= (0.5 * period_ns if self._started else 0.0):
            return self._next
        return self._next + int(late_ns // period_ns) + 1

    def _measured_ns(self, seq: int) -> int:
        """When pose `seq` holds, own clock [ns]."""
        return self._clock.from_true(self._epoch_ns) + round(seq * 1e9 / self._rate_hz)
