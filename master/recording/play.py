"""`phalanx play` runs the player as a process of its own.

On the bus it acts as the master whose messages it plays, with commands of its own: whatever listens to a live
master (viewer, console, outputs) sees the recording as if it were live, with the times of then.
"""

import secrets
import sys
import threading
from argparse import Namespace
from collections.abc import Callable
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import msgspec

from common.bus.bus import Bus
from common.clock import SystemClock, now_ns
from common.command_line import echo
from common.errors import PhalanxError, RecordingError
from common.machine import program
from common.messages import WIRE_VERSION, Command, Health
from common.messages.streams import MASTER
from common.recording.messages import MessageRecording, open_messages
from master.outputs.bus import BusSink, Sink
from master.outputs.poses import RunFiles
from master.recording.files import recorded_setups
from master.recording.lines import ProgressLine, bar
from master.recording.player import Passed, Player
from master.recording.probe import Probe
from master.run.process import host_bus, stop_on_signals


@dataclass(frozen=True, slots=True)
class PlaySettings:
    """What is played, and how."""

    path: Path
    speed: float = 1.0  # 1: as it was; 0: as fast as it goes
    from_s: float | None = None  # after the beginning of the recording [s]; None: all
    to_s: float | None = None
    out: Path | None = None  # folder for poses.npz and what else there is, or None
    loop: bool = False  # begin again at the end
    solved: bool = False  # publish what was published live instead of solving


def run_play(
    settings: PlaySettings,
    bus: Bus | None,
    stop: threading.Event,
    notify: Callable[[str], None],
    show: Callable[[float, float], None] = lambda _position_s, _length_s: None,
) -> Passed:
    """Play until the end, or until stopped; return the last pass.

    Args:
        bus: Where it is published; None: nowhere. Left open.
        stop: Set by a signal handler, or by the command "stop".
        notify: Called with a line when something happens.
        show: Called once a second where it is [s], of how much.

    Raises:
        RecordingError: The file cannot be read, or carries no files of calibration, or a result cannot be written.
        CalibrationError: Its files are broken.
        PhalanxError: The stretch or speed is none.
    """
    recording = open_messages(settings.path)
    _check(recording, settings, notify)
    setups = recorded_setups(recording)
    with ExitStack() as stack:
        sinks: list[Sink] = [] if bus is None else [BusSink(bus)]
        if settings.out is not None:
            settings.out.mkdir(parents=True, exist_ok=True)
            sinks.append(RunFiles.of(settings.out / "poses.npz", setups))
            stack.callback(sinks[-1].close)
        probe = None if bus is None else stack.enter_context(closing(Probe(bus, SystemClock())))

        def at(seconds: float | None) -> int | None:
            return None if seconds is None else recording.begin_t_ns + round(seconds * 1e9)

        try:
            player = Player(
                recording,
                setups,
                sinks,
                speed=settings.speed,
                from_ns=at(settings.from_s),
                to_ns=at(settings.to_s),
                solved=settings.solved,
                bus=bus,
                probe=probe,
                notify=notify,
            )
        except ValueError as error:
            raise PhalanxError(f"{settings.path}: {error}") from error
        host = stack.enter_context(closing(_Host(player, recording, bus, probe, stop, show)))
        passed = player.run()
        while settings.loop and not stop.is_set():
            notify("again from the beginning")
            passed = player.run()
        show(host.position_s, host.length_s)
        return passed


def _check(recording: MessageRecording, settings: PlaySettings, notify: Callable[[str], None]) -> None:
    """Refuse what cannot be played, and print what has to be known of the rest."""
    if settings.loop and settings.out is not None:
        raise PhalanxError("--loop and --out: the files of a run have an end; leave out one of them")
    wanted = "hand" if settings.solved else "taken"
    if not recording.counts.get(wanted):
        raise RecordingError(f"{recording.path}: nothing to play: it has no messages of stream {wanted!r}")
    if recording.cut:
        notify("the recording was not ended: it is played up to the cut")
    if recording.broken:
        notify(f"{recording.broken} chunks or files of the recording are broken and left out")
    if recording.about.get("wire") != str(WIRE_VERSION):
        notify(
            f"recorded with wire version {recording.about.get('wire', '?')}, this program speaks {WIRE_VERSION}:"
            " messages that it does not know are left out"
        )


class _Host:
    """Command responder and health reporter of the player."""

    def __init__(
        self,
        player: Player,
        recording: MessageRecording,
        bus: Bus | None,
        probe: Probe | None,
        stop: threading.Event,
        show: Callable[[float, float], None],
    ) -> None:
        self._player, self._bus, self._probe, self._stop, self._show = player, bus, probe, stop, show
        self._begin_ns = recording.begin_t_ns
        self.length_s = (recording.end_t_ns - recording.begin_t_ns) * 1e-9
        self._session = secrets.randbits(63)
        self._rate = 0.0
        self._closing = threading.Event()
        if bus is not None:
            bus.announce(MASTER)
            bus.serve(MASTER, self.answer)
        self._threads = [
            threading.Thread(target=work, name=f"play {work.__name__}", daemon=True)
            for work in (self._report, self._watch_stop)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def position_s(self) -> float:
        """Where it is, from the beginning of the recording [s]."""
        return (self._player.at_ns - self._begin_ns) * 1e-9

    def health(self) -> Health:
        """The player's health in the form of the master's, with play.* metrics."""
        metrics = {
            "play.position_s": round(self.position_s, 3),
            "play.length_s": round(self.length_s, 3),
            "play.speed": self._player.speed,
            "play.paused": float(self._player.paused),
            "poses_per_s": round(self._rate, 2),
        }
        counts = {"poses": self._player.poses} | ({} if self._probe is None else self._probe.counts)
        return Health(MASTER, self._session, now_ns(), counts, metrics, *program())

    def answer(self, command: Command) -> Health:
        """Obey a command to the player; ValueError: unknown verb, or unfit body."""
        verbs: dict[str, Callable[[], None]] = {
            "report": lambda: None,
            "pause": self._player.pause,
            "resume": self._player.resume,
            "seek": lambda: self._player.seek(self._begin_ns + round(_number(command, "t_s") * 1e9)),
            "speed": lambda: self._player.set_speed(_number(command, "factor")),
            "tap": lambda: None if self._probe is None else self._probe.lease(),
            "stop": self._stop.set,
        }
        if command.verb not in verbs:
            raise ValueError(f"{MASTER} (playing): no command {command.verb!r}; there are {', '.join(verbs)}")
        verbs[command.verb]()
        return self.health()

    def close(self) -> None:
        """Report no more. Safe to call twice."""
        self._closing.set()
        self._player.stop()
        for thread in self._threads:
            thread.join()

    def _watch_stop(self) -> None:
        while not self._closing.is_set():
            if self._stop.wait(0.1):
                self._player.stop()
                return

    def _report(self) -> None:
        poses = self._player.poses
        report_s = 1.0
        while not self._closing.wait(report_s):
            self._rate, poses = (self._player.poses - poses) / report_s, self._player.poses
            if self._bus is not None:
                self._bus.publish("health", MASTER, self.health())
            self._show(self.position_s, self.length_s)


def _number(command: Command, key: str) -> float:
    """The one number in the body of a command; ValueError: it is another body."""
    text = f'{command.verb}: the body must be {{"{key}": a number}}, not {command.body!r}'
    try:
        body = msgspec.json.decode(command.body, type=dict[str, float])
    except msgspec.MsgspecError as error:
        raise ValueError(text) from error
    if set(body) != {key} or not isfinite(body[key]):
        raise ValueError(text)
    return body[key]


def play(options: Namespace) -> None:
    """Play a recording."""
    speed, stretch = _speed(options.speed), (options.from_s, options.to_s)
    settings = PlaySettings(options.file, speed, *stretch, options.out, options.loop, options.solved)
    stop, line = stop_on_signals(), ProgressLine(sys.stderr, "play")

    def show(position_s: float, length_s: float) -> None:
        done = position_s / length_s if length_s > 0.0 else 1.0
        line.show(f"{bar(done)} {position_s:.1f} of {length_s:.1f} s")

    with nullcontext() if options.no_bus else closing(host_bus(options.bus)) as bus:
        passed = run_play(settings, bus, stop, lambda text: echo(f"play: {text}"), show)
    poses = passed.digest.counts["poses"]
    line.end(f"{poses} poses in {passed.seconds:.2f} s, {passed.poses_per_s:.0f} poses/s")
    if not passed.whole:
        echo("played in part, or with jumps: these are not the sums of the whole recording")
    for text in passed.digest.lines():
        echo(text)


def _speed(text: str) -> float:
    """The factor that was asked for; 0: as fast as it goes; else PhalanxError."""
    try:
        factor = 0.0 if text == "max" else float(text)
    except ValueError:
        factor = -1.0
    if not 0.0 < factor <= 1000.0 and text != "max":
        raise PhalanxError(f"--speed {text}: must be max, or a number above 0 and at most 1000")
    return factor
