"""`phalanx info` and its neighbours describe a recording in lines of text."""

from argparse import Namespace
from typing import TextIO

import msgspec

from common.calibration.files import is_plain
from common.command_line import echo
from common.messages import WIRE_VERSION, Health
from common.recording.messages import MessageRecording, open_messages
from master.recording.recorder import Progress

RAW_FOLDERS = msgspec.json.Decoder(dict[str, str])


class ProgressLine:
    """Progress display: on a terminal in place, elsewhere a line at every fifth call."""

    def __init__(self, stream: TextIO, prefix: str) -> None:
        self._stream, self._prefix, self._calls = stream, prefix, 0

    def show(self, text: str) -> None:
        """It goes on; called once a second."""
        self._calls += 1
        plain_every = 5  # calls, where no terminal shows the line in place
        if self._stream.isatty():
            self._write(f"\r{self._prefix}: {text}\x1b[K")
        elif self._calls % plain_every == 0:
            self._write(f"{self._prefix}: {text}\n")

    def end(self, text: str) -> None:
        """It is over."""
        self._write(
            f"\r{self._prefix}: {text}\x1b[K\n" if self._stream.isatty() else f"{self._prefix}: {text}\n"
        )

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:
            return  # nobody reads any more; what it reports on goes on


def progress_text(now: Progress, lost: int, seconds: float | None) -> str:
    """One line for a person who waits; `seconds` is the length that was asked for."""
    total = sum(now.counts.values())
    length = (
        f"{now.seconds:.0f} s" if seconds is None else f"{min(now.seconds, seconds):.0f} of {seconds:g} s"
    )
    parts = [length, f"{total} messages", f"{now.written_bytes * 1e-6:.1f} MB"]
    parts += [f"{now.bytes_per_s * 1e-6:.2f} MB/s", f"{sum(now.dropped.values())} dropped"]
    if lost:
        parts.append(f"{lost} never came")
    if now.waiting > 100:
        parts.append(f"{now.waiting} waiting")
    return ", ".join([*parts, f"{now.free_bytes * 1e-9:.1f} GB free"])


def bar(done: float, length: int = 24) -> str:
    """How far it is, 0..1, as a bar."""
    full = round(length * min(max(done, 0.0), 1.0))
    return f"[{'#' * full}{'.' * (length - full)}]"


def table(recording: MessageRecording, events: list[str]) -> list[str]:
    """Return a table of a recording's streams and rates, length, files and faults."""
    seconds = (recording.end_t_ns - recording.begin_t_ns) * 1e-9
    megabytes = recording.path.stat().st_size * 1e-6
    ended = "cut: it was not ended" if recording.cut else "whole"
    lines = [f"{recording.path}: {ended}, {seconds:.2f} s, {megabytes:.2f} MB"]
    if seconds > 0.0:
        lines[0] += f" ({megabytes * 60 / seconds:.1f} MB a minute)"
    about = recording.about
    lines.append(
        f"started {about.get('started', '?')}, rigs {about.get('rigs', '?')}, wire {about.get('wire', '?')}"
    )
    if about.get("wire") != str(WIRE_VERSION):
        lines[-1] += f" (this program speaks {WIRE_VERSION}: what it does not know is left out)"
    lines += ["", f"{'stream':<12}{'sender':<24}{'messages':>10}{'per second':>12}"]
    for stream in sorted(recording.senders):
        for name, count in sorted(recording.senders[stream].items()):
            rate = f"{count / seconds:.2f}" if seconds > 0.0 else "-"
            lines.append(f"{stream:<12}{name:<24}{count:>10}{rate:>12}")
    lines += ["", "files: " + (", ".join(sorted(recording.files)) or "none")]
    if recording.broken:
        lines.append(f"broken: {recording.broken} chunks, files or messages cannot be read")
        lines += [f"  {one}" for one in recording.losses.named]
    return lines + raw_lines(recording) + [f"event: {event}" for event in events]


def raw_lines(recording: MessageRecording) -> list[str]:
    """List the raw frames that the slaves reported beside a recording."""
    try:
        folders = RAW_FOLDERS.decode(recording.about.get("raw", "{}"))
    except (msgspec.DecodeError, RecursionError):
        folders = {"?": "?"}
    if not all(map(is_plain, (*folders, *folders.values()))):
        return ["raw frames: the file does not say where they are"]
    last: dict[str, Health] = {}
    for one in recording.read(["health"]) if folders else ():
        health = one.message
        if isinstance(health, Health) and (health.source in last or health.metrics.get("raw.on")):
            last[health.source] = health
    return [
        f"raw frames of {name}: {last[name].counts.get('raw.frames', 0)} in {folder},"
        f" {last[name].counts.get('raw.dropped', 0)} dropped"
        if name in last
        else f"raw frames of {name}: none"
        for name, folder in folders.items()
    ]


def events_of(recording: MessageRecording) -> list[str]:
    """List what happened while recording that a replay cannot repeat or lacks."""
    watch = EventMonitor(recording.begin_t_ns)
    return [line for one in recording.read(["health"]) for line in watch.push(one.t_ns, one.message)]


class EventMonitor:
    """Monitor of events, from the reports of master and recorder."""

    def __init__(self, begin_t_ns: int) -> None:
        self._begin_ns = begin_t_ns
        self._master: int | None = None
        self._reloads = self._missing = 0
        self.restarted = self.changed = False

    def push(self, t_ns: int, message: object) -> list[str]:
        """Take a report; return what is new; `restarted`: the first of a new master."""
        self.restarted = False
        if not isinstance(message, Health):
            return []
        at = f"at {(t_ns - self._begin_ns) * 1e-9:.1f} s"
        lines: list[str] = []
        if message.source == "master":
            self.restarted = self._master not in (None, message.session)
            reloads = message.counts.get("reload.applied", 0)
            if self.restarted:
                lines.append(f"{at} the master was started again; a replay begins anew there")
            elif self._master is not None and reloads != self._reloads:
                self.changed = True
                lines.append(
                    f"{at} files of the rig were changed: from there on a replay differs from the live output"
                )
            self._master, self._reloads = message.session, reloads
        elif message.source == "recorder":
            missing = message.counts.get("dropped", 0) + message.counts.get("lost", 0)
            if missing > self._missing:
                lines.append(f"{at} {missing - self._missing} messages were not recorded")
            self._missing = max(missing, self._missing)
        return lines


def info(options: Namespace) -> None:
    """Show the contents of a recording of messages.

    Streams, rates, length, files, and what happened.
    """
    recording = open_messages(options.file)
    events = events_of(recording)
    echo("\n".join(table(recording, events)))
