"""A tracking system that ends and comes back: opened anew without restarting the slave.

As for IMUs: an error while it is opened for the first time is an error. Once it runs, losing it (SteamVR was closed,
survive-cli has died) is an event: it is given back and opened again after 0.2 s, 0.4 s ... until it is there or the
slave is told to stop. Meanwhile poses of NaN say four times a second that the device is lost. That several devices are
there and nobody said which one is meant is mended by no waiting: that error goes on to the user. Anything else that a
driver raises is a loss.
"""

import threading
from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np
from msgspec.structs import replace

from common.clock import Clock
from common.errors import TrackerChoiceError
from common.messages import TrackerPose
from slave.failures import Failures
from slave.service import ConnectionLost, nobody
from slave.sources import Reporting, TrackerSource

FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 10.0  # each try leaves 100 kB in openvr (ValveSoftware/openvr, issue 1221)
LOG_LOST_S = 0.25


class ReconnectingTracker:
    """A `TrackerSource` around one that can be lost.

    Holds the open one, if there is one, number and time of the last pose, and since when it is away.
    """

    def __init__(
        self,
        name: str,
        opener: Callable[[], TrackerSource],
        clock: Clock,
        stop: threading.Event,
        connection_lost: ConnectionLost = nobody,
    ) -> None:
        """Open it.

        Args:
            name: Of the device, for poses of NaN.
            opener: Opens it; called again after each loss.
            clock: The clock of the poses' times.
            stop: Set when the slave is to end.
            away: Told before it is given back, and of each try to open it again.

        Raises:
            TrackerError: It is not there.
        """
        self._name, self._open, self._clock, self._stop = name, opener, clock, stop
        self._connection_lost = connection_lost
        self._closed = threading.Event()
        self._source: TrackerSource | None = opener()
        self._seq, self._last_ns = -1, -(2**62)
        self._away_ns: int | None = None
        self._try_ns = 0
        self._wait_s = FIRST_WAIT_S
        self._failures = Failures("tracker", clock.now_ns)
        self._counts: Counter[str] = Counter()

    def read(self) -> TrackerPose | None:
        """Next pose, of NaN while the system is away; None at the end of the stream, when stopped, or once closed.

        Raises:
            TrackerChoiceError: Several devices are there, and nobody said which one is meant.
        """
        while not (self._closed.is_set() or self._stop.is_set()):
            source = self._source if self._source is not None else self._return()
            if source is None:
                self._stop.wait(LOG_LOST_S)
                return self._numbered(self._nowhere())
            try:
                pose = source.read()
            except TrackerChoiceError:
                raise
            except Exception as error:  # noqa: BLE001 - whatever a driver raises is its device's failure
                if self._closed.is_set():  # under its hands
                    return None
                self._lose(error)
                continue
            if pose is None:
                return None
            if pose.t_ns <= self._last_ns:
                self._counts["late"] += 1
                continue
            if self._away_ns is not None and np.isfinite(pose.position_m).all():
                self._failures.over(f"back after loss number {self._counts['lost']}")
                self._counts["back"] += 1
                self._away_ns, self._wait_s = None, FIRST_WAIT_S
            return self._numbered(pose)
        return None

    def close(self) -> None:
        """Give the system back. Safe to call twice."""
        self._closed.set()
        self._drop()

    def counts(self) -> Mapping[str, int]:
        """Event -> how often, of this tracker and of all that were opened.

        `lost`, `back`; `late`: poses no later than the one before; `raised`: what a driver raised that is no
        error of ours; the events of all that were opened.
        """
        counts = Counter(self._counts)
        source = self._source
        counts.update(self._failures.ask(source.counts) if isinstance(source, Reporting) else {})
        return {"lost": 0, "back": 0, "raised": self._failures.raised, **counts}

    def metrics(self) -> Mapping[str, float]:
        """`away_s`, for how long the system has been lost, 0: it is there; and what the open one tells."""
        source, away_ns = self._source, self._away_ns
        away_s = 0.0 if away_ns is None else (self._clock.now_ns() - away_ns) * 1e-9
        return {
            "away_s": away_s,
            **(self._failures.ask(source.metrics) if isinstance(source, Reporting) else {}),
        }

    def _lose(self, error: Exception) -> None:
        now_ns = self._clock.now_ns()
        if self._away_ns is None:
            self._away_ns = now_ns
            self._counts["lost"] += 1
        self._connection_lost(f"tracker lost: {self._failures.log('lost', error)}")
        self._drop()
        self._try_ns = now_ns + round(1e9 * self._wait_s)

    def _drop(self) -> None:
        source, self._source = self._source, None
        if source is None:
            return
        self._counts.update(self._failures.ask(source.counts) if isinstance(source, Reporting) else {})
        self._failures.close(source)

    def _return(self) -> TrackerSource | None:
        """Open it again where that is due; None: not yet, or not there."""
        now_ns = self._clock.now_ns()
        if now_ns < self._try_ns:
            return None
        self._connection_lost("tracker lost: opens it again")
        self._wait_s = min(2.0 * self._wait_s, LONGEST_WAIT_S)  # until a pose has come
        self._try_ns = now_ns + round(1e9 * self._wait_s)
        try:
            self._source = self._open()
        except Exception as error:  # noqa: BLE001 - as above
            self._failures.log("still away", error)
        return self._source

    def _nowhere(self) -> TrackerPose:
        t_ns = max(self._clock.now_ns() - round(0.5e9 * LOG_LOST_S), self._last_ns + 1)
        return TrackerPose(self._name, 0, 0, t_ns, np.full(3, np.nan), np.full(4, np.nan))

    def _numbered(self, pose: TrackerPose) -> TrackerPose:
        """The pose with the number behind the last one: what a system counts begins anew with it."""
        self._seq, self._last_ns = self._seq + 1, pose.t_ns
        return pose if pose.seq == self._seq else replace(pose, seq=self._seq)
