"""The live loop: messages in, poses out to every sink; and the figures of a run."""

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

import msgspec
import numpy as np

from common.clock import Clock
from common.messages import Detections, Health, ImuSample
from master.outputs.sink import Sink
from master.rates import CameraRates
from master.stereo.pipeline import SolvedPose

_NAME = 64  # characters of a name in `Health`
_KEPT = 18_000  # latencies kept, five minutes at 60 Hz: quantiles of an hour would halt the loop 3 ms every second


SeenT = TypeVar("SeenT", bound=Detections)
SeenT_co = TypeVar("SeenT_co", bound=Detections, covariant=True)
SeenT_contra = TypeVar("SeenT_contra", bound=Detections, contravariant=True)


class Source(Protocol[SeenT_co]):
    """Where detections and samples come from: the network, or a test."""

    def get(self, timeout_s: float) -> SeenT_co | ImuSample | None:
        """The next message, or None when none came in time."""
        ...


class Solver(Protocol[SeenT_contra]):
    """What makes poses of detections: the hands of a master."""

    def push(self, message: SeenT_contra) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, of each hand oldest first."""
        ...

    def push_sample(self, sample: ImuSample) -> None:
        """Take what an IMU measured."""
        ...


class RunFigures:
    """What a run achieved; written by the loop, read by health reports and the summary."""

    def __init__(self) -> None:
        self.poses = 0
        self.rates = CameraRates()
        # A ring of fixed size: the report of every second reads it in one copy, however long the run.
        self._latency_ms = np.zeros(_KEPT)
        self._first_ns = self._last_ns = 0

    def add(self, t_ns: int, latency_ns: int) -> None:
        """Count one published pose."""
        if self.poses == 0:
            self._first_ns = t_ns
        self._last_ns = t_ns
        self._latency_ms[self.poses % _KEPT] = latency_ns * 1e-6
        self.poses += 1

    def summary(self) -> dict[str, float]:
        """poses, poses_per_s (over the span of the poses), latency_p50_ms, latency_p99_ms."""
        span_s = (self._last_ns - self._first_ns) * 1e-9
        out = {"poses": float(self.poses)}
        if self.poses > 1 and span_s > 0:
            out["poses_per_s"] = round((self.poses - 1) / span_s, 2)
        if self.poses:
            p50, p99 = np.percentile(self._latency_ms[: self.poses], [50, 99])
            out |= {"latency_p50_ms": round(float(p50), 3), "latency_p99_ms": round(float(p99), 3)}
        return out


def run(
    source: Source[SeenT],
    hands: Solver[SeenT],
    sinks: Sequence[Sink],
    clock: Clock,
    figures: RunFigures,
    stop: threading.Event,
    watch: Callable[[SeenT], None] = lambda _message: None,
) -> None:
    """Solve and publish until `stop` is set; `watch` is shown every camera's message once its poses are out."""
    while not stop.is_set():
        message = source.get(timeout_s=0.1)
        if message is None:
            continue
        if isinstance(message, ImuSample):
            hands.push_sample(message)
            continue
        figures.rates.push(message)
        for solved in hands.push(message):
            now = clock.now_ns()
            pose = msgspec.structs.replace(solved.pose, latency_ns=now - solved.ready_t_ns)
            for sink in sinks:
                sink.write(pose)
            figures.add(now, pose.latency_ns)
        watch(message)


def health(
    session: int,
    clock: Clock,
    figures: RunFigures,
    counts: dict[str, int],
    times: Mapping[str, float] | None = None,
) -> Health:
    """The master's report; gauges tell what a camera runs at (camera_hz.NAME) from what is solved (poses_per_s)."""
    gauges = {name: value for name, value in figures.summary().items() if name != "poses"}
    gauges |= {f"camera_hz.{camera}"[:_NAME]: hz for camera, hz in figures.rates.camera_hz.items()}
    gauges |= times or {}
    return Health("master", session, clock.now_ns(), {"poses": figures.poses} | counts, gauges)
