"""An IMU on the simulated hand, in real time: the first-class stand-in for hardware.

Sample k is measured when the IMU's own oscillator, which is the slave's (perhaps skewed) clock, says
`epoch + k periods`, and handed over then. A process too slow for its rate leaves samples out, seen as gaps in `seq`,
and never works off a backlog.
"""

import threading

from common.clock import SkewedClock
from common.messages import ImuSample
from common.sim.imu import SimulatedImu


class SyntheticImu:
    """An `ImuSource` that feels the scene of the synthetic cameras. Holds the number of the next sample."""

    def __init__(self, imu: SimulatedImu, epoch_ns: int, clock: SkewedClock, stop: threading.Event) -> None:
        """Get ready. The IMU may join at any time: `seq` counts from the epoch.

        Args:
            imu: What it says at any moment of the scene.
            epoch_ns: Scene time 0, on the true clock [ns].
            clock: The slave's clock; stamps are on it, and its rate is that of the samples.
            stop: Ends the stream, also while a sample is waited for.
        """
        self._imu, self._epoch_ns, self._clock, self._stop = imu, epoch_ns, clock, stop
        self._first_ns = clock.from_true(epoch_ns)
        self._next = 0
        self._started = self._closed = False

    def read(self) -> ImuSample | None:
        """Reckon the next sample, wait until it is due, hand it over; None once closed or stopped."""
        seq = self._due_next()
        t_ns = self._measured_ns(seq)
        sample = self._imu.sample(seq, (self._clock.to_true(t_ns) - self._epoch_ns) * 1e-9, t_ns)
        while not (self._closed or self._stop.is_set()):
            if (left_ns := t_ns - self._clock.now_ns()) <= 0:
                self._next, self._started = seq + 1, True
                return sample
            self._stop.wait(left_ns * 1e-9)
        return None

    def close(self) -> None:
        """End the stream."""
        self._closed = True

    def _due_next(self) -> int:
        """Number of the next sample: the one after the last, or the first to come where that is half a period late."""
        late_ns = self._clock.now_ns() - self._measured_ns(self._next)
        period_ns = 1e9 / self._imu.rate_hz
        if late_ns <= (0.5 * period_ns if self._started else 0.0):
            return self._next
        return self._next + int(late_ns // period_ns) + 1

    def _measured_ns(self, seq: int) -> int:
        """When sample `seq` is measured, own clock [ns]."""
        return self._first_ns + round(seq * 1e9 / self._imu.rate_hz)
