"""Count what a sender does, for `Health`.

Items, gaps, failures, what was detected, and what its device reports.
"""

import threading
import time
from collections.abc import Callable, Mapping
from math import isfinite

import numpy as np

from common.arrays import Float
from common.imu.fusion import OrientationFilter
from slave.failures import Failures
from slave.sources import Reporting


class Counters:
    """Counters of one sender: written by its loop, read by the thread of the reports.

    Holds the counts since the start, whether the last item had anything in it, and where the last rate began.
    """

    def __init__(
        self,
        items: str = "frames",
        gaps: str = "dropped",
        empty: str = "",
        *,
        counts: Callable[[], Mapping[str, int]] = dict[str, int],
        metrics: Callable[[], Mapping[str, float]] = dict[str, float],
    ) -> None:
        """Count from nothing.

        Args:
            items: What the items are called.
            gaps: What their numbers leave out is called.
            empty: What items without anything in them are called; empty: they are not counted.
            counts: More counts, given out with these.
            metrics: More metrics, likewise; those that are not numbers are omitted.
        """
        self._items, self._gaps, self._empty = items, gaps, empty
        self._more_counts, self._more_metrics = counts, metrics
        self._lock = threading.Lock()
        self._count = self._missing = self._empty_count = self._failed = 0
        self._failures = Failures("the loop")
        self._last_seq: int | None = None
        self._rate_from = (time.monotonic_ns(), 0)
        self.found = False

    def item(self, seq: int, found: bool = True) -> None:
        """Count one item, and what its number leaves out.

        `found`: whether there is anything in it.
        """
        with self._lock:
            if self._last_seq is not None and seq > self._last_seq + 1:
                self._missing += seq - self._last_seq - 1
            self._last_seq = seq
            self._count += 1
            self._empty_count += not found
            self.found = found

    def failed(self, seq: int, error: Exception) -> None:
        """Count one item whose work raised an error, which is logged now and then.

        An item that was not counted before is one that was dropped.
        """
        self._failures.log(f"nothing is made of {self._items.removesuffix('s')} {seq}", error)
        with self._lock:
            self._failed += 1

    @property
    def total(self) -> int:
        """How many items there were."""
        return self._count

    def summary(self) -> str:
        """How many items there were, as text."""
        empty = f", {self._empty_count} of them {self._empty}" if self._empty else ""
        return f"{self._count} {self._items}{empty}"

    def counts(self) -> dict[str, int]:
        """Event -> how often: items, gaps, failed, empty ones, and the others."""
        with self._lock:
            counts = {self._items: self._count, self._gaps: self._missing, "failed": self._failed}
            if self._empty:
                counts[self._empty] = self._empty_count
            counts |= self._own_counts()
        return {**counts, **self._more_counts()}

    def metrics(self) -> dict[str, float]:
        """rate_hz since the last call, and the others."""
        more = self._more_metrics()
        now_ns = time.monotonic_ns()
        with self._lock:
            since_ns, count = self._rate_from
            rate_hz = (self._count - count) * 1e9 / max(now_ns - since_ns, 1)
            self._rate_from = (now_ns, self._count)
            metrics = {"rate_hz": rate_hz, **self._own_metrics(), **more}
        return {name: value for name, value in metrics.items() if isfinite(value)}

    def _own_counts(self) -> dict[str, int]:
        return {}

    def _own_metrics(self) -> dict[str, float]:
        return {}


class DetectionCounters(Counters):
    """Counters of a camera: also what was detected, and how long that took.

    Holds how often each marker or finger was seen, and mean and worst time of detection.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        counts: Callable[[], Mapping[str, int]] = dict[str, int],
        metrics: Callable[[], Mapping[str, float]] = dict[str, float],
    ) -> None:
        """Count for the markers `names`, or other things; the rest as `Counters`."""
        super().__init__(counts=counts, metrics=metrics)
        self._names, self._seen = names, np.zeros(len(names), np.int64)
        self._searched = self._empty_frames = 0
        self._detect_us = self._worst_us = 0.0

    def frame(self, seq: int, detect_ns: int, uv: Float) -> None:
        """Count one frame in which was searched.

        One that is a part of a strobe cycle is counted by `item`.

        Args:
            seq: Camera's frame counter.
            detect_ns: Time the detection took [ns].
            uv: (M, 2) centroids [px], NaN row = not seen.
        """
        seen = np.isfinite(uv[:, 0])
        took_us = detect_ns * 1e-3
        self.item(seq)
        with self._lock:
            newest = 0.05 if self._searched else 1.0  # weight in the mean: the last 20 frames
            self._detect_us += (took_us - self._detect_us) * newest
            self._worst_us = max(self._worst_us, took_us)
            self._searched += 1
            self._empty_frames += not seen.any()
            self._seen += seen

    def _own_counts(self) -> dict[str, int]:
        """`empty`: frames in which nothing was seen; `seen.<name>`."""
        seen = {f"seen.{name}": int(count) for name, count in zip(self._names, self._seen, strict=True)}
        return {"empty": self._empty_frames, **seen}

    def _own_metrics(self) -> dict[str, float]:
        """Mean and worst (since the last call) time of detection [us]."""
        worst_us, self._worst_us = self._worst_us, 0.0
        return {"detect_us": self._detect_us, "detect_worst_us": worst_us}


def imu_counters(source: object, orientation: OrientationFilter | None = None) -> Counters:
    """Counters of samples, with what the IMU and its orientation filter report."""

    def counts() -> dict[str, int]:
        own = dict(source.counts()) if isinstance(source, Reporting) else {}
        return own | ({} if orientation is None else dict(orientation.counts))

    def metrics() -> dict[str, float]:
        found = dict(source.metrics()) if isinstance(source, Reporting) else {}
        if orientation is not None:
            bias = zip("xyz", orientation.bias_rad_s.tolist(), strict=True)
            found |= {f"bias_{axis}_rad_s": value for axis, value in bias}
            found["heading_sigma_rad"] = orientation.heading_sigma_rad
            found["at_rest"] = float(orientation.at_rest)
        return found

    return Counters("samples", "skipped", counts=counts, metrics=metrics)


def pose_counters(source: object) -> Counters:
    """Counters of poses, those of NaN as `nowhere`.

    With what the tracker reports, and `tracked` (1: yes).
    """

    def metrics() -> dict[str, float]:
        own = dict(source.metrics()) if isinstance(source, Reporting) else {}
        return {"tracked": float(counters.found)} | own

    own = source.counts if isinstance(source, Reporting) else dict[str, int]
    counters = Counters("poses", "skipped", "nowhere", counts=own, metrics=metrics)
    return counters
