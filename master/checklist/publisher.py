"""Publisher sends the checklist that a monitor derives from all rules.

The monitor is a push machine: reports and counts in, current problems out; no clock, no socket. The publisher
feeds and publishes it five times a second, on a thread of its own, since the one that reports stands still
while changed files are read. Four things keep the list quiet:

- *Bounds*: what is wrong above one bound is well only below a lower one (`facts.beyond`).
- *Time*: what may be the consequence of something else is reported `HOLD_NS` later than that would be.
- *Causes*: while one thing is wrong, what follows from it is not reported, nor for a while after, while windows still
  hold what was. A camera that is away is not slow, loses nothing, sees nothing (`_FOLLOWS`).
- *Coming up*: a sender that has just come, or the master, is given the time that its first numbers take.
"""

import threading
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from common.bus.bus import Bus
from common.clock import Clock
from common.errors import BusError
from common.machine import Machine
from common.messages import MAX_CHECKS, CheckCode, CheckItem, Checklist, Health
from common.messages.streams import MASTER
from master.checklist.facts import MasterNow, Plan, SenderNow, SlaveReports, Verdict, keys_of, plan_of
from master.checklist.files import FileMonitor
from master.checklist.link_rules import LinkRules
from master.checklist.slave_rules import MovedRule, SlaveRules
from master.rig.pipeline import Pipeline
from master.rig.setup import RigSetup
from master.run.ingest import Ingest

CODES: tuple[CheckCode, ...] = get_args(CheckCode)
HOLD_NS: dict[CheckCode, int] = {
    "exposure_drift": 300_000_000,
    "background_in_range": 300_000_000,
    "marker_unseen": 300_000_000,
    "camera_moved": 400_000_000,
    "clock_unsynchronised": 500_000_000,
}
_ABSENT: AbstractSet[CheckCode] = {"camera_absent", "imu_silent"}
_COLOURS: AbstractSet[CheckCode] = {"marker_unseen", "background_in_range"}
_LIGHT: AbstractSet[CheckCode] = {"exposure_drift"}
_MOVED: AbstractSet[CheckCode] = {"camera_moved"}
_RATE: AbstractSet[CheckCode] = {"rate_low"}
_LOSS: AbstractSet[CheckCode] = {"packet_loss"}
_REJECTED: AbstractSet[CheckCode] = {
    "duplicate_sender",
    "version_mismatch",
    "secret_mismatch",
    "marker_mismatch",
}
_OF_SENDER: AbstractSet[CheckCode] = frozenset(CODES) - _ABSENT - _REJECTED
# Cause -> what is not reported of the same camera, its markers, or a group with it in it.
_FOLLOWS: dict[CheckCode, AbstractSet[CheckCode]] = {
    "camera_absent": _OF_SENDER,
    "imu_silent": _OF_SENDER,
    "auto_mode": _COLOURS | _LIGHT | _MOVED,
    "exposure_drift": _COLOURS | _MOVED,
    "colour_collision": _COLOURS | _MOVED,
    "calibration_absent": _COLOURS | _LIGHT | _MOVED,
    "background_in_range": {"marker_unseen", "camera_moved"},
    "clock_unsynchronised": _MOVED,
    "strobe_slipped": _RATE,
    "too_hot": _RATE,
    "version_mismatch": _ABSENT,
    "secret_mismatch": _ABSENT,
    "marker_mismatch": _ABSENT | _COLOURS | _RATE | _LOSS | _MOVED,
}


@dataclass(slots=True)
class _Latch:
    """Decides if one thing is wrong, and holds since when and what was reported."""

    since_ns: int | None = None
    shown: bool = False
    verdict: Verdict | None = None

    def push(self, verdict: Verdict, t_ns: int) -> None:
        if verdict.wrong is None:
            return  # as before, with the words of before
        if not verdict.wrong:
            self.since_ns, self.shown = None, False
            return
        self.since_ns = t_ns if self.since_ns is None else self.since_ns
        self.verdict = verdict
        self.shown |= t_ns - self.since_ns >= HOLD_NS.get(verdict.code, 0)


class ChecklistMonitor:
    """Monitor that evaluates all checklist rules."""

    def __init__(self, plan: Plan) -> None:
        """Watch who is to be there by `plan`."""
        self._links = LinkRules()
        self._reports: dict[str, SlaveReports] = {}
        self._latches: dict[tuple[CheckCode, str], _Latch] = {}
        self._causes: dict[tuple[CheckCode, str], tuple[Verdict, int]] = {}
        self._now: MasterNow | None = None
        self.follow(plan)

    def follow(self, plan: Plan) -> None:
        """Continue with other files of the same senders; slaves are judged anew."""
        self._plan = plan
        cameras = {camera.name: camera for camera in plan.cameras}
        self._slaves = {name: SlaveRules(cameras.get(name)) for name in (*cameras, *plan.imus)}
        self._moved = [MovedRule() for _ in plan.groups]

    def push_health(self, health: Health, t_ns: int) -> None:
        """Take a report that came at `t_ns` [ns]; ignored where it is of no slave."""
        if (reports := self._reports.get(health.source)) is not None:
            reports.push(health, t_ns)
        elif health.source in self._slaves:
            self._reports[health.source] = SlaveReports(health, t_ns)

    def push(self, now: MasterNow) -> None:
        """Take what the master counted by now."""
        self._now = now

    def look(self, t_ns: int) -> tuple[CheckItem, ...]:
        """Current problems at rising `t_ns` [ns], each once, in the codes' order."""
        if self._now is None:
            return ()
        judged: set[tuple[CheckCode, str]] = set()
        for verdict in self._verdicts(self._now, t_ns):
            latch = self._latches.setdefault(verdict.key, _Latch())
            # Two rules of one code and subject: what is wrong by one is not made well by the other.
            if verdict.key not in judged or verdict.wrong:
                latch.push(verdict, t_ns)
            judged.add(verdict.key)
        for key in self._latches.keys() - judged:
            del self._latches[key]  # nobody speaks of it any more
        shown = [
            latch.verdict for latch in self._latches.values() if latch.shown and latch.verdict is not None
        ]
        self._causes = {key: cause for key, cause in self._causes.items() if cause[1] > t_ns}
        reported = [verdict for verdict in shown if not self._follows(verdict, shown)]
        for verdict in reported:
            back_ns, settled_ns = 500_000_000, 2_500_000_000  # who comes back settles by its own rules
            after_ns = back_ns if verdict.code in _ABSENT else settled_ns
            self._causes[verdict.key] = verdict, t_ns + after_ns
        reported.sort(key=lambda one: (CODES.index(one.code), one.subject))
        return tuple(one.item() for one in reported[:MAX_CHECKS])

    def _verdicts(self, now: MasterNow, t_ns: int) -> Iterable[Verdict]:
        """All rules, those of the master's own files first."""
        for item in now.files:
            yield Verdict(item.code, item.subject, True, item.sentence, item.fix)
        yield from self._links.look(self._plan, now, self._reports, t_ns)
        for name, rules in self._slaves.items():
            if self._links.present(name) and (reports := self._reports.get(name)) is not None:
                yield from rules.look(name, reports, t_ns)
        for (cameras, markers), counts, rule in zip(self._plan.groups, now.groups, self._moved, strict=True):
            if all(self._links.present(name) for name in cameras):
                yield from rule.look(cameras, markers, counts, t_ns)
            else:
                rule.clear()

    def _follows(self, verdict: Verdict, shown: list[Verdict]) -> bool:
        """Whether something else that is wrong, or just was, explains it."""
        return any(
            verdict.code in _FOLLOWS.get(cause.code, ())
            and cause.touches(verdict)
            and cause.key != verdict.key
            for cause in (*shown, *(one for one, _ in self._causes.values()))
        )


class ChecklistPublisher:
    """Publisher of the checklist; belongs to one thread."""

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        received: Ingest,
        setups: Sequence[RigSetup],
        pipelines: Sequence[Pipeline],
        files: FileMonitor | None,
        session: int,
        writes_to: Path,
    ) -> None:
        """Begin, with the setups and pipelines of all hands in one order.

        Args:
            files: Of the rigs; None: nobody watches them.
            session: Random id of the master.
            writes_to: A folder on the disk that results go to.
        """
        self._bus, self._clock, self._received, self._files = bus, clock, received, files
        self._setups, self._pipelines = tuple(setups), tuple(pipelines)
        self._plan = plan_of(setups)
        self._monitor = ChecklistMonitor(self._plan)
        depth = 64  # reports of slaves that may wait for a look: 32 senders, twice a second
        self._reports = bus.subscribe("health", depth=depth)
        self._session, self._machine = session, Machine(writes_to)
        self._published: list[tuple[str, str]] | None = None
        self._published_ns = 0

    def work(self, stop: threading.Event, setups: Callable[[], Sequence[RigSetup]]) -> None:
        """Look again and again until the stop; `setups` returns which are in use."""
        poll_s = 0.2
        while not stop.wait(poll_s):
            try:
                self.look(setups())
            except BusError:
                if stop.is_set():
                    return  # the run has ended
                raise
            except Exception as error:  # noqa: BLE001
                # What a device reports may make a rule fail; the list goes on with the next report.
                self._received.quarantine.note(MASTER, error)

    def look(self, setups: Sequence[RigSetup]) -> None:
        """Look once at the setups in use, publish where due; BusError: bus closed."""
        t_ns = self._clock.now_ns()
        if tuple(setups) != self._setups:
            self._setups = tuple(setups)
            plan = plan_of(setups)
            if plan != self._plan:
                self._plan = plan
                self._monitor.follow(plan)
        while isinstance(health := self._reports.get(0.0), Health):
            self._monitor.push_health(health, t_ns)
        self._monitor.push(self._now(t_ns))
        items = self._monitor.look(t_ns)
        every_ns = 1_000_000_000  # and at once where it changes
        if keys_of(items) != self._published or t_ns - self._published_ns >= every_ns:
            self._published, self._published_ns = keys_of(items), t_ns
            self._bus.publish("checklist", MASTER, Checklist(MASTER, self._session, t_ns, items))

    def _now(self, t_ns: int) -> MasterNow:
        received, senders = self._received, dict[str, SenderNow]()
        connected, markers = received.connected, received.marker_counts()
        duplicates, versions, unproven = received.rejected_peers()
        for name in (*(camera.name for camera in self._plan.cameras), *self._plan.imus):
            counts, clock = received.counts_of(name), received.clock_of(name)
            senders[name] = SenderNow(
                name in connected,
                counts.received,
                counts.lost + counts.late,
                None if clock is None else clock.sigma_at(t_ns),
                duplicates.get(name),
                versions.get(name),
                unproven.get(name),
                markers.get(name),
            )
        groups = [
            line.counts
            for setup, line in zip(self._setups, self._pipelines, strict=True)
            if setup.has_markers
        ]
        found = () if self._files is None else self._files.look(self._plan)
        return MasterNow(received.started, senders, groups, self._machine.disk_free_mb(), found)
