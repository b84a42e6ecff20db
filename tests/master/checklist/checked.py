"""A made-up rig for the tests of the checklist: two cameras, a wrist device and an IMU, second by second."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from common.messages import CheckItem, Health
from master.checklist.facts import CameraPlan, MasterNow, Plan, SenderNow
from master.checklist.publisher import ChecklistMonitor
from master.run.link_senders import MarkerCounts, RejectedPeer

MARKERS = ("thumb", "index", "middle", "ring", "little", "back")
CAMERAS = (
    CameraPlan("left", 60.0, (640, 480), False, (MARKERS,), MARKERS),
    CameraPlan("right", 60.0, (640, 480), False, (MARKERS,), MARKERS),
    CameraPlan("wrist", 90.0, (640, 480), True, ()),
)
PLAN = Plan(CAMERAS, ("imu",), ((("left", "right"), len(MARKERS)),))
POLL_NS = 250_000_000
NAMES = ("left", "right", "wrist", "imu")


@dataclass
class Bench:
    """Holds a watch, the time, all counters, and what is wrong; `seconds` lets time go by."""

    watch: ChecklistMonitor = field(default_factory=lambda: ChecklistMonitor(PLAN))
    t_ns: int = 10**12
    away: set[str] = field(default_factory=set[str])
    loss: dict[str, float] = field(default_factory=dict[str, float])
    rate: dict[str, float] = field(default_factory=dict[str, float])
    duplicate: dict[str, RejectedPeer | None] = field(default_factory=dict[str, RejectedPeer | None])
    unknown_peer: dict[str, RejectedPeer | None] = field(default_factory=dict[str, RejectedPeer | None])
    unproven: dict[str, RejectedPeer | None] = field(default_factory=dict[str, RejectedPeer | None])
    markers: dict[str, MarkerCounts] = field(default_factory=dict[str, MarkerCounts])
    sigma_ns: dict[str, float | None] = field(default_factory=dict[str, float | None])
    disk_mb: float = 9000.0
    apart: float = 0.0
    files: tuple[CheckItem, ...] = ()
    metrics: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])
    counts: dict[str, dict[str, int]] = field(default_factory=dict[str, dict[str, int]])
    per_s: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])
    session: dict[str, int] = field(default_factory=dict[str, int])
    _sums: dict[tuple[str, str], float] = field(default_factory=dict[tuple[str, str], float])
    _looks: int = 0

    def seconds(self, seconds: float) -> list[tuple[float, tuple[CheckItem, ...]]]:
        """Look four times a second; what each look told, with the time since now [s]."""
        shown: list[tuple[float, tuple[CheckItem, ...]]] = []
        for k in range(round(seconds * 4)):
            self.t_ns += POLL_NS
            self._looks += 1
            for name in NAMES:
                self._count(name, 0.25)
                if self._looks % 2 == 0 and name not in self.away:
                    self.watch.push_health(self._health(name), self.t_ns)
            self.watch.push(self._now())
            shown.append((0.25 * (k + 1), self.watch.look(self.t_ns)))
        return shown

    def keys(self) -> list[tuple[str, str]]:
        """Code and subject of what a look tells now."""
        return [(item.code, item.subject) for item in self.seconds(0.25)[-1][1]]

    def _add(self, name: str, event: str, number: float) -> int:
        key = name, event
        self._sums[key] = self._sums.get(key, 0.0) + number
        return int(self._sums[key] + 1e-6)

    def _count(self, name: str, dt_s: float) -> None:
        if name in self.away:
            return
        rate = self.rate.get(name, {"wrist": 30.0, "imu": 120.0}.get(name, 60.0))
        lost = self.loss.get(name, 0.0)
        self._add(name, "received", dt_s * rate * (1.0 - lost))
        self._add(name, "lost", dt_s * rate * lost)
        typical = {f"seen.{marker}": rate for marker in MARKERS} | {
            f"ambiguous.{marker}": 0.0 for marker in MARKERS
        }
        if name == "wrist":
            typical = dict.fromkeys(("strobe.out_of_step", "strobe.unlit"), 0.0)
        frames = {"frames": self.rate.get(name, 90.0) if name == "wrist" else rate}
        for event, number in (frames | typical | self.per_s.get(name, {})).items():
            self._add(name, event, dt_s * number)

    def _health(self, name: str) -> Health:
        counts = {
            event: int(n + 1e-6) for (who, event), n in self._sums.items() if who == name and who != "master"
        }
        metrics = {"width_px": 640.0, "height_px": 480.0, "light_exposure": 1.0, "temperature_c": 50.0}
        metrics |= {"temperature_limit_c": 80.0, "disk_free_mb": 8000.0, "exposure_us": 5000.0}
        metrics |= {"wanted.exposure_us": 5000.0} | {f"colour.{marker}": 1.0 for marker in MARKERS}
        shown = metrics | self.metrics.get(name, {})
        counts |= self.counts.get(name, {})
        return Health(name, self.session.get(name, 1), self.t_ns + 10**9, counts, shown)

    def _now(self) -> MasterNow:
        senders = {
            name: SenderNow(
                name not in self.away,
                self._add(name, "received", 0.0),
                self._add(name, "lost", 0.0),
                self.sigma_ns.get(name, 5e4),
                self.duplicate.get(name),
                self.unknown_peer.get(name),
                self.unproven.get(name),
                self.markers.get(name),
            )
            for name in NAMES
        }
        poses = self._add("master", "poses", 15.0)
        apart = self._add("master", "apart", 15.0 * self.apart * len(MARKERS))
        group: Mapping[str, int] = {"poses": poses, "epipolar_outliers": apart}
        return MasterNow(True, senders, [group], self.disk_mb, self.files)
