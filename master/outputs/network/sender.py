"""The sender of `phalanx send` feeds the live outputs from the bus.

A process beside a running master, "outputs" on the bus. It follows its settings file and reports. Commands:
`on` and `off`, body {"output": "osc"}, switch one until the file states otherwise; `report`; `stop` ends it.
"""

import secrets
import threading
from argparse import Namespace
from collections.abc import Callable, Collection
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import msgspec
from msgspec import Struct

from common.bus.bus import Bus, Subscription
from common.calibration import load
from common.calibration.files import MonitoredFiles
from common.calibration.output_settings import OutputSettings, default_outputs
from common.clock import now_ns
from common.command_line import echo
from common.errors import BusError, PhalanxError
from common.machine import program
from common.messages import Command, Health, ResultMessage
from common.messages.streams import MASTER
from master.outputs.network.conventions import MasterTimes
from master.outputs.network.outputs import OUTPUTS, Counters, OutputLine, switched_on, who_reads
from master.run.process import bus_of_master, stop_on_signals

NAME = "outputs"
STREAMS = ("hand", "object", "contact", "gesture")


class Switch(Struct, frozen=True, forbid_unknown_fields=True):
    """Body of the commands `on` and `off`."""

    output: str


def settings_of(path: Path) -> OutputSettings:
    """Load the settings file, or defaults for no default.json; CalibrationError."""
    if path.name == "default.json" and not path.exists():
        return default_outputs()
    return load(path, OutputSettings)


class Sender:
    """Set of live outputs: those that are on have a line each."""

    def __init__(
        self,
        settings: OutputSettings,
        only: Collection[str],
        notify: Callable[[str], None],
    ) -> None:
        """Switch on what the settings have on, or exactly what `only` names."""
        refuse_unknown(only)
        self._settings, self._notify = settings, notify
        self._only = frozenset(only)
        self._session = secrets.randbits(63)
        self.times = MasterTimes()
        self.counters_by_name = {name: Counters() for name in OUTPUTS}
        self._lines: dict[str, OutputLine] = {}
        self._received = 0
        self._lock = threading.RLock()  # commands come on a thread of the bus
        for name, on in switched_on(settings).items():
            if name in self._only or (on and not self._only):
                self.switch(name, on=True)

    @property
    def on(self) -> tuple[str, ...]:
        """Names of the outputs that are switched on."""
        with self._lock:
            return tuple(name for name in OUTPUTS if name in self._lines)

    def where(self, name: str) -> str:
        """Where an output sends to, and who else can read it there, for a person."""
        try:
            where = OUTPUTS[name].where(self._settings)
        except PhalanxError as error:
            return str(error)  # it is not opened either
        reader = who_reads(name, self._settings)
        return where if reader is None else f"{where}; {reader}"

    def switch(self, name: str, *, on: bool) -> None:
        """Switch one output; PhalanxError: there is no such output."""
        refuse_unknown([name])
        line: OutputLine | None = None
        with self._lock:
            if not on:
                line = self._lines.pop(name, None)
            elif name not in self._lines:
                make = partial(OUTPUTS[name].make, self._settings, self.times)
                self._lines[name] = OutputLine(name, make, self.counters_by_name[name], self._notify)
        if line is not None:
            line.close()
            self.counters_by_name[name].trouble = ""

    def use(self, settings: OutputSettings) -> None:
        """Apply other settings: recreate what is set otherwise, switch a changed `on`.

        Where `only` chose the outputs, `on` switches nothing.
        """
        with self._lock:
            before, self._settings = self._settings, settings
        was_on, is_on = switched_on(before), switched_on(settings)
        for name, output in OUTPUTS.items():
            if output.part(before) == output.part(settings):
                continue
            switched = was_on[name] != is_on[name] and not self._only
            on = is_on[name] if switched else name in self.on
            self.switch(name, on=False)
            self.switch(name, on=on)
            self._notify(f"{name}: {self.where(name)}" if on else f"{name}: off")

    def push(self, message: ResultMessage) -> None:
        """Give a message to every output that is on and takes it; never waits."""
        self._received += 1
        with self._lock:
            for name, line in self._lines.items():
                if isinstance(message, OUTPUTS[name].takes):
                    line.offer(message)

    def health(self, lost: int = 0) -> Health:
        """Return the health report; `lost`: messages not taken from the bus in time."""
        counts = {"received": self._received, "lost": lost}
        metrics: dict[str, float] = {}
        with self._lock:
            for name, counters in self.counters_by_name.items():
                line = self._lines.get(name)
                counts[f"sent.{name}"] = counters.sent
                counts[f"failed.{name}"] = counters.failed
                counts[f"dropped.{name}"] = counters.dropped
                metrics[f"on.{name}"] = float(line is not None)
                metrics[f"open.{name}"] = float(line is not None and line.open)
        return Health(NAME, self._session, now_ns(), counts, metrics, *program())

    def obey(self, command: Command) -> None:
        """Obey a command, except `stop`; PhalanxError lists what there is."""
        if command.verb in ("on", "off"):
            try:
                body = msgspec.json.decode(command.body, type=Switch)
            except msgspec.MsgspecError as error:
                raise PhalanxError(
                    f'{command.verb}: body {command.body!r}: {error}; write {{"output": "osc"}}'
                ) from error
            self.switch(body.output, on=command.verb == "on")
            self._notify(f"{body.output}: {self.where(body.output) if command.verb == 'on' else 'off'}")
        elif command.verb not in ("report", "stop"):
            raise PhalanxError(f"unknown verb {command.verb!r}; there are on, off, report, stop")

    def close(self) -> None:
        """Send what waits and close every output."""
        with self._lock:
            lines, self._lines = list(self._lines.values()), {}
        for line in lines:
            line.close()


class Housekeeping:
    """Background tasks of the sender, on a thread of its own."""

    def __init__(self, sender: Sender, bus: Bus, path: Path, subscribers: Collection[Subscription]) -> None:
        self._sender, self._bus, self._path, self._subscribers = sender, bus, path, subscribers
        self._monitored = MonitoredFiles()
        self._monitored.changed([path])  # as it was read

    def step(self, notify: Callable[[str], None]) -> None:
        """Use the file if it changed, ask the master for its time, publish the report."""
        if self._monitored.changed([self._path]):
            try:
                self._sender.use(settings_of(self._path))
            except PhalanxError as error:
                notify(f"{error}; the settings stay as they were")
        asked_ns = now_ns()
        with suppress(BusError):  # no master now: nothing comes from it either
            master_ns = self._bus.ask(Command(MASTER, "report"), 0.5).t_ns
            self._sender.times.push(asked_ns, master_ns, now_ns())
        self._bus.publish("health", NAME, self.health())

    def health(self) -> Health:
        """The report, with what was lost on the way here."""
        return self._sender.health(sum(subscriber.dropped for subscriber in self._subscribers))


def run_sender(
    bus: Bus,
    settings: OutputSettings,
    path: Path,
    only: Collection[str],
    stop: threading.Event,
    notify: Callable[[str], None],
) -> None:
    """Send until `stop` is set or the command `stop` comes; the bus stays open.

    Raises:
        BusError: The bus is closed.
        PhalanxError: `only` names an output that there is not.
    """
    depth = 512  # of each stream; it is emptied at once
    subscribers = [bus.subscribe(stream, depth=depth) for stream in STREAMS]
    sender = Sender(settings, only, notify)
    housekeeping = Housekeeping(sender, bus, path, subscribers)

    def obey(command: Command) -> Health:
        sender.obey(command)
        if command.verb == "stop":
            stop.set()
        return housekeeping.health()

    def report() -> None:
        with suppress(BusError):  # closing
            while not stop.wait(1.0):
                housekeeping.step(notify)

    bus.serve(NAME, obey)
    bus.announce(NAME)
    for name in sender.on:
        notify(f"{name}: {sender.where(name)}")
    if not sender.on:
        notify(f"all outputs are off; switch them on in {path}, or name them: --only osc,vmc")
    thread = threading.Thread(target=report, name="outputs report", daemon=True)
    thread.start()
    try:
        while not stop.is_set():
            wait_s = 0.02  # for a hand, with which all else comes
            for subscriber in subscribers:
                while (message := subscriber.get(wait_s)) is not None:
                    wait_s = 0.0
                    if isinstance(message, ResultMessage):
                        sender.push(message)
                wait_s = 0.0
    finally:
        stop.set()
        thread.join(2.0)
        sender.close()
        for subscriber in subscribers:
            subscriber.close()


def refuse_unknown(names: Collection[str]) -> None:
    """Refuse names of outputs that there are not; PhalanxError lists what there is."""
    for name in names:
        if name not in OUTPUTS:
            raise PhalanxError(f"output {name!r}: unknown; there are {', '.join(OUTPUTS)}")


def send(options: Namespace) -> None:
    """Send hands, objects, contact and gestures to other programs.

    OSC, VMC, ROS 2, LSL, WebSocket.
    """
    path = options.calibration / "outputs" / f"{options.outputs}.json"
    settings = settings_of(path)
    names = [name.strip() for name in (options.only or "").split(",") if name.strip()]
    refuse_unknown(names)  # now, not when a master is there

    def notify(line: str) -> None:
        echo(f"outputs: {line}")

    stop = stop_on_signals()
    connection = bus_of_master(
        options.bus, stop, lambda error: notify(f"waiting for a master: {error}"), options.site
    )
    if connection is None:
        return
    with closing(connection):
        if NAME in connection.alive():  # two would send everything and answer commands twice
            raise BusError(
                f"{NAME!r} is on the bus already: another `phalanx send` runs beside this master;"
                " switch its outputs in its settings file, or end it"
            )
        run_sender(connection, settings, path, names, stop, notify)
