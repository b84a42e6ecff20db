"""`phalanx record` runs the recorder and its bus subscriptions as a process.

The process is "recorder" on the bus, never in the way of the tracking. It waits for the master, goes on when
that was started again, answers `report` and `stop`, and ends its file whatever ends it. One thread subscribes
to each stream.
"""

import secrets
import sys
import threading
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from common.bus.bus import Bus, Subscription
from common.clock import now_ns
from common.command_line import echo
from common.errors import BusError
from common.machine import program
from common.messages import Command, Health, Message
from common.recording.messages import MessageWriter
from master.commands.options import rigs_of
from master.outputs.bus import PictureAsker
from master.recording.files import carried_files, rigs_text
from master.recording.lines import ProgressLine, progress_text
from master.recording.probe import came_ns
from master.recording.recorder import MessageRecorder, Progress, RawAsker, raw_text
from master.rig.setup import RigFiles
from master.run.process import bus_of_master, stop_on_signals

DEPTH = {"taken": 20_000, "preview": 32, "still": 32}  # messages that may wait for their thread
_ASK_S = 0.9
_ANSWERS = 5


class MasterClock:
    """Offset of the master's clock ahead of this machine's; 0 on the same machine."""

    def __init__(self) -> None:
        self.ahead_ns = 0
        self._half_trip_ns: int | None = None

    def push(self, asked_ns: int, answered_ns: int, remote_ns: int) -> None:
        """Take one answer, sent somewhere between the question and its arrival."""
        half_trip_ns = (answered_ns - asked_ns) // 2
        if self._half_trip_ns is None or half_trip_ns < self._half_trip_ns:
            ahead = remote_ns - (asked_ns + answered_ns) // 2
            # one clock looks so, and is exact then
            self.ahead_ns = 0 if abs(ahead) <= half_trip_ns else ahead
            self._half_trip_ns = half_trip_ns

    def now_ns(self) -> int:
        """The master's time [ns]."""
        return now_ns() + self.ahead_ns


class StreamSubscriber:
    """Subscriptions of one connection, each with a thread that feeds a recorder."""

    def __init__(
        self, bus: Bus, streams: Sequence[str], recorder: MessageRecorder, clock: MasterClock
    ) -> None:
        """Begin to listen on `bus`, which must stay open until `close`."""
        self._recorder, self._clock = recorder, clock
        self._closing = threading.Event()
        self._end_ns = self._last_ns = 0
        depth = 5_000
        self._inboxes = {stream: bus.subscribe(stream, depth=DEPTH.get(stream, depth)) for stream in streams}
        self.received = dict.fromkeys(streams, 0)
        self._threads = [
            threading.Thread(target=self._work, args=(stream, inbox), name=f"record {stream}", daemon=True)
            for stream, inbox in self._inboxes.items()
        ]
        for thread in self._threads:
            thread.start()

    @property
    def dropped(self) -> dict[str, int]:
        """Stream -> messages that no thread had time for."""
        return {stream: inbox.dropped for stream, inbox in self._inboxes.items() if inbox.dropped}

    def close(self, wait_s: float) -> None:
        """Take what waits for at most `wait_s`: the sender may go on. Safe to call twice."""
        self._end_ns = now_ns() + round(wait_s * 1e9)
        self._closing.set()
        for thread in self._threads:
            thread.join()
        for inbox in self._inboxes.values():
            inbox.close()

    def _work(self, stream: str, inbox: Subscription) -> None:
        while not self._closing.is_set() or now_ns() < self._end_ns:
            quiet_s = 0.3  # so long nothing has come when all that was sent is there
            message = inbox.get(quiet_s)
            if message is not None:
                self.received[stream] += 1
                now = self._clock.now_ns()
                self._recorder.offer(
                    stream, message, self._taken_ns(message, now) if stream == "taken" else now
                )
            elif self._closing.is_set():
                return

    def _taken_ns(self, message: Message, now_ns: int) -> int:
        """When a message was available, not before the last: a replay needs these times."""
        there = came_ns(message, now_ns)
        long_ns = 1_000_000_000
        if not 0 <= now_ns - there < long_ns:
            there = now_ns  # a master that plays publishes the times of then
        self._last_ns = max(self._last_ns, there)
        return self._last_ns


class ProbeLease:
    """Repeated request to the master to show what it takes; counts what never came."""

    def __init__(self, bus: Bus, subscriber: StreamSubscriber, clock: MasterClock) -> None:
        self._bus, self._subscriber, self._clock = bus, subscriber, clock
        self._session: int | None = None
        self._unseen = 0
        self._behind: deque[int] = deque(maxlen=_ANSWERS)
        self.lost = 0

    def ask(self) -> Health:
        """Probe for three seconds more; BusError: the master is not there, or refuses."""
        asked_ns = now_ns()
        health = self._bus.ask(Command("master", "tap"), _ASK_S)
        self._clock.push(asked_ns, now_ns(), health.t_ns)
        behind = health.counts.get("tap.shown", 0) - self._subscriber.received["taken"]
        if health.session != self._session:
            # What it showed before we listened was not for us.
            self._session, self._unseen = health.session, max(behind, 0) if self._session is None else 0
            self._behind.clear()
        self._behind.append(behind - self._unseen)
        if len(self._behind) == _ANSWERS:
            # What is on its way comes soon, what is lost stays away.
            self.lost = max(self.lost, min(self._behind))
        return health


NAME = "recorder"
KEPT = ("taken", "hand", "object", "contact", "gesture", "health", "checklist")
_PERIOD_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """What is recorded."""

    path: Path
    files: RigFiles  # files of calibration of the rigs
    seconds: float | None = None  # length [s]; None: until stopped
    frames_hz: float = 0.0  # whole frames of each camera a second; 0: none
    previews: bool = False  # keep the small pictures that somebody looks at, and ask for them
    reserve_bytes: int = 200_000_000  # stays free on the disk
    ready_as: str | None = None  # A name to be announced once it listens; None: nobody waits for that
    raw: bool = False  # have the slaves of all cameras keep raw frames beside it

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
        connect: Waits for the master's bus; None once stopped.
        stop: Set by a signal handler, or by the command "stop".
        notify: Called with a line when something changes.
        show: Called once a second with the progress and how many messages never came.

    Returns:
        The progress at the end.

    Raises:
        RecordingError: The file cannot be made, or the disk is full; what was written is readable.
        CalibrationError: The rig's files are broken.
        BusError: The master cannot be tapped.
    """
    run = _Run(settings, stop, notify, show)
    try:
        while not run.over and (bus := connect(stop)) is not None:
            with closing(bus):
                run.listen(bus)
    finally:
        run.recorder.close()
    if run.recorder.failure is not None:
        raise run.recorder.failure
    return run.recorder.progress()


class _Run:
    """One recording over all its connections, with what was lost on past ones."""

    def __init__(
        self,
        settings: RecordSettings,
        stop: threading.Event,
        notify: Callable[[str], None],
        show: Callable[[Progress, int], None],
    ) -> None:
        self._settings, self._stop, self._notify, self._show = settings, stop, notify, show
        setups, stem = settings.files.load(), settings.path.stem
        self._cameras = tuple(dict.fromkeys(name for setup in setups for name in setup.camera_names))
        self._clock = MasterClock()
        self._raw = RawAsker(stem, self._cameras if settings.raw else (), notify, self._keep_health)
        about = {"rigs": rigs_text(settings.files.rigs)}
        if settings.raw:
            about["raw"] = raw_text(stem, self._cameras)
        writer = MessageWriter(settings.path, carried_files(settings.files, setups), about)
        self.recorder = MessageRecorder(writer, settings.path.absolute().parent, settings.reserve_bytes)
        self._session = secrets.randbits(63)
        self._gone_lost = self._gone_dropped = 0
        self._lease: ProbeLease | None = None
        self._subscriber: StreamSubscriber | None = None
        self._master: int | None = None
        self._reloads = 0

    def _keep_health(self, health: Health) -> None:
        self.recorder.offer("health", health, self._clock.now_ns())

    @property
    def over(self) -> bool:
        """Whether nothing more is to be recorded."""
        seconds = self._settings.seconds
        full = seconds is not None and self.recorder.seconds >= seconds
        return self._stop.is_set() or self.recorder.failure is not None or full

    def listen(self, bus: Bus) -> None:
        """Record from one connection until it is over or the master gone or refuses."""
        with ExitStack() as stack:
            self._subscriber = StreamSubscriber(bus, self._settings.streams, self.recorder, self._clock)
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
        """Counts by stream, and `dropped` (no room), `lost` (never came); metrics."""
        now = self.recorder.progress()
        counts = now.counts | {"dropped": self._dropped(now), "lost": self._lost()}
        metrics = {
            "recorder.seconds": round(now.seconds, 3),
            "recorder.megabytes": round(now.written_bytes * 1e-6, 3),
            "recorder.megabytes_per_s": round(now.bytes_per_s * 1e-6, 3),
            "recorder.free_gb": round(now.free_bytes * 1e-9, 3),
        }
        return Health(NAME, self._session, self._clock.now_ns(), counts, metrics, *program())

    def answer(self, command: Command) -> Health:
        """Obey "report" or "stop"; ValueError: another verb."""
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
            self._show(self.recorder.progress(), self._lost())
        if missed:
            self._notify("the master is gone; waiting for it")

    def _look(self, health: Health) -> None:
        """Print what the player of this file must know; record restarts of the master."""
        if health.session != self._master:
            self._keep_health(health)
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
        self._gone_lost = self._lost()
        self._gone_dropped += sum(subscriber.dropped.values())
        self._lease = self._subscriber = None


def record(options: Namespace) -> None:
    """Record what a running master receives and publishes.

    In one MCAP file with the rig's calibration.
    """
    settings = RecordSettings(
        options.file,
        RigFiles(options.calibration, tuple(rigs_of(options)), options.hand),
        options.seconds,
        options.frames,
        options.previews,
        round(options.reserve_mb * 1e6),
        options.owned,
        options.raw,
    )
    stop = stop_on_signals()
    if options.owned is not None:
        threading.Thread(target=_stop_with_input, args=(stop,), daemon=True).start()
    line = ProgressLine(sys.stderr, "recorder")

    def show(now: Progress, lost: int) -> None:
        if options.owned is None:
            line.show(progress_text(now, lost, options.seconds))

    def waiting(_error: BusError) -> None:
        _recorder_status(f"waiting for a master at {options.bus}")

    end = run_recorder(
        settings, lambda stop: bus_of_master(options.bus, stop, waiting), stop, _recorder_status, show
    )
    dropped = sum(end.dropped.values())
    _recorder_status(
        f"recorded {end.seconds:.2f} s, {sum(end.counts.values())} messages, {dropped} dropped,"
        f" {end.written_bytes * 1e-6:.2f} MB in {options.file}"
    )


def _stop_with_input(stop: threading.Event) -> None:
    """Stop when whoever started us closes our input, or dies."""
    sys.stdin.read()
    stop.set()


def _recorder_status(line: str) -> None:
    echo(f"recorder: {line}")
