"""A real IMU that is unplugged and comes back: opened anew without restarting the slave.

As for cameras: an error while it is opened for the first time is an error. Once it has run, losing it is an event: it
is given back, and opened again after 0.2 s, 0.4 s ... at most 2 s, until it is there or the slave is told to stop.
Every opening asks who is there and writes all settings again. Meanwhile there are no samples; `seq` goes on behind
a gap of as many as fit into the absence, so that those count as skipped. Whatever a driver raises is a loss of its IMU.
"""

import threading
from collections import Counter
from collections.abc import Callable, Mapping

from msgspec.structs import replace

from common.clock import Clock
from common.messages import ImuSample
from slave.failures import Failures
from slave.service import ConnectionLost, nobody
from slave.sources import ImuSource, Reporting

FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 1.0  # what is plugged in again tracks within two seconds


class ReconnectingImu:
    """An `ImuSource` around one that can be lost.

    Holds the open IMU, if there is one, number and time of the last sample, and since when it is away.
    """

    def __init__(
        self,
        opener: Callable[[], ImuSource],
        rate_hz: float,
        clock: Clock,
        stop: threading.Event,
        connection_lost: ConnectionLost = nobody,
    ) -> None:
        """Open the IMU.

        Args:
            opener: Opens it; called again after each loss.
            rate_hz: Counts the samples of an absence.
            clock: The clock of the samples' times.
            stop: Set when the slave is to end; `read` then gives up waiting for the IMU.
            away: Told that it is lost, and of each try to open it again.

        Raises:
            ImuError: It is not there, or refused a setting.
        """
        self._open, self._rate_hz, self._clock, self._stop = opener, rate_hz, clock, stop
        self._connection_lost = connection_lost
        self._closed = threading.Event()
        self._source: ImuSource | None = opener()
        self._base: int | None = 0  # added to the own numbers of the IMU; None: of one that was just opened
        self._last: tuple[int, int] | None = None  # seq, t_ns
        self._away_ns: int | None = None  # since when; until a sample has come
        self._failures = Failures("IMU", clock.now_ns)
        self._wait_s = FIRST_WAIT_S
        self._counts: Counter[str] = Counter()  # with those of the IMUs that were given back

    def read(self) -> ImuSample | None:
        """Next sample; waits for a lost IMU. None at the end of the stream, when stopped, or once closed."""
        while True:
            source = self._source if self._source is not None else self._return()
            if source is None or self._closed.is_set():
                return None
            try:
                sample = source.read()
                if sample is None:
                    return None
                if (numbered := self._number(sample)) is not None:
                    return numbered
            except Exception as error:  # noqa: BLE001 - whatever a driver raises is its IMU's failure
                if self._closed.is_set():  # under its hands
                    return None
                self._lose(error)

    def close(self) -> None:
        """Give the IMU back. Safe to call twice, and from another thread that ends a wait."""
        self._closed.set()
        self._drop()

    def counts(self) -> Mapping[str, int]:
        """Event -> how often, of this IMU and of all that were opened.

        `lost`, `back`; `late`: samples no later than the one before; `raised`: what a driver raised that is
        no error of ours; the events of all IMUs that were opened.
        """
        counts = Counter(self._counts)
        source = self._source
        counts.update(self._failures.ask(source.counts) if isinstance(source, Reporting) else {})
        return {"lost": 0, "back": 0, "raised": self._failures.raised, **counts}

    def metrics(self) -> Mapping[str, float]:
        """`away_s`, for how long it has been lost, 0: it is there; and what the open IMU tells."""
        source, away_ns = self._source, self._away_ns
        away_s = 0.0 if away_ns is None else (self._clock.now_ns() - away_ns) * 1e-9
        return {
            "away_s": away_s,
            **(self._failures.ask(source.metrics) if isinstance(source, Reporting) else {}),
        }

    def _lose(self, error: Exception) -> None:
        if self._away_ns is None:
            self._away_ns = self._clock.now_ns()
            self._counts["lost"] += 1
        self._connection_lost(f"IMU lost: {self._failures.log('lost', error)}")
        self._drop()

    def _drop(self) -> None:
        source, self._source = self._source, None
        if source is None:
            return
        self._counts.update(self._failures.ask(source.counts) if isinstance(source, Reporting) else {})
        self._failures.close(source)

    def _return(self) -> ImuSource | None:
        """Open until it works; None when told to stop."""
        while not (self._stop.wait(self._wait_s) or self._closed.is_set()):
            self._wait_s = min(2.0 * self._wait_s, LONGEST_WAIT_S)  # until a sample has come
            try:
                self._source = self._open()
            except Exception as error:  # noqa: BLE001 - as above
                self._connection_lost(f"IMU away: {self._failures.log('still lost', error)}")
                continue
            if self._closed.is_set():  # while it was being opened
                self._drop()
            self._base = None
            return self._source
        return None

    def _number(self, sample: ImuSample) -> ImuSample | None:
        """The sample with a number that goes on where the last IMU ended; None: it is from before the loss."""
        if self._last is not None and sample.t_ns <= self._last[1]:
            self._counts["late"] += 1
            return None
        if self._away_ns is not None:
            self._failures.over(f"back after loss number {self._counts['lost']}")
            self._counts["back"] += 1
            self._away_ns, self._wait_s = None, FIRST_WAIT_S
        if self._base is None:
            self._base = -sample.seq
            if self._last is not None:
                seq, t_ns = self._last
                self._base += seq + max(1, round((sample.t_ns - t_ns) * 1e-9 * self._rate_hz))
        seq = sample.seq + self._base
        self._last = (seq, sample.t_ns)
        return sample if self._base == 0 else replace(sample, seq=seq)
