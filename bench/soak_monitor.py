"""What is watched during a soak: memory of each process every few seconds, and each minute what came of the poses."""

import os
import time
from dataclasses import asdict, dataclass, field

import numpy as np

from bench.processes import Footprint, cpu_s, footprint
from bench.soak_rig import SoakRig
from bench.soak_steps import grown, mapped
from common.bus.bus import Bus, Subscription
from common.messages import HandPose, Health

_DEPTH = 4096
_LOSS = {"lost": ".lost", "skipped": ".skipped"}


@dataclass(frozen=True, slots=True)
class Minute:
    """What a minute was like.

    Attributes:
        t_s: Its end, since the start of the soak.
        poses_hz: Poses of hands.
        p50_ms, p99_ms: Latency: from the hand-over of the last frame that contributed to publication.
        load: Load average of the machine, which others may use as well.
        cores: Process -> processor time in seconds a second.
        counts: What the master counted since the start: lost, skipped, dropped, refused, blocked.
        clock_offset_us: Sender -> by how much its clock is ahead of the master's.
        clock_sigma_us: Sender -> how sure the master is of that.
        grown: Process -> mapping -> by how much that one has grown in this minute [MB].
    """

    t_s: float
    poses_hz: float
    p50_ms: float
    p99_ms: float
    load: float
    cores: dict[str, float]
    counts: dict[str, int]
    clock_offset_us: dict[str, float]
    clock_sigma_us: dict[str, float]
    grown: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])


@dataclass(slots=True)
class SoakHistory:
    """All that was watched: times since the start [s], footprints by process, minutes."""

    times_s: list[float] = field(default_factory=list[float])
    footprints: dict[str, list[Footprint]] = field(default_factory=dict[str, list[Footprint]])
    minutes: list[Minute] = field(default_factory=list[Minute])
    counts: dict[str, dict[str, int]] = field(default_factory=dict[str, dict[str, int]])

    def series(self, process: str, quantity: str) -> list[float]:
        """A quantity of a `Footprint`, of each reading."""
        return [float(getattr(one, quantity)) for one in self.footprints[process]]

    def plain(self) -> dict[str, object]:
        """For JSON; arrays by process and quantity."""
        quantities = Footprint.__dataclass_fields__
        return {
            "t_s": self.times_s,
            "footprint": {name: {q: self.series(name, q) for q in quantities} for name in self.footprints},
            "minutes": [asdict(one) for one in self.minutes],
            "counts": self.counts,
        }


class Watch:
    """Reads the processes of a rig and its bus. Holds what was seen, and the minute that has not ended."""

    def __init__(self, rig: SoakRig, bus: Bus) -> None:
        """Begin; time 0 is now."""
        self.history = SoakHistory(footprints={process.name: [] for process in rig.processes})
        self._rig, self._start_s = rig, time.monotonic()
        self._hands: Subscription = bus.subscribe("hand", depth=_DEPTH)
        self._reports: Subscription = bus.subscribe("health", depth=_DEPTH)
        self._latency_ms: list[float] = []
        self._health: dict[str, Health] = {}
        self._since_s, self._cpu_s = 0.0, {one.name: cpu_s(one.pid) for one in rig.processes}
        self._mapped = {one.name: mapped(one.pid) for one in rig.processes}

    @property
    def now_s(self) -> float:
        """Since the start."""
        return time.monotonic() - self._start_s

    def listen(self) -> None:
        """Take what came on the bus."""
        while isinstance(pose := self._hands.get(0.0), HandPose):
            self._latency_ms.append(pose.latency_ns * 1e-6)
        while isinstance(report := self._reports.get(0.0), Health):
            self._health[report.source] = report

    def read(self) -> None:
        """Read the memory of all processes.

        Raises:
            OSError: One of them has ended.
        """
        self.history.times_s.append(self.now_s)
        for process in self._rig.processes:
            self.history.footprints[process.name].append(footprint(process.pid))

    def end_minute(self) -> Minute:
        """Sum up what came since the last call.

        Raises:
            OSError: A process has ended.
        """
        self.listen()
        now_s, latencies = self.now_s, np.array(self._latency_ms)
        spent = {one.name: cpu_s(one.pid) for one in self._rig.processes}
        held = {one.name: mapped(one.pid) for one in self._rig.processes}
        took = now_s - self._since_s
        p50, p99 = np.percentile(latencies, [50, 99]) if len(latencies) else (np.nan, np.nan)
        metrics = self._health["master"].metrics if "master" in self._health else {}
        minute = Minute(
            now_s,
            len(latencies) / took,
            float(p50),
            float(p99),
            os.getloadavg()[0],
            {name: (spent[name] - self._cpu_s[name]) / took for name in spent},
            judged(self._health),
            _ending(metrics, ".clock_offset_us"),
            _ending(metrics, ".clock_sigma_us"),
            {name: more for name, now in held.items() if (more := grown(self._mapped[name], now))},
        )
        self.history.minutes.append(minute)
        self.history.counts = {name: dict(report.counts) for name, report in self._health.items()}
        self._since_s, self._cpu_s, self._mapped, self._latency_ms = now_s, spent, held, []
        return minute


def judged(health: dict[str, Health]) -> dict[str, int]:
    """What counts as loss, and what does not, summed over the rig, since it began.

    lost: sent and never came. skipped: never sent, for a camera or a slave had no time. dropped: came, and the master
    had no time. refused: came, and was not taken. blocked: a socket that did not take what was to be sent.
    """
    master = health["master"].counts if "master" in health else {}
    out = {name: sum(n for key, n in master.items() if key.endswith(end)) for name, end in _LOSS.items()}
    out["dropped"] = master.get("queue.dropped", 0)
    out["refused"] = sum(n for key, n in master.items() if key.startswith("refused."))
    sockets = ("would_block", "send_failed")
    out["blocked"] = sum(report.counts.get(one, 0) for report in health.values() for one in sockets)
    return out


def _ending(metrics: dict[str, float], end: str) -> dict[str, float]:
    """Sender -> value, of the gauges with this ending."""
    return {name.removesuffix(end): value for name, value in metrics.items() if name.endswith(end)}
