"""Live master opens bus, ingest and sinks, runs the loop and writes the summary.

Threads beside the loop report health and the checklist once a second.
"""

import gc
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from common.bus.zenoh_bus import ZenohBus
from common.clock import Clock, SystemClock
from common.link.datagram import LinkKey
from common.supervisor import ServiceManager, until
from master.checklist.files import FileMonitor
from master.checklist.publisher import ChecklistPublisher
from master.commands.summary import write_summary
from master.monitor.clocks import ClockMonitor
from master.monitor.report import ExtrinsicsMonitor, MonitoredLoop, Reporter, unplaced_line
from master.outputs.bus import BusSink, Sink, publishing_devices
from master.outputs.poses import RunFiles
from master.recording.probe import Probe, RecorderProcess, Tapped
from master.rig.setup import RigFiles, RigSetup
from master.run.app import RunFigures, StageTimes, observed, run
from master.run.dispatcher import Dispatcher, new_dispatcher
from master.run.ingest import Ingest
from master.run.link_senders import limits_of
from master.run.process import host_bus
from master.run.solver_supervisor import LoadShedding, Shedding, SolverSupervisor
from master.run.tuning import LivePipeline, RigTuning


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """Addresses and files of a live run.

    Attributes:
        beacon: Broadcast address and port where slaves listen.
        bind: Own UDP address and port for data (0: any).
        bus: Endpoint on which the zenoh bus listens, for example tls/0.0.0.0:47802.
        files: Where the setups were read: what changes there is used at once.
        start_timeout_s: How long the first slave waits for the others.
        poses: Where to write poses.npz, or None; those of a second hand stand beside it under its name, and
            objects, contact and gestures in its folder.
        record: Where to record all that is received and published (MCAP), or None.
    """

    beacon: tuple[str, int]
    bind: tuple[str, int]
    bus: str
    files: RigFiles
    start_timeout_s: float = 5.0
    poses: Path | None = None
    summary: Path | None = None
    record: Path | None = None


def run_live(
    setups: Sequence[RigSetup],
    key: LinkKey | bytes,
    settings: LiveSettings,
    stop: threading.Event,
    notify: Callable[[str], None],
) -> dict[str, object]:
    """Track until `stop` is set (signal, or command "stop"); return the summary.

    `key` is the rig key, alone or with the root of the secrets of devices; `notify` is called with one line
    when a state changes.

    Raises:
        BusError: An address cannot be bound.
        RecordingError: A file cannot be written.
    """
    clock: Clock = SystemClock()
    stages, figures = StageTimes(), RunFigures()
    load_shedding = LoadShedding(setups)
    pipelines = [LivePipeline(setup, stages, Shedding(load_shedding)) for setup in setups]
    dispatcher = Dispatcher(setups, pipelines, stages)
    tuning = RigTuning(settings.files, setups, pipelines, notify, dispatcher)
    with ExitStack() as stack:
        bus, probe = _open_bus(stack, setups, settings, clock, notify)
        ingest = ingest_of(setups, key, clock, settings)
        stack.callback(ingest.close)
        load_shedding.waiting = ingest.queue.frame_spans
        sinks = _open_sinks(stack, setups, settings, bus)
        monitor = ClockMonitor(setups)
        extrinsics = [ExtrinsicsMonitor(setup.rig.cameras) for setup in setups]
        reporter = Reporter(
            cameras_of(setups),
            trackers_of(setups),
            clock,
            bus,
            ingest,
            dispatcher,
            list(zip(extrinsics, pipelines, strict=True)),
            tuning,
            monitor,
            figures,
            probe,
            stop,
            notify,
        )
        writes_to = Path.cwd() if settings.poses is None else settings.poses.parent
        files = FileMonitor(settings.files.calibration, settings.files.rigs)
        checklist = ChecklistPublisher(
            bus, clock, ingest, setups, pipelines, files, reporter.session, writes_to
        )
        supervisor = SolverSupervisor(
            observed(dispatcher.push, figures.rates, monitor.push),
            ingest.quarantine,
            clock,
            tuning.renew,
            lambda sender: new_dispatcher([setup for setup in tuning.setups if sender in setup.senders]),
        )
        stack.callback(stop.set)  # before anything is closed that a thread uses
        threads = [
            _begun("master health", until(stop.is_set, reporter.work)),
            _begun(
                "master checklist", until(stop.is_set, lambda: checklist.work(stop, lambda: tuning.setups))
            ),
        ]
        for one in dispatcher.unplaced:
            notify(unplaced_line(one.name, one.tracker or ""))
        notify(f"listening on {ingest.address[0]}:{ingest.address[1]}, bus on {settings.bus}")
        gc.collect()
        gc.freeze()  # what lives until the end is never walked again: no pause in the loop
        source = Tapped(publishing_devices(ingest.queue.get, bus), probe, load_shedding)
        loop = MonitoredLoop(source.get, ServiceManager(os.environ))
        run(loop.get, supervisor.push, sinks, clock, figures, stop)
        source.flush()
        probe.drain()
        stop.set()
        for thread in threads:
            thread.join(2.0)  # a report that hangs on the bus does not keep the run from ending
        summary = _summary(figures, ingest, reporter, stages)
    if settings.summary is not None:
        write_summary(settings.summary, summary)
    return summary


def _open_bus(
    stack: ExitStack,
    setups: Sequence[RigSetup],
    settings: LiveSettings,
    clock: Clock,
    notify: Callable[[str], None],
) -> tuple[ZenohBus, Probe]:
    """Open the bus, the probe of what is taken, and a recorder if wanted."""
    bus = host_bus(settings.bus, devices_of(setups))
    stack.callback(bus.close)
    probe = Probe(bus, clock, always=settings.record is not None)
    stack.callback(probe.close)
    if settings.record is not None:
        recorder = RecorderProcess(settings.record, settings.files, settings.bus, notify, probe.end_always)
        stack.callback(recorder.close)
        recorder.wait_ready(bus)
    return bus, probe


def _open_sinks(
    stack: ExitStack, setups: Sequence[RigSetup], settings: LiveSettings, bus: ZenohBus
) -> list[Sink]:
    """Open all that takes poses: the bus, and files if wanted."""
    sinks: list[Sink] = [BusSink(bus)]
    if settings.poses is not None:
        sinks.append(RunFiles.of(settings.poses, setups))
    for sink in sinks:
        stack.callback(sink.close)
    return sinks


def _begun(name: str, work: Callable[[], None]) -> threading.Thread:
    """Start a thread that does not keep the process from ending."""
    thread = threading.Thread(target=work, name=name, daemon=True)
    thread.start()
    return thread


def _summary(
    figures: RunFigures, ingest: Ingest, reporter: Reporter, stages: StageTimes
) -> dict[str, object]:
    """The figures of a run that is over."""
    return {
        **figures.summary(),
        "camera_hz": figures.rates.camera_hz,
        "received_hz": figures.rates.received_hz,
        "lost": ingest.lost,
        "skipped": ingest.skipped,
        "counts": reporter.health().counts,
        "stage_us": stages.mean_us(),
    }


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
    """Return the receiver of all cameras, IMUs and trackers of these setups.

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
        limits=limits_of(setups),
    )
