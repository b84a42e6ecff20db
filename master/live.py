"""A live master: opens bus, ingest and sinks, runs the loop, reports once a second, writes the summary."""

import logging
import secrets
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from common.bus import Bus
from common.clock import Clock, SystemClock
from common.messages import Command, Health
from common.streams import MASTER
from common.zenoh_bus import ZenohBus
from master.app import RunFigures, health, run
from master.ingest import Ingest
from master.outputs.bus import BusSink
from master.outputs.files import PosesFile
from master.outputs.sink import Sink
from master.rig import RigSetup, build_pipeline
from master.stages import StageTimes
from master.summary import write_summary

_REPORT_S = 1.0

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """Addresses and files of a live run.

    Attributes:
        beacon: Broadcast address and port where slaves listen.
        bind: Own UDP address and port for data (0: any).
        bus: Endpoint on which the zenoh bus listens, for example tcp/127.0.0.1:47802.
        start_timeout_s: How long the first slave waits for the others.
        poses: Where to write poses.npz, or None.
        summary: Where to write the summary, or None.
    """

    beacon: tuple[str, int]
    bind: tuple[str, int]
    bus: str
    start_timeout_s: float = 5.0
    poses: Path | None = None
    summary: Path | None = None


def run_live(
    setup: RigSetup, key: bytes, settings: LiveSettings, stop: threading.Event, say: Callable[[str], None]
) -> dict[str, object]:
    """Track until `stop` is set.

    Args:
        setup: Rig, cameras, hand.
        key: Rig key.
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
    pipeline = build_pipeline(setup, stages)
    session = secrets.randbits(63)
    with ExitStack() as stack:
        bus = ZenohBus(settings.bus, None)
        stack.callback(bus.close)
        ingest = Ingest(
            setup.rig.cameras,
            key,
            clock,
            settings.beacon,
            settings.bind,
            settings.bus,
            settings.start_timeout_s,
        )
        stack.callback(ingest.close)
        sinks: list[Sink] = [BusSink(bus)]
        if settings.poses is not None:
            sinks.append(PosesFile(settings.poses, setup.hand.profile.name, len(setup.rig.markers)))
        for sink in sinks:
            stack.callback(sink.close)

        def report() -> Health:
            counts = dict(pipeline.counts) | {
                k: v for k, v in ingest.counts.items() if v or k.endswith("received")
            }
            return health(session, clock, figures, counts)

        def obey(command: Command) -> Health:
            if command.verb == "stop":
                stop.set()
            return report()

        bus.announce(MASTER)
        bus.serve(MASTER, obey)
        reporter = threading.Thread(
            target=_report,
            args=(bus, ingest, figures, report, setup.rig.cameras, stop, say),
            daemon=True,
        )
        reporter.start()
        say(f"listening on {ingest.address[0]}:{ingest.address[1]}, bus on {settings.bus}")
        run(ingest, pipeline, sinks, clock, figures, stop)
        stop.set()
        reporter.join(2.0)
        summary: dict[str, object] = {
            **figures.summary(),
            "lost": ingest.lost,
            "skipped": ingest.skipped,
            "counts": report().counts,
            "stage_us": stages.mean_us(),
        }
    if settings.summary is not None:
        write_summary(settings.summary, summary)
    return summary


def _report(
    bus: Bus,
    ingest: Ingest,
    figures: RunFigures,
    report: Callable[[], Health],
    cameras: tuple[str, ...],
    stop: threading.Event,
    say: Callable[[str], None],
) -> None:
    """Once a second: health on the bus and the rate; and a line whenever the set of cameras changes."""
    connected: frozenset[str] | None = None
    started = False
    poses = 0
    while not stop.wait(_REPORT_S):
        bus.publish("health", MASTER, report())
        if ingest.connected != connected:
            connected = ingest.connected
            say(cameras_line(cameras, connected))
        if ingest.started and not started:
            started = True
            say("started")
        if figures.poses and not poses:
            say("tracking")
        if started:
            say(f"rate {figures.poses - poses} poses/s")
        poses = figures.poses


def cameras_line(cameras: tuple[str, ...], connected: frozenset[str]) -> str:
    """What a person is told when a camera comes or goes: who is there, and who is waited for."""
    here = ", ".join(name for name in cameras if name in connected) or "none yet"
    absent = ", ".join(name for name in cameras if name not in connected)
    return f"cameras: {here}; waiting for {absent}" if absent else f"cameras: {here}"
