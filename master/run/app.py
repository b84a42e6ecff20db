"""Live loop takes messages to the sinks and counts and times a run.

Messages in; hands, objects, contact and gestures out to every sink. Times are measured outside the pure code.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias, TypeVar

import numpy as np

from common.clock import Clock
from common.machine import program
from common.messages import (
    Contact,
    Detections,
    Gesture,
    HandPose,
    Health,
    ImuSample,
    ObjectPose,
    ResultMessage,
    TagDetections,
    TrackerPose,
    restamped,
)
from master.estimator.pipeline import SolvedPose
from master.monitor.rates import CameraRates
from master.objects.line import SolvedObject
from master.outputs.bus import Receive, Sink

_KEPT = 18_000  # latencies kept, five minutes at 60 Hz: quantiles of an hour would halt the loop 3 ms every second
_OBJECT_KEPT = 2_000  # and of objects, some seconds of each

SeenT = TypeVar("SeenT", bound=Detections)
# What comes beside the frames of cameras.
AuxiliaryMessage: TypeAlias = TagDetections | ImuSample | TrackerPose
_AUXILIARY = (TagDetections, ImuSample, TrackerPose)


Solved: TypeAlias = SolvedPose | SolvedObject | Contact | Gesture
# The world of a master takes one message; yields what it completes, each before the next is computed.
Solve: TypeAlias = Callable[[SeenT | AuxiliaryMessage], Iterable[Solved]]


class RunFigures:
    """Performance figures of a run, written by the loop, read by reports and summary."""

    def __init__(self) -> None:
        self.poses = 0
        # All keys from the beginning: a report on another thread never sees it grow.
        self.published = Counter(objects=0, contacts=0, gestures=0)
        self.rates = CameraRates()
        # A ring of fixed size: the report of every second reads it in one copy, however long the run.
        self._latency_ms = np.zeros(_KEPT)
        self._object_ms = np.zeros(_OBJECT_KEPT)
        self._first_ns = self._last_ns = 0

    def count(self, t_ns: int, message: ResultMessage) -> None:
        """Count what was published at `t_ns`."""
        if isinstance(message, HandPose):
            self.add(t_ns, message.latency_ns)
        elif isinstance(message, ObjectPose):
            if message.tracked:  # what is held waits for nothing that was seen
                self._object_ms[self.published["objects"] % _OBJECT_KEPT] = message.latency_ns * 1e-6
                self.published["objects"] += 1
        else:
            self.published["contacts" if isinstance(message, Contact) else "gestures"] += 1

    def add(self, t_ns: int, latency_ns: int) -> None:
        """Count one published pose of a hand."""
        if self.poses == 0:
            self._first_ns = t_ns
        self._last_ns = t_ns
        self._latency_ms[self.poses % _KEPT] = latency_ns * 1e-6
        self.poses += 1

    def summary(self) -> dict[str, float]:
        """Return rate and latencies of the hand poses, and latencies of tracked objects.

        poses, poses_per_s (over the span of the poses), latency_p50_ms, latency_p99_ms,
        object_latency_p50_ms, object_latency_p99_ms.
        """
        span_s = (self._last_ns - self._first_ns) * 1e-9
        out = {"poses": float(self.poses)}
        if self.poses > 1 and span_s > 0:
            out["poses_per_s"] = round((self.poses - 1) / span_s, 2)
        for of, ring, count in (
            ("latency", self._latency_ms, self.poses),
            ("object_latency", self._object_ms, self.published["objects"]),
        ):
            if count:
                p50, p99 = np.percentile(ring[:count], [50, 99])
                out |= {f"{of}_p50_ms": round(float(p50), 3), f"{of}_p99_ms": round(float(p99), 3)}
        return out


def observed(
    solve: Solve[SeenT], rates: CameraRates, monitor: Callable[[SeenT], None]
) -> Callable[[SeenT | AuxiliaryMessage], Iterator[Solved]]:
    """Return a solver with camera rates counted before, `monitor` called after."""

    def push(message: SeenT | AuxiliaryMessage) -> Iterator[Solved]:
        if isinstance(message, _AUXILIARY):
            yield from solve(message)
            return
        rates.push(message)
        yield from solve(message)
        monitor(message)

    return push


def run(
    receive: Receive[SeenT | AuxiliaryMessage],
    solve: Solve[SeenT],
    sinks: Sequence[Sink],
    clock: Clock,
    figures: RunFigures,
    stop: threading.Event,
) -> None:
    """Solve and publish until `stop` is set."""
    while not stop.is_set():
        message = receive(0.1)
        if message is None:
            continue
        for solved in solve(message):
            now = clock.now_ns()
            published = result_at(solved, now)
            for sink in sinks:
                sink.write(published)
            figures.count(now, published)


def result_at(solved: Solved, t_ns: int) -> ResultMessage:
    """Return the message that is published at `t_ns`; a pose has its latency."""
    if isinstance(solved, Contact | Gesture):
        return solved
    return restamped(solved.pose, latency_ns=t_ns - solved.ready_t_ns)


def health(
    session: int,
    clock: Clock,
    figures: RunFigures,
    counts: dict[str, int],
    times: Mapping[str, float] | None = None,
) -> Health:
    """Return the master's health report.

    Metrics distinguish the rate at which a camera runs (camera_hz.NAME) from the rate of solved poses
    (poses_per_s).
    """
    metrics = {name: value for name, value in figures.summary().items() if name != "poses"}
    # characters of a name in `Health`
    metrics |= {f"camera_hz.{camera}"[:64]: hz for camera, hz in figures.rates.camera_hz.items()}
    metrics |= times or {}
    published = {name: number for name, number in figures.published.items() if number}
    events = {"poses": figures.poses} | published | counts
    return Health("master", session, clock.now_ns(), events, metrics, *program())


class StageTimes:
    """Sums durations by stage name."""

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Measure with the clock `now_ns`, for processor time `time.thread_time_ns`."""
        self._now_ns = now_ns
        self._stages: dict[str, StageTime] = {}

    def __call__(self, name: str) -> "StageTime":
        """What measures passages through stage `name`."""
        stage = self._stages.get(name)
        if stage is None:
            stage = self._stages[name] = StageTime(self._now_ns)
        return stage

    def mean_us(self) -> dict[str, float]:
        """Mean duration by stage [us], in the order of first use."""
        return {
            name: round(one.total_ns / one.count / 1e3, 1) for name, one in self._stages.items() if one.count
        }

    def total_us(self) -> dict[str, float]:
        """All durations of each stage together [us], in the order of first use."""
        return {name: one.total_ns / 1e3 for name, one in self._stages.items() if one.count}


class StageTime:
    """Sums the durations of one stage, which is never entered twice at once."""

    __slots__ = ("_began_ns", "_now_ns", "count", "total_ns")

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns, self._began_ns, self.count, self.total_ns = now_ns, 0, 0, 0

    def __enter__(self) -> None:
        self._began_ns = self._now_ns()

    def __exit__(self, *_: object) -> None:
        self.total_ns += self._now_ns() - self._began_ns
        self.count += 1
