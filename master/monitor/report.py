"""Reporter publishes the status of a live master.

Its health on the bus, answers to requests there, and a line for each change. A camera whose rays miss those
of the others is reported. The loop itself, when it asks for the next message, shows the service manager that
it goes round, never a thread that would live on while it hangs: then the watchdog ends the process, and it is
started again.
"""

import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Generic

from common.bus.zenoh_bus import ZenohBus
from common.clock import Clock
from common.errors import BusError
from common.messages import Command, Health
from common.messages.streams import MASTER
from common.supervisor import ServiceManager
from master.monitor.clocks import ClockMonitor
from master.outputs.bus import Receive
from master.recording.probe import Probe
from master.run.app import AuxiliaryMessage, RunFigures, SeenT, health
from master.run.dispatcher import Dispatcher
from master.run.ingest import Ingest
from master.run.link_senders import MarkerCounts, limits_of
from master.run.tuning import LivePipeline, RigTuning


class ExtrinsicsMonitor:
    """Monitor of cameras whose rays are rejected; belongs to the thread that reports."""

    def __init__(self, cameras: tuple[str, ...]) -> None:
        """Watch the cameras of a rig."""
        self._rejected = dict.fromkeys(cameras, 0)
        self._looks = dict.fromkeys(cameras, 0)
        self._poses = 0

    def look(self, counts: Mapping[str, int]) -> list[str]:
        """Return a line, once, for each camera that most poses rejected for 5 looks."""
        lines: list[str] = []
        poses = counts.get("poses", 0) - self._poses
        self._poses += poses
        for name, before in self._rejected.items():
            # characters of a name in `Health`
            now = counts.get(f"mostly_rejected.{name}"[:64], 0)
            mostly = poses > 0 and now - before > 0.5 * poses
            self._rejected[name] = now
            self._looks[name] = self._looks[name] + 1 if mostly else 0
            looks = 5  # in a row, once a second: somebody who reaches before a camera is no knock
            if self._looks[name] == looks:
                lines.append(
                    f"camera {name}: its rays miss those of the others and are left out: it was knocked, or it is not"
                    " the camera of its file: calibrate it anew, `phalanx calibrate cameras stereo --help`"
                )
        return lines


class Reporter:
    """Status reporter of the master."""

    def __init__(
        self,
        cameras: tuple[str, ...],
        trackers: tuple[str, ...],
        clock: Clock,
        bus: ZenohBus,
        ingest: Ingest,
        dispatcher: Dispatcher,
        extrinsics: Sequence[tuple[ExtrinsicsMonitor, LivePipeline]],
        tuning: RigTuning,
        monitor: ClockMonitor,
        figures: RunFigures,
        probe: Probe,
        stop: threading.Event,
        notify: Callable[[str], None],
    ) -> None:
        """Announce the master on the bus; `work` belongs to a thread."""
        self.session = secrets.randbits(63)
        self._cameras, self._trackers, self._clock, self._bus = cameras, trackers, clock, bus
        self._ingest, self._dispatcher, self._figures = ingest, dispatcher, figures
        self._tuning, self._monitor, self._extrinsics = tuning, monitor, extrinsics
        self._probe, self._stop, self._notify = probe, stop, notify
        self._mismatched: frozenset[str] = frozenset()
        bus.announce(MASTER)
        bus.serve(MASTER, self.answer)

    def health(self) -> Health:
        """Return the health; of what never happened only `received`, to keep it short."""
        events = self._ingest.counts | self._bus.counts
        happened = {name: number for name, number in events.items() if number or name.endswith("received")}
        counts = dict(self._dispatcher.counts) | happened | self._tuning.counts() | self._probe.counts
        times = dict(self._monitor.metrics(self._ingest.clock_of)) | (
            {"open_bus": 1.0} if self._bus.open else {}
        )
        return health(self.session, self._clock, self._figures, counts, times)

    def answer(self, command: Command) -> Health:
        """Execute a command and return the health.

        "report" returns the status, "reload" uses the files as they are now, "filter" sets another 1 € filter
        for one rig, "tap" shows what is taken on the bus for three seconds, "stop" ends the master.

        Raises:
            CalibrationError: The files cannot be used; the old ones still are.
            ValueError: Another verb; the asker reads which ones there are.
        """
        verbs = {
            "report": lambda: None,
            "stop": self._stop.set,
            "tap": self._probe.lease,
            "reload": self._tuning.reload,
            "filter": lambda: self._tuning.try_filter(command.body),
        }
        if command.verb not in verbs:
            raise ValueError(f"{MASTER}: no command {command.verb!r}; there are {', '.join(verbs)}")
        verbs[command.verb]()
        return self.health()

    def work(self) -> None:
        """Publish the health and print rate and changes once a second until the stop."""
        connected: frozenset[str] | None = None
        started = False
        poses = 0
        report_s = 1.0
        while not self._stop.wait(report_s):
            lines = self._looked()
            try:
                self._bus.publish("health", MASTER, self.health())
            except BusError:
                if self._stop.is_set():
                    return  # the run has ended
                raise
            received = self._ingest.connected
            if received != connected:
                connected = received
                self._notify(cameras_line(self._cameras, connected, self._trackers))
            if self._ingest.started and not started:
                started = True
                self._notify("started")
            if self._figures.poses and not poses:
                self._notify("tracking")
            if started:
                self._notify(f"rate {self._figures.poses - poses} poses/s")
            for line in lines:
                self._notify(line)
            poses = self._figures.poses

    def _looked(self) -> list[str]:
        """Lines of the monitors; what senders send may fail one, but not the report."""
        try:
            self._tuning.look()
            self._monitor.follow(self._tuning.setups)
            self._ingest.limit(limits_of(self._tuning.setups))
            lines = self._monitor.look()
            lines += [
                line for extrinsics, pipeline in self._extrinsics for line in extrinsics.look(pipeline.counts)
            ]
        except Exception as error:  # noqa: BLE001
            self._ingest.quarantine.note(MASTER, error)
            lines = []
        mismatched = self._ingest.marker_counts()
        lines += [
            marker_line(name, counts) for name, counts in mismatched.items() if name not in self._mismatched
        ]
        self._mismatched = frozenset(mismatched)
        return lines


def marker_line(name: str, counts: MarkerCounts) -> str:
    """Return the line about a slave whose rig file differs from the master's."""
    return (
        f"camera {name}: its slave sends {counts.sent} markers, the rig here has {counts.expected}: nothing of it is"
        " used. Deploy the rig to it again (phalanx fleet deploy), then restart this master if its own file has changed"
    )


def cameras_line(cameras: tuple[str, ...], connected: frozenset[str], trackers: tuple[str, ...] = ()) -> str:
    """Return the line on who is there, and which cameras are waited for."""
    here = ", ".join(name for name in cameras if name in connected) or "none yet"
    absent = ", ".join(name for name in cameras if name not in connected)
    line = f"cameras: {here}; waiting for {absent}" if absent else f"cameras: {here}"
    others = connected.difference(cameras)
    for kind, names in (("IMU", others.difference(trackers)), ("tracker", others.intersection(trackers))):
        line += f"; {kind}: {', '.join(sorted(names))}" if names else ""
    return line


def unplaced_line(name: str, tracker: str) -> str:
    """Return the line about a tracker that is not registered to the rig."""
    return (
        f"object {name}: its tracker {tracker} is not registered to the rig, its poses are not used:"
        f" `phalanx calibrate tracker {name}`"
    )


class MonitoredLoop(Generic[SeenT]):
    """A source of messages that shows the manager each time it is asked."""

    def __init__(
        self,
        receive: Receive[SeenT | AuxiliaryMessage],
        manager: ServiceManager,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Report that the loop is ready: it begins now."""
        self._receive, self._manager, self._now_ns = receive, manager, now_ns
        notifies = 4  # in a period of the watchdog
        self._every_ns = manager.watchdog_us * 1000 // notifies
        self._due_ns = now_ns() + self._every_ns
        manager.send("READY=1\nSTATUS=tracks", wait=True)

    def get(self, timeout_s: float) -> SeenT | AuxiliaryMessage | None:
        """The next message, or None when none came in time."""
        if self._every_ns and (now_ns := self._now_ns()) >= self._due_ns:
            self._manager.send("WATCHDOG=1")
            self._due_ns = now_ns + self._every_ns
        return self._receive(timeout_s)
