"""Count what the slave's loop does, for `Health`: frames, drops, what was seen, detection time."""

import threading
import time
from collections.abc import Callable, Mapping

import numpy as np

from common.arrays import Float
from slave.failures import Failures

SMOOTHING = 0.05  # weight of the newest frame in the running means


class Counters:
    """Counters of the loop, written by the loop and read by the health thread.

    Holds the counts since the start, running means, what the last rate was reckoned from, and what frames failed of.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        others: Callable[[], Mapping[str, int]] = dict[str, int],
        more: Callable[[], Mapping[str, float]] = dict[str, float],
    ) -> None:
        """Count for the markers `names`, or whatever else is sought; `others` counts more, told with the own counts.

        `more` are gauges told with the own ones.
        """
        self._others, self._more = others, more
        self._lock = threading.Lock()
        self._frames = self._sought = 0
        self._dropped = 0
        self._empty = self._failed = 0
        self._failures = Failures("the loop")
        self._seen = np.zeros(len(names), np.int64)
        self._names = names
        self._last_seq: int | None = None
        self._detect_us = 0.0
        self._worst_us = 0.0
        self._rate_from = (time.monotonic_ns(), 0)

    def frame(self, seq: int, detect_ns: int, uv: Float) -> None:
        """Count one frame in which was sought.

        Args:
            seq: Camera's frame counter.
            detect_ns: Time the detection took [ns].
            uv: (M, 2) centroids [px], NaN row = not seen.
        """
        seen = np.isfinite(uv[:, 0])
        took_us = detect_ns * 1e-3
        with self._lock:
            self._count(seq)
            self._detect_us += (took_us - self._detect_us) * (SMOOTHING if self._sought else 1.0)
            self._worst_us = max(self._worst_us, took_us)
            self._sought += 1
            self._empty += not seen.any()
            self._seen += seen

    def part(self, seq: int) -> None:
        """Count one frame in which nothing is sought before others follow: a part of a strobed triple."""
        with self._lock:
            self._count(seq)

    def failed(self, seq: int, error: Exception) -> None:
        """Count one frame whose work raised an error.

        Its detection, or what follows it, raised; the error is logged now and then. A frame that was not
        counted by `frame` or `part` before is one that was dropped.
        """
        self._failures.log(f"nothing is made of frame {seq}", error)
        with self._lock:
            self._failed += 1

    def _count(self, seq: int) -> None:
        if self._last_seq is not None and seq > self._last_seq + 1:
            self._dropped += seq - self._last_seq - 1
        self._last_seq = seq
        self._frames += 1

    def counts(self) -> dict[str, int]:
        """Event -> how often since the start.

        frames, dropped, empty, failed, seen.<name>, and the others.
        """
        with self._lock:
            counts = {"frames": self._frames, "dropped": self._dropped, "empty": self._empty}
            counts["failed"] = self._failed
            counts |= {f"seen.{n}": int(k) for n, k in zip(self._names, self._seen, strict=True)}
        return {**counts, **self._others()}

    def metrics(self) -> dict[str, float]:
        """rate_hz since the last call, running mean and worst (since the last call) of detection [us].

        And those that are told beside them.
        """
        more = self._more()
        now_ns = time.monotonic_ns()
        with self._lock:
            since_ns, frames = self._rate_from
            rate_hz = (self._frames - frames) * 1e9 / max(now_ns - since_ns, 1)
            self._rate_from = (now_ns, self._frames)
            worst_us, self._worst_us = self._worst_us, 0.0
            own = {"rate_hz": rate_hz, "detect_us": self._detect_us, "detect_worst_us": worst_us}
        return {**own, **more}
