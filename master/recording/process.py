"""Recorder as a process of its own.

On the bus as "recorder", fed from it, never in the way of the tracking.

It waits for the master, goes on when that was started again, answers `report` and `stop`, and ends its file whatever
ends it.
"""

import secrets
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from common.bus.bus import Bus
from common.clock import now_ns
from common.errors import BusError
from common.machine import program
from common.messages import Command, Health
from common.recording.messages import MessageWriter
from master.outputs.previews import PictureAsker
from master.recording.files import carried_files, rigs_text
from master.recording.raw import RawAsker, raw_text
from master.recording.recorder import MessageRecorder, Progress
from master.recording.subscriber import MasterClock, ProbeLease, StreamSubscriber
from master.rig.files import RigFiles

NAME = "recorder"
KEPT = ("taken", "hand", "object", "contact", "gesture", "health", "checklist")
_PERIOD_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """What is recorded.

    Attributes:
        path: The file.
        files: Files of calibration of the rigs.
        seconds: Length [s]; None: until stopped.
        frames_hz: Whole frames of each camera a second; 0: none.
        previews: Keep the small pictures that somebody looks at, and ask for them.
        reserve_bytes: Stays free on the disk.
        ready_as: A name to be announced once it listens; None: nobody waits for that.
        raw: Have the slaves of all cameras keep raw frames beside it.
    """

    path: Path
    files: RigFiles
    seconds: float | None = None
    frames_hz: float = 0.0
    previews: bool = False
    reserve_bytes: int = 200_000_000
    ready_as: str | None = None
    raw: bool = False

    @property
    def streams(self) -> tuple[str, ...]:
        """The streams that are kept."""
        also = (("preview", self.previews), ("still", self.frames_hz > 0.0))
        return KEPT + tuple(stream for stream, wanted in also if wanted)


def run_recorder(
    settings: RecordSettings,
    connect: Callable[[threading.Event], Bus | None],
    stop: threading.Event,
    notify: Callable[[str], None],
    show: Callable[[Progress, int], None],
) -> Progress:
    """Record until stopped, until the length is reached, or until the disk is full.

    Args:
        settings: What.
        connect: Waits for the master's bus; None once stopped.
        stop: Set by a signal handler, or by the command "stop".
        say: Called with a line when something changes.
        show: Called once a second how it is, and how many messages never came.

    Returns:
        How it was at the end.

    Raises:
        RecordingError: The file cannot be made, or the disk is full; what was written is readable.
        CalibrationError: The rig's files are broken.
        BusError: The master cannot be tapped.
    """
    setups = settings.files.load()
    carried = carried_files(settings.files, setups)
    cameras = tuple(dict.fromkeys(name for setup in setups for name in setup.camera_names))
    clock = MasterClock()
    raw = RawAsker(
        settings.path.stem,
        cameras if settings.raw else (),
        notify,
        lambda health: recorder.offer("health", health, clock.now_ns()),
    )
    about = {"rigs": rigs_text(settings.files.rigs)}
    if settings.raw:
        about["raw"] = raw_text(settings.path.stem, cameras)
    writer = MessageWriter(settings.path, carried, about)
    recorder = MessageRecorder(writer, settings.path.absolute().parent, settings.reserve_bytes)
    run = _Run(settings, cameras, clock, recorder, raw, stop, notify, show)
    try:
        while not run.over and (bus := connect(stop)) is not None:
            try:
                run.listen(bus)
            finally:
                bus.close()
    finally:
        recorder.close()
    if recorder.failure is not None:
        raise recorder.failure
    return recorder.progress()


class _Run:
    """One recording over all its connections.

    Holds its id, and what was lost on connections that are gone.
    """

    def __init__(
        self,
        settings: RecordSettings,
        cameras: tuple[str, ...],
        clock: MasterClock,
        recorder: MessageRecorder,
        raw: RawAsker,
        stop: threading.Event,
        notify: Callable[[str], None],
        show: Callable[[Progress, int], None],
    ) -> None:
        self._settings, self._recorder, self._stop, self._notify, self._show = (
            settings,
            recorder,
            stop,
            notify,
            show,
        )
        self._cameras, self._raw = cameras, raw
        self._session = secrets.randbits(63)
        self._clock = clock
        self._gone_lost = self._gone_dropped = 0
        self._lease: ProbeLease | None = None
        self._subscriber: StreamSubscriber | None = None
        self._master: int | None = None
        self._reloads = 0

    @property
    def over(self) -> bool:
        """Whether nothing more is to be recorded."""
        seconds = self._settings.seconds
        full = seconds is not None and self._recorder.seconds >= seconds
        return self._stop.is_set() or self._recorder.failure is not None or full

    def listen(self, bus: Bus) -> None:
        """Record what comes by one connection, until it is over or the master is gone.

        Raises:
            BusError: The master refuses to be tapped.
        """
        with ExitStack() as stack:
            self._subscriber = StreamSubscriber(bus, self._settings.streams, self._recorder, self._clock)
            stack.callback(self._close_subscriber, self._subscriber)
            self._lease = ProbeLease(bus, self._subscriber, self._clock)
            bus.serve(NAME, self.answer)
            bus.announce(NAME)
            if self._settings.ready_as is not None:
                bus.announce(self._settings.ready_as)
            for wanted, verb, period_s in (
                (self._settings.previews, "preview", 2.0),
                (self._settings.frames_hz > 0.0, "still", 1.0 / max(self._settings.frames_hz, 1e-3)),
            ):
                if wanted:
                    # Nothing is reported of one that is away: the recording's table shows how much of it there is.
                    asker = PictureAsker(bus, self._cameras, verb, period_s, lambda _line: None)
                    stack.callback(asker.close)
            self._raw.attach(bus)
            stack.callback(lambda: self._raw.end(bus) if self.over else self._raw.detach())
            self._keep(bus, self._lease)

    def health(self) -> Health:
        """Return the recorder's health.

        Metrics recorder.seconds, .megabytes, .megabytes_per_s, .free_gb; messages by stream, `dropped` (no room in
        our queues) and `lost` (shown by the master, never came).
        """
        now = self._recorder.progress()
        counts = now.counts | {"dropped": self._dropped(now), "lost": self._lost()}
        metrics = {
            "recorder.seconds": round(now.seconds, 3),
            "recorder.megabytes": round(now.written_bytes * 1e-6, 3),
            "recorder.megabytes_per_s": round(now.bytes_per_s * 1e-6, 3),
            "recorder.free_gb": round(now.free_bytes * 1e-9, 3),
        }
        return Health(NAME, self._session, self._clock.now_ns(), counts, metrics, *program())

    def answer(self, command: Command) -> Health:
        """Obey "report" or "stop".

        Raises:
            ValueError: Another verb.
        """
        if command.verb not in ("report", "stop"):
            raise ValueError(f"{NAME}: no command {command.verb!r}; there are report, stop")
        if command.verb == "stop":
            self._stop.set()
        return self.health()

    def _keep(self, bus: Bus, lease: ProbeLease) -> None:
        missed, due_ns = 0, now_ns()
        tries = 3  # a master that does not answer so often is gone
        while not self.over and missed < tries:
            if now_ns() < due_ns:
                step_s = 0.1
                self._stop.wait(step_s)
                continue
            due_ns = max(due_ns + _PERIOD_NS, now_ns())
            try:
                health = lease.ask()
            except BusError as error:
                if "refused" in str(error):
                    raise
                missed += 1
                continue
            missed = 0
            self._look(health)
            bus.publish("health", NAME, self.health())
            self._show(self._recorder.progress(), self._lost())
        if missed:
            self._notify("the master is gone; waiting for it")

    def _look(self, health: Health) -> None:
        """Print notices for the later player, and record restarts of the master.

        Prints what the player of this file has to know, and keeps in the file where a master was started again.
        """
        if health.session != self._master:
            self._recorder.offer("health", health, self._clock.now_ns())
            if self._master is None:
                self._notify(f"recording into {self._settings.path}")
            else:
                self._notify("the master was started again; recording goes on")
            self._master, self._reloads = health.session, health.counts.get("reload.applied", 0)
        if health.counts.get("reload.applied", 0) != self._reloads:
            self._reloads = health.counts.get("reload.applied", 0)
            self._notify("files of the rig were changed: from here on a replay differs from the live output")

    def _lost(self) -> int:
        return self._gone_lost + (0 if self._lease is None else self._lease.lost)

    def _dropped(self, now: Progress) -> int:
        subscriber = {} if self._subscriber is None else self._subscriber.dropped
        return self._gone_dropped + sum(now.dropped.values()) + sum(subscriber.values())

    def _close_subscriber(self, subscriber: StreamSubscriber) -> None:
        drain_s, owned_drain_s = 0.5, 10.0
        # One that owns us has stopped, and all that it sent is to be kept; another one goes on without us.
        subscriber.close(drain_s if self._settings.ready_as is None else owned_drain_s)
        self._gone_lost, self._gone_dropped = (
            self._lost(),
            self._gone_dropped + sum(subscriber.dropped.values()),
        )
        self._lease = self._subscriber = None
