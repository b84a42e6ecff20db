"""Publisher of the checklist of a running master.

Feeds it and publishes it five times a second, on a thread of its own, since the one that reports stands still while
changed files are read.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from common.bus.bus import Bus
from common.clock import Clock
from common.errors import BusError
from common.link.clock_offset import ClockEstimate
from common.machine import Machine
from common.messages import CheckItem, Checklist, Health
from common.messages.streams import MASTER
from master.checklist.facts import MasterNow, SenderNow, plan_of
from master.checklist.files import FileMonitor
from master.checklist.monitor import ChecklistMonitor
from master.rig.setup import RigSetup
from master.run.quarantine import Quarantine
from master.run.rejected_peers import MarkerCounts, RejectedPeer
from master.run.sequence import CameraCounts


class Received(Protocol):
    """Interface to what the master receives; an `Ingest`."""

    @property
    def quarantine(self) -> Quarantine:
        """Where faults are counted and logged."""
        ...

    @property
    def started(self) -> bool:
        """Whether the start was given."""
        ...

    @property
    def connected(self) -> frozenset[str]:
        """Return the senders received within the last second."""
        ...

    def counts_of(self, sender: str) -> CameraCounts:
        """What became of its messages."""
        ...

    def clock_of(self, camera: str) -> ClockEstimate | None:
        """How its clock runs."""
        ...

    def rejected_peers(
        self,
    ) -> tuple[Mapping[str, RejectedPeer], Mapping[str, RejectedPeer], Mapping[str, RejectedPeer]]:
        """Return the rejected processes of each sender, by reason.

        Sender -> where a second process of its name was rejected lately; where it speaks another version; where
        somebody sends a hello without its secret.
        """
        ...

    def marker_counts(self) -> Mapping[str, MarkerCounts]:
        """Camera -> how many markers its slave sent lately and its rig has here.

        Of those cameras alone where the two differ.
        """
        ...


class Counting(Protocol):
    """The pipeline of one hand; a `LivePipeline`."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Events since the start."""
        ...


class ChecklistPublisher:
    """Publisher of the checklist; belongs to one thread.

    Holds the monitor, its subscription, and what was published last.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        received: Received,
        setups: Sequence[RigSetup],
        pipelines: Sequence[Counting],
        files: FileMonitor | None,
        session: int,
        writes_to: Path,
    ) -> None:
        """Begin.

        Args:
            bus: Where slaves report and the list is published.
            clock: The master's.
            received: What is received of the senders.
            setups: Of each hand, as they are in use.
            pipelines: Of each setup.
            files: Of the rigs; None: nobody watches them.
            session: Random id of the master.
            writes_to: A folder on the disk that results go to.

        Raises:
            BusError: The bus is closed.
        """
        self._bus, self._clock, self._received, self._files = bus, clock, received, files
        self._setups, self._pipelines = tuple(setups), tuple(pipelines)
        self._plan = plan_of(setups)
        self._monitor = ChecklistMonitor(self._plan)
        depth = 64  # reports of slaves that may wait for a look: 32 senders, twice a second
        self._reports = bus.subscribe("health", depth=depth)
        self._session, self._machine = session, Machine(writes_to)
        self._published: tuple[CheckItem, ...] | None = None
        self._published_ns = 0

    def work(self, stop: threading.Event, setups: Callable[[], Sequence[RigSetup]] | None) -> None:
        """Look again and again until the stop.

        `setups` returns which are in use.
        """
        poll_s = 0.2
        while not stop.wait(poll_s):
            try:
                self.look(None if setups is None else setups())
            except BusError:
                if stop.is_set():
                    return  # the run has ended
                raise
            except Exception as error:  # noqa: BLE001
                # What a device reports may make a rule fail; the list goes on with the next report.
                self._received.quarantine.note(MASTER, error)

    def look(self, setups: Sequence[RigSetup] | None = None) -> tuple[CheckItem, ...]:
        """Look once, and publish where it is due.

        `setups` that are in use now, None: as before.

        Raises:
            BusError: The bus is closed.
        """
        t_ns = self._clock.now_ns()
        if setups is not None and tuple(setups) != self._setups:
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
        if _keys(items) != _keys(self._published) or t_ns - self._published_ns >= every_ns:
            self._published, self._published_ns = items, t_ns
            self._bus.publish("checklist", MASTER, Checklist(MASTER, self._session, t_ns, items))
        return items

    def _now(self, t_ns: int) -> MasterNow:
        connected = self._received.connected
        rejected_peers, markers = self._received.rejected_peers(), self._received.marker_counts()
        names = (*(camera.name for camera in self._plan.cameras), *self._plan.imus)
        senders: dict[str, SenderNow] = {}
        for name in names:
            counts, clock = self._received.counts_of(name), self._received.clock_of(name)
            sigma_ns = None if clock is None else clock.sigma_at(t_ns)
            missed = counts.lost + counts.late
            duplicate, unknown_peer, unproven = (of.get(name) for of in rejected_peers)
            links = name in connected, counts.received, missed, sigma_ns, duplicate, unknown_peer, unproven
            senders[name] = SenderNow(*links, markers.get(name))
        groups = [
            line.counts
            for setup, line in zip(self._setups, self._pipelines, strict=True)
            if setup.has_markers
        ]
        found = () if self._files is None else self._files.look(self._plan)
        return MasterNow(self._received.started, senders, groups, self._machine.disk_free_mb(), found)


def _keys(items: tuple[CheckItem, ...] | None) -> list[tuple[str, str]] | None:
    """Return code and subject of each published item, without its sentence.

    The numbers in the sentences change all the time.
    """
    return None if items is None else [(item.code, item.subject) for item in items]
