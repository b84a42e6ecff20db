"""A live master: opens bus, ingest and sinks, runs the loop, reports once a second, writes the summary."""

import gc
import secrets
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from common.clock import Clock, SystemClock
from common.link_key import LinkKey
from common.messages import Command, Health
from common.streams import MASTER
from common.zenoh_bus import ZenohBus
from master.app import RunFigures, health, run
from master.checklist.feed import ChecklistFeed
from master.checklist.files import FileWatch
from master.hurry import Hurry, Shedding
from master.ingest import Ingest
from master.master_bus import carry_bus
from master.odd_watch import OddWatch
from master.outputs.bus import BusSink
from master.outputs.devices import DevicePoses
from master.outputs.files import RunFiles
from master.outputs.sink import Sink
from master.recording.child import RecorderProcess
from master.recording.tap import Tap, Tapped
from master.rig import RigSetup
from master.stages import StageTimes
from master.summary import write_summary
from master.time_watch import TimeWatch
from master.tuning import LivePipeline, RigFiles, RigTuning
from master.world import World

_REPORT_S = 1.0
_JOIN_S = 2.0  # a report that hangs on the bus does not keep the run from ending


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """Addresses and files of a live run.

    Attributes:
        beacon: Broadcast address and port where slaves listen.
        bind: Own UDP address and port for data (0: any).
        bus: Endpoint on which the zenoh bus listens, for example tls/0.0.0.0:47802.
        start_timeout_s: How long the first slave waits for the others.
        poses: Where to write poses.npz, or None; those of a second hand stand beside it under its name, and objects,
            contact and gestures in its folder.
        summary: Where to write the summary, or None.
        files: Where the setups were read: what changes there is used at once. None: they stay as they are.
        record: Where to record all that is taken and told (MCAP), or None; needs `files`.
    """

    beacon: tuple[str, int]
    bind: tuple[str, int]
    bus: str
    start_timeout_s: float = 5.0
    poses: Path | None = None
    summary: Path | None = None
    files: RigFiles | None = None
    record: Path | None = None

    def __post_init__(self) -> None:
        """Refuse a recording without the files that it carries."""
        if self.record is not None and self.files is None:
            raise ValueError("record: a recording carries the files of its rigs: give files, too")


def run_live(
    setups: Sequence[RigSetup],
    key: LinkKey | bytes,
    settings: LiveSettings,
    stop: threading.Event,
    say: Callable[[str], None],
) -> dict[str, object]:
    """Track until `stop` is set.

    Args:
        setups: Of each hand its rigs, cameras and model.
        key: Rig key, alone or with the root of the secrets of devices.
        settings: Addresses and files.
        stop: Set by a signal handler, or by the command "stop" on the bus.
        say: Told one line when a state changes.

    Returns:
        The summary.

    Raises:
        BusError: An address cannot be bound.
        RecordingError: A file cannot be written.
    """
    clock: Clock = SystemClock()
    stages, figures = StageTimes(), RunFigures()
    rates_hz = [camera.frame_rate_hz for setup in setups for camera in setup.cameras.values()]
    hurry = Hurry(len(cameras_of(setups)), max(rates_hz))
    pipelines = [LivePipeline(setup, stages, Shedding(hurry)) for setup in setups]
    world = World(setups, pipelines, stages)
    tuning = None if settings.files is None else RigTuning(settings.files, setups, pipelines, say, world)
    with ExitStack() as stack:
        bus = carry_bus(settings.bus, devices_of(setups))
        stack.callback(bus.close)
        tap = Tap(bus, clock, always=settings.record is not None)
        stack.callback(tap.close)
        if settings.record is not None and settings.files is not None:
            recorder = RecorderProcess(settings.record, settings.files, settings.bus, say, tap.end_always)
            stack.callback(recorder.close)
            recorder.wait_ready(bus)
        ingest = ingest_of(setups, key, clock, settings)
        stack.callback(ingest.close)
        hurry.waiting = lambda: ingest.waiting
        sinks: list[Sink] = [BusSink(bus)]
        if settings.poses is not None:
            counts = {setup.hand.profile.name: len(setup.markers) for setup in setups}
            objects = [one.name for setup in setups for one in setup.objects]
            sinks.append(RunFiles(settings.poses, counts, objects))
        for sink in sinks:
            stack.callback(sink.close)
        watch = TimeWatch(setups)
        odd = [OddWatch(setup.rig.cameras) for setup in setups]
        watched = list(zip(odd, pipelines, strict=True))
        reporter = _Reporter(
            cameras_of(setups),
            trackers_of(setups),
            clock,
            bus,
            ingest,
            world,
            watched,
            tuning,
            watch,
            figures,
            tap,
            stop,
            say,
        )
        watched_files = (
            None if settings.files is None else FileWatch(settings.files.calibration, settings.files.rigs)
        )
        writes_to = Path.cwd() if settings.poses is None else settings.poses.parent
        checklist = ChecklistFeed(
            bus, clock, ingest, setups, pipelines, watched_files, reporter.session, writes_to
        )
        thread = threading.Thread(target=reporter.work, name="master health", daemon=True)
        thread.start()
        in_use = None if tuning is None else lambda: tuning.setups
        checking = threading.Thread(
            target=checklist.work, args=(stop, in_use), name="master checklist", daemon=True
        )
        checking.start()
        for one in world.unplaced:
            say(unplaced_line(one.name, one.tracker or ""))
        say(f"listening on {ingest.address[0]}:{ingest.address[1]}, bus on {settings.bus}")
        gc.collect()
        gc.freeze()  # what lives until the end is never walked again: no pause in the loop
        source = Tapped(DevicePoses(ingest, bus), tap, hurry)
        run(source, world, sinks, clock, figures, stop, watch.push)
        source.flush()
        tap.drain()
        stop.set()
        thread.join(_JOIN_S)
        checking.join(_JOIN_S)
        summary: dict[str, object] = {
            **figures.summary(),
            "camera_hz": figures.rates.camera_hz,
            "received_hz": figures.rates.received_hz,
            "lost": ingest.lost,
            "skipped": ingest.skipped,
            "counts": reporter.health().counts,
            "stage_us": stages.mean_us(),
        }
    if settings.summary is not None:
        write_summary(settings.summary, summary)
    return summary


def cameras_of(setups: Sequence[RigSetup]) -> tuple[str, ...]:
    """All cameras, each once: some watch two hands."""
    return tuple(dict.fromkeys(name for setup in setups for name in setup.camera_names))


def trackers_of(setups: Sequence[RigSetup]) -> tuple[str, ...]:
    """All trackers that sit on objects."""
    return tuple(name for setup in setups for name in setup.trackers)


def devices_of(setups: Sequence[RigSetup]) -> tuple[str, ...]:
    """All that may connect: cameras, IMUs and trackers."""
    imus = tuple(name for setup in setups for name in setup.imus)
    return tuple(dict.fromkeys((*cameras_of(setups), *imus, *trackers_of(setups))))


def ingest_of(
    setups: Sequence[RigSetup], key: LinkKey | bytes, clock: Clock, settings: LiveSettings
) -> Ingest:
    """Where all cameras, IMUs and trackers of these hands and objects are heard.

    Raises:
        BusError: The address cannot be bound, or the beacon's is no IPv4 address.
    """
    return Ingest(
        cameras_of(setups),
        key,
        clock,
        settings.beacon,
        settings.bind,
        settings.bus,
        settings.start_timeout_s,
        imus=tuple(name for setup in setups for name in setup.imus),
        wrists=tuple(name for setup in setups for name in setup.wrist_cameras),
        trackers=trackers_of(setups),
    )


class _Reporter:
    """Tells how the master is: on the bus, to whoever asks there, and a line for each change.

    Holds the id of this run, and what it reports on.
    """

    def __init__(
        self,
        cameras: tuple[str, ...],
        trackers: tuple[str, ...],
        clock: Clock,
        bus: ZenohBus,
        ingest: Ingest,
        world: World,
        odd: Sequence[tuple[OddWatch, LivePipeline]],
        tuning: RigTuning | None,
        watch: TimeWatch,
        figures: RunFigures,
        tap: Tap,
        stop: threading.Event,
        say: Callable[[str], None],
    ) -> None:
        """Be there on the bus from now on; `work` belongs to a thread."""
        self.session = secrets.randbits(63)
        self._cameras, self._trackers, self._clock, self._bus = cameras, trackers, clock, bus
        self._ingest, self._world, self._figures = ingest, world, figures
        self._tuning, self._watch, self._odd = tuning, watch, odd
        self._tap, self._stop, self._say = tap, stop, say
        bus.announce(MASTER)
        bus.serve(MASTER, self.answer)

    def health(self) -> Health:
        """The report of this moment; of what never happened only `received` is told, to keep it short."""
        events = self._ingest.counts.items()
        told = {name: number for name, number in events if number or name.endswith("received")}
        changes = {} if self._tuning is None else self._tuning.counts()
        counts = dict(self._world.counts) | told | changes | self._tap.counts
        times = dict(self._watch.gauges(self._ingest.clock_of)) | (
            {"open_bus": 1.0} if self._bus.open else {}
        )
        return health(self.session, self._clock, self._figures, counts, times)

    def answer(self, command: Command) -> Health:
        """Obey a command: "report" says how it is, "reload" uses the files as they are now, "filter"
        another 1 € filter for one rig, "tap" shows what is taken on the bus for three seconds, "stop" ends the master.

        Raises:
            CalibrationError: The files cannot be used; the old ones still are.
            ValueError: Another verb; the asker reads which ones there are.
        """
        verbs = {"report": lambda: None, "stop": self._stop.set, "tap": self._tap.lease}
        if self._tuning is not None:
            tuning = self._tuning
            verbs |= {"reload": tuning.reload, "filter": lambda: tuning.try_filter(command.body)}
        if command.verb not in verbs:
            raise ValueError(f"{MASTER}: no command {command.verb!r}; there are {', '.join(verbs)}")
        verbs[command.verb]()
        return self.health()

    def work(self) -> None:
        """Once a second until the stop: health on the bus and the rate; and a line whenever something changes."""
        connected: frozenset[str] | None = None
        started = False
        poses = 0
        while not self._stop.wait(_REPORT_S):
            if self._tuning is not None:
                self._tuning.look()
                self._watch.follow(self._tuning.setups)
            lines = self._watch.look()
            lines += [line for odd, pipeline in self._odd for line in odd.look(pipeline.counts)]
            self._bus.publish("health", MASTER, self.health())
            heard = self._ingest.connected
            if heard != connected:
                connected = heard
                self._say(cameras_line(self._cameras, connected, self._trackers))
            if self._ingest.started and not started:
                started = True
                self._say("started")
            if self._figures.poses and not poses:
                self._say("tracking")
            if started:
                self._say(f"rate {self._figures.poses - poses} poses/s")
            for line in lines:
                self._say(line)
            poses = self._figures.poses


def cameras_line(cameras: tuple[str, ...], connected: frozenset[str], trackers: tuple[str, ...] = ()) -> str:
    """What a person is told when a sender comes or goes: who is there, and which cameras are waited for."""
    here = ", ".join(name for name in cameras if name in connected) or "none yet"
    absent = ", ".join(name for name in cameras if name not in connected)
    line = f"cameras: {here}; waiting for {absent}" if absent else f"cameras: {here}"
    others = connected.difference(cameras)
    for kind, names in (("IMU", others.difference(trackers)), ("tracker", others.intersection(trackers))):
        line += f"; {kind}: {', '.join(sorted(names))}" if names else ""
    return line


def unplaced_line(name: str, tracker: str) -> str:
    """What a person is told of a tracker whose poses mean nothing in the rig."""
    return (
        f"object {name}: its tracker {tracker} is not registered to the rig, what it says is not used:"
        f" `phalanx-master calibrate tracker {name}`"
    )
