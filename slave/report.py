"""Count what a sender does, and report it: `Health` twice a second, on command.

The sender loop never waits for the bus: this thread opens it when the uplink has learned where the master's bus is,
opens it anew when another master takes over, and lives on without it when there is none.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from common.arrays import Float
from common.bus.bus import Bus
from common.clock import Clock
from common.errors import BusError
from common.imu.fusion import OrientationFilter
from common.machine import Machine, program
from common.messages import Command, Health
from slave.sources import Failures, Reporting
from slave.uplink import Uplink

if TYPE_CHECKING:
    from slave.preview import Previews
    from slave.raw import RawFrames
    from slave.tuning import CameraTuning

ALONE_AT = 6  # the report after which a slave without a master logs what it receives
_LOG = logging.getLogger(__name__)


class Reporter:
    """Publishes `Health`, and answers "report", "stop" and the commands of its parts.

    Where there is a picture, also "preview" (shows it for 3 s) and "still" (the next frame whole).
    """

    def __init__(
        self,
        name: str,
        uplink: Uplink,
        counters: Reporting,
        clock: Clock,
        connect: Callable[[str], Bus],
        stop: Callable[[], None],
        period_s: float = 0.5,
        *,
        previews: "Previews | None" = None,
        parts: "Sequence[CameraTuning | RawFrames]" = (),
    ) -> None:
        """Start the thread; `connect` opens a bus to the endpoint that `uplink` learns.

        Every `period_s` [s] a report: the checklist of the master judges by two of them, within two seconds.
        """
        self._name, self._uplink, self._counters, self._clock = name, uplink, counters, clock
        self._connect, self._stop, self._period_s = connect, stop, period_s
        self._previews, self._parts = previews, tuple(parts)
        self._commands = {verb: act for part in self._parts for verb, act in part.commands().items()}
        self._machine = Machine(Path.cwd())
        self._metrics: dict[str, float] = {}
        self._bus: Bus | None = None
        self._endpoint: str | None = None
        self._failures = Failures(f"{name} health")
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"{name} health", daemon=True)
        self._thread.start()

    def health(self, now: Mapping[str, float] | None = None) -> Health:
        """The report of this moment, with the metrics of the last period, or `now`."""
        counts = {**self._counters.counts(), **self._uplink.counts}
        for part in self._parts:
            counts |= part.counts()
        metrics = self._metrics | dict(now or {})
        return Health(self._name, self._uplink.session, self._clock.now_ns(), counts, metrics, *program())

    def answer(self, command: Command) -> Health:
        """Obey a command; another verb is a `ValueError` that names those there are."""
        plain: dict[str, Callable[[], None]] = {"report": lambda: None, "stop": self._stop}
        if (previews := self._previews) is not None:
            plain |= {"preview": lambda: previews.ask(command.body), "still": previews.ask_still}
        if command.verb in plain:
            plain[command.verb]()
            return self.health()
        if command.verb in self._commands:
            return self.health(self._commands[command.verb](command.body))
        verbs = ", ".join([*plain, *self._commands])
        raise ValueError(f"{self._name}: no command {command.verb!r}; there are {verbs}")

    def close(self) -> None:
        """End the thread and leave the bus. Safe to call twice."""
        self._closing.set()
        self._thread.join()

    def _work(self) -> None:
        log_every = 20  # reports
        count = 0
        while not self._closing.wait(self._period_s):
            if count % log_every == ALONE_AT and self._uplink.zenoh_endpoint is None:
                _LOG.warning("%s", _why_alone(self._uplink.counts))
            try:
                metrics = dict(self._counters.metrics())
                for part in self._parts:
                    part.look()
                    metrics |= part.metrics()
                self._metrics = metrics | self._machine.metrics()
                self._follow(self._uplink.zenoh_endpoint)
                if self._bus is not None:
                    self._bus.publish("health", self._name, self.health())
            except BusError as error:
                self._leave()
                if count % log_every == 0:
                    _LOG.warning("no bus: %s", error)
            except Exception as error:  # noqa: BLE001 - whatever it is of, the next report is tried
                self._failures.log("no report", error)
            if count % log_every == 0 and self._counters.counts().get("frames", 0):
                _LOG.info("%s", "  ".join(f"{k} {_short(v)}" for k, v in self._metrics.items()))
            count += 1
        self._leave()

    def _follow(self, endpoint: str | None) -> None:
        if endpoint is None or endpoint == self._endpoint:
            return
        self._leave()
        bus = self._connect(endpoint)
        bus.announce(self._name)
        bus.serve(self._name, self.answer)
        self._bus, self._endpoint = bus, endpoint
        if self._previews is not None:
            self._previews.use(bus)

    def _leave(self) -> None:
        if self._previews is not None:
            self._previews.use(None)
        if self._bus is not None:
            self._bus.close()
        self._bus, self._endpoint = None, None


def _short(value: float) -> str:
    """Three digits at least, and no exponent: a gain of 0.83 is not 1."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


_REFUSED = {
    "foreign": "of another rig key (or another program): compare the key files of both sides",
    "version": "of another version of the wire: install the same version on both sides",
    "secret": "not with the secret of this device: phalanx fleet deploy brings what fits",
    "duplicate_sender": "it has somebody of this name already: two slaves of one name?",
}


def _why_alone(counts: Mapping[str, int]) -> str:
    """What to look at when no master has answered, by what was refused."""
    why = next((text for reason, text in _REFUSED.items() if counts.get(f"refused.{reason}", 0)), None)
    if why is not None:
        return f"a master is received, but {why}"
    return "no master received yet: is it running, and does its --beacon reach this network and port?"


class Counters(Reporting):
    """Counters of one sender: written by its loop, read by the thread of the reports."""

    def __init__(
        self,
        items: str = "frames",
        gaps: str = "dropped",
        empty: str = "",
        *,
        source: object = None,
        counts: Callable[[], Mapping[str, int]] = dict[str, int],
        metrics: Callable[[], Mapping[str, float]] = dict[str, float],
    ) -> None:
        """Count `items`, `gaps` in their numbers, `empty` ones; add what `source` counts."""
        self._items, self._gaps, self._empty = items, gaps, empty
        self._source = source if isinstance(source, Reporting) else None
        self._more_counts, self._more_metrics = counts, metrics
        self._lock = threading.Lock()
        self._count = self._missing = self._empty_count = self._failed = 0
        self._failures = Failures("the loop")
        self._last_seq: int | None = None
        self._rate_from = (time.monotonic_ns(), 0)
        self.found = False

    def item(self, seq: int, found: bool = True) -> None:
        """Count an item, and what its number leaves out; `found`: it is not empty."""
        with self._lock:
            if self._last_seq is not None and seq > self._last_seq + 1:
                self._missing += seq - self._last_seq - 1
            self._last_seq = seq
            self._count += 1
            self._empty_count += not found
            self.found = found

    def failed(self, seq: int, error: Exception) -> None:
        """Count and log an item whose work raised an error."""
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
        of_source = {} if self._source is None else dict(self._source.counts())
        return {**counts, **of_source, **self._more_counts()}

    def metrics(self) -> dict[str, float]:
        """rate_hz since the last call, and the others, as far as they are finite."""
        of_source = {} if self._source is None else dict(self._source.metrics())
        more = {**of_source, **self._more_metrics()}
        now_ns = time.monotonic_ns()
        with self._lock:
            since_ns, count = self._rate_from
            rate_hz = (self._count - count) * 1e9 / max(now_ns - since_ns, 1)
            self._rate_from = (now_ns, self._count)
        return {name: value for name, value in ({"rate_hz": rate_hz} | more).items() if isfinite(value)}


class DetectionCounters(Counters):
    """Counters of a camera: also what was detected, and how long that took."""

    def __init__(
        self,
        names: tuple[str, ...],
        counts: Callable[[], Mapping[str, int]] = dict[str, int],
        metrics: Callable[[], Mapping[str, float]] = dict[str, float],
    ) -> None:
        super().__init__(counts=counts, metrics=metrics)
        self._names, self._seen = names, np.zeros(len(names), np.int64)
        self._searched = self._empty_frames = 0
        self._detect_us = self._worst_us = 0.0

    def frame(self, seq: int, detect_ns: int, uv: Float) -> None:
        """Count one searched frame with its centroids `uv` (M, 2) [px], NaN = not seen."""
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

    def counts(self) -> dict[str, int]:
        """Also `empty`: frames in which nothing was seen; `seen.<name>`."""
        with self._lock:
            seen = {f"seen.{name}": int(count) for name, count in zip(self._names, self._seen, strict=True)}
            own = {"empty": self._empty_frames, **seen}
        return own | super().counts()

    def metrics(self) -> dict[str, float]:
        """Also mean and worst (since the last call) time of detection [us]."""
        with self._lock:
            own = {"detect_us": self._detect_us, "detect_worst_us": self._worst_us}
            self._worst_us = 0.0
        return own | super().metrics()


def imu_counters(source: object, orientation: OrientationFilter | None = None) -> Counters:
    """Counters of samples, with what the IMU and its orientation filter report."""
    if orientation is None:
        return Counters("samples", "skipped", source=source)

    def metrics() -> dict[str, float]:
        bias = zip("xyz", orientation.bias_rad_s.tolist(), strict=True)
        found = {f"bias_{axis}_rad_s": value for axis, value in bias}
        found["heading_sigma_rad"] = orientation.heading_sigma_rad
        found["at_rest"] = float(orientation.at_rest)
        return found

    return Counters("samples", "skipped", source=source, counts=lambda: orientation.counts, metrics=metrics)


def pose_counters(source: object) -> Counters:
    """Counters of poses, those of NaN as `nowhere`; `tracked` 1: yes."""

    def metrics() -> dict[str, float]:
        return {"tracked": float(counters.found)}

    counters = Counters("poses", "skipped", "nowhere", source=source, metrics=metrics)
    return counters
