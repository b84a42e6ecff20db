"""A short recording as a live master would have left it: messages pushed through a `World`, and what it told."""

from functools import cache
from pathlib import Path
from typing import NamedTuple

from common.messages import Contact, Gesture, HandPose, Health, MarkerDetections
from common.recording import MessageWriter
from master.recording.digest import ToldDigest
from master.recording.files import carried_files, rigs_text
from master.recording.player import world_of
from master.tuning import RigFiles
from tests.synthetic_run import synthetic_run

LATE_NS = 4_000_000
MOST_FRAMES = 24


class RecordedRun(NamedTuple):
    """The file, and the sums of what was told live."""

    path: Path
    live: ToldDigest


def report(t_ns: int, session: int = 5, reloads: int = 0) -> Health:
    return Health("master", session, t_ns, {"reload.applied": reloads}, {})


@cache
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
    world, live = world_of(setups), ToldDigest()
    messages = scene()[: 2 * frames]
    writer.write("health", report(messages[0].t_ns), messages[0].t_ns)
    for number, message in enumerate(messages):
        t_ns = message.t_ns + LATE_NS
        if number == restart_at:
            world = world_of(setups)
            writer.write("health", report(t_ns, 6), t_ns)
        writer.write("taken", message, t_ns)
        for solved in world.push(message):
            told = solved if isinstance(solved, Contact | Gesture) else solved.pose
            live.take(told)
            writer.write("hand" if isinstance(told, HandPose) else "gesture", told, t_ns)
    writer.close()
    return RecordedRun(path, live)
