"""A short recording as a live master would have left it: messages pushed through a `Dispatcher`, and what it told."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from common.messages import Contact, Gesture, HandPose, Health, MarkerDetections
from common.recording.messages import MessageWriter
from master.recording.files import carried_files, rigs_text
from master.recording.player import ResultDigest, world_of
from master.recording.probe import Probe, Tapped, came_ns
from master.rig.setup import RigFiles
from master.run.ingest import MessageQueue
from master.run.link_senders import SensorMessage
from master.run.solver_supervisor import LoadShedding
from tests.memory_bus import LoopbackBus
from tests.network_helpers import ManualClock
from tests.synthetic_run import synthetic_run

LATE_NS = 4_000_000
MOST_FRAMES = 24


class RecordedRun(NamedTuple):
    """The file, and the sums of what was told live."""

    path: Path
    live: ResultDigest


def report(t_ns: int, session: int = 5, reloads: int = 0) -> Health:
    return Health("master", session, t_ns, {"reload.applied": reloads}, {})


def scene() -> tuple[MarkerDetections, ...]:
    """What two cameras see of the longest run; shorter ones are its beginning."""
    return tuple(synthetic_run(MOST_FRAMES).messages)


def recorded_run(
    path: Path, calibration: Path, frames: int = MOST_FRAMES, restart_at: int | None = None
) -> RecordedRun:
    """Of at most `MOST_FRAMES`; `restart_at`: the message before which the master is started again."""
    files = RigFiles(calibration, ("desk",))
    setups = files.load()
    writer = MessageWriter(path, carried_files(files, setups), {"rigs": rigs_text(files.rigs)})
    dispatcher, live = world_of(setups, LoadShedding()), ResultDigest()
    messages = scene()[: 2 * frames]
    writer.write("health", report(messages[0].t_ns), messages[0].t_ns)
    for number, message in enumerate(messages):
        t_ns = message.t_ns + LATE_NS
        if number == restart_at:
            dispatcher = world_of(setups, LoadShedding())
            writer.write("health", report(t_ns, 6), t_ns)
        writer.write("taken", message, t_ns)
        for solved in dispatcher.push(message):
            result = solved if isinstance(solved, Contact | Gesture) else solved.pose
            live.take(result)
            writer.write("hand" if isinstance(result, HandPose) else "gesture", result, t_ns)
    writer.close()
    return RecordedRun(path, live)


class Bursts:
    """What a master takes of messages that come in bursts of so many: a burst is in its queue when that is empty."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self.queue, self._sizes, self._come = MessageQueue(2), list(sizes), iter(scene())

    def get(self, timeout_s: float) -> SensorMessage | None:
        if not self.queue.frames and self._sizes:
            self.queue.put(list(islice(self._come, self._sizes.pop(0))))
        return self.queue.get(timeout_s)


def overloaded_run(path: Path, calibration: Path, bursts: Sequence[int]) -> tuple[RecordedRun, int]:
    """Of a master to which frames come in bursts of so many, as its tap shows it; and how many instants it shed."""
    files = RigFiles(calibration, ("desk",))
    setups = files.load()
    writer = MessageWriter(path, carried_files(files, setups), {"rigs": rigs_text(files.rigs)})
    bus, load_shedding, come, live = LoopbackBus(), LoadShedding(setups), Bursts(bursts), ResultDigest()
    load_shedding.waiting, dispatcher = come.queue.frame_spans, world_of(setups, load_shedding)
    shown = bus.subscribe("taken", depth=1000)
    probe = Probe(bus, ManualClock(), always=True)
    source = Tapped(come.get, probe, load_shedding)
    while (message := source.get(0.0)) is not None:
        for solved in dispatcher.push(message):
            live.take(solved if isinstance(solved, Contact | Gesture) else solved.pose)
    probe.drain()
    while (one := shown.get(0.01)) is not None:
        writer.write("taken", one, came_ns(one, 0))
    probe.close()
    writer.close()
    return RecordedRun(path, live), dispatcher.counts["instants_shed"]
