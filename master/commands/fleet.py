"""`phalanx fleet status`: one row for each process of a rig.

A row has what the process and the master report of it on the bus.
"""

import json
import os
import threading
import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from common.bus.bus import Bus
from common.bus.keys import FOLDER, keys_folder
from common.command_line import UsageError
from common.messages import Health
from common.messages.streams import MASTER
from common.terminal import echo
from master.commands.options import HERE_BUS, bus_end
from master.run.master_bus import join_bus
from master.run.stopping import stop_on_signals

_HEAD = ("device", "host", "version", "temperature", "throttled", "rate", "clock offset", "state")
_HOME = "\x1b[H\x1b[J"  # to the top of the screen, and clear it
USUAL_KEYS = ".config/phalanx/keys"  # where `phalanx fleet deploy` makes them


@dataclass(frozen=True, slots=True)
class Device:
    """A process of the rig.

    Attributes:
        name: Camera, IMU, tracker, or the master.
        state: streaming, waiting (it reports, and sends nothing), silent (no report any more) or unknown (never one);
            running: the master, and what is no sender of it and has no keys of a device, as a recorder.
        host: Machine that it runs on.
        version: Of its program.
        temperature_c: Of that machine [degrees C].
        throttled: Whether that machine lowers its clock now, or its supply is too weak.
        rate_hz: Messages a second that the master takes from it.
        offset_us: Its clock against the master's [us].
        sigma_us: How sure that is [us].
    """

    name: str
    state: str
    host: str = ""
    version: str = ""
    temperature_c: float | None = None
    throttled: bool | None = None
    rate_hz: float | None = None
    offset_us: float | None = None
    sigma_us: float | None = None


class Roll:
    """Status reports of all processes as they arrive.

    Holds the last two of each, and when the last one came.
    """

    def __init__(self, expected: Sequence[str]) -> None:
        """Expect these processes, which are shown as unknown until they report."""
        self._expected = tuple(expected)
        self._last: dict[str, Health] = {}
        self._before: dict[str, Health] = {}
        self._at: dict[str, float] = {}

    def push(self, health: Health, now_s: float) -> None:
        """Take a report."""
        if (last := self._last.get(health.source)) is not None and last.session == health.session:
            self._before[health.source] = last
        else:  # it began anew
            self._before.pop(health.source, None)
        self._last[health.source], self._at[health.source] = health, now_s

    def devices(self, now_s: float) -> list[Device]:
        """All that are expected, then all others that reported."""
        names = [*self._expected, *sorted(name for name in self._last if name not in self._expected)]
        return [self._device(name, now_s) for name in names]

    def _device(self, name: str, now_s: float) -> Device:
        master = self._last.get(MASTER)
        reported = {} if master is None else master.metrics
        rate = self._rate(name)
        clock = (reported.get(f"{name}.clock_offset_us"), reported.get(f"{name}.clock_sigma_us"))
        own = self._last.get(name)
        if own is None:
            known = "streaming" if rate else "unknown"
            return Device(name, known, rate_hz=rate, offset_us=clock[0], sigma_us=clock[1])
        silent_s = 3.0  # three reports
        silent = now_s - self._at[name] > silent_s
        state = (
            "silent"
            if silent and not rate
            else "running"
            if name == MASTER or self._is_program(name)
            else "streaming"
            if rate
            else "waiting"
        )
        metrics = own.metrics
        throttled = metrics.get("throttled")
        return Device(
            name,
            state,
            own.host,
            own.version,
            metrics.get("temperature_c"),
            None if throttled is None else bool(throttled),
            rate,
            *clock,
        )

    def _is_program(self, name: str) -> bool:
        """Whether it is nothing that a master takes measurements from, as a recorder."""
        last = self._last.get(MASTER)
        return name not in self._expected and last is not None and f"{name}.received" not in last.counts

    def _rate(self, name: str) -> float | None:
        """Return the messages per second that the master took from a process.

        They are counted since its report before; None: the master does not know it.
        """
        last, before = self._last.get(MASTER), self._before.get(MASTER)
        event = f"{name}.received"
        if last is None or before is None or event not in last.counts:
            return None
        passed_s = (last.t_ns - before.t_ns) * 1e-9
        return (last.counts[event] - before.counts.get(event, 0)) / passed_s if passed_s > 0.0 else None


def expected_devices(environment: Mapping[str, str]) -> list[str]:
    """Those that have keys in the keys folder: they were deployed."""
    folder = keys_folder(environment)
    return [] if folder is None else sorted(path.stem for path in (folder / "devices").glob("*.pem"))


def status(options: Namespace) -> int:
    """Show each process of the rig and return the exit code.

    Can also wait until some processes have reported.

    Raises:
        UsageError: `--wait` and `--watch` are both given.
    """
    _use_usual_keys(options)
    if options.wait:
        if options.watch:
            raise UsageError("--watch has no meaning with --wait: leave it out")
        from master.commands.wait_for_senders import wait_for_senders

        return wait_for_senders(options)
    show = _as_json if options.as_json else _as_table if not options.watch else _on_screen
    once_s = 3.0
    period_s = 1.0 if options.watch else options.seconds or once_s
    connection = join_bus(options.bus)
    try:
        _listen(
            connection, Roll(expected_devices(os.environ)), period_s, options.watch, stop_on_signals(), show
        )
    finally:
        connection.close()
    return 0


def _use_usual_keys(options: Namespace) -> None:
    """Use the keys folder that a deployment makes, where no other is named."""
    typical, bus = Path.home() / USUAL_KEYS, bus_end(HERE_BUS)
    if FOLDER in os.environ or not typical.is_dir():
        return
    os.environ[FOLDER] = str(typical)
    if options.bus == bus:
        options.bus = bus_end(HERE_BUS)


def table(devices: Sequence[Device]) -> list[str]:
    """Lines for a person; a dash where nothing is known."""
    rows = [_HEAD, *(_row(device) for device in devices)]
    widths = [max(len(row[n]) for row in rows) for n in range(len(_HEAD))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _row(device: Device) -> tuple[str, ...]:
    return (
        device.name,
        device.host or "-",
        device.version or "-",
        _number(device.temperature_c, "{:.0f} °C"),
        "-" if device.throttled is None else "yes" if device.throttled else "no",
        _number(device.rate_hz, "{:.1f}/s"),
        "-" if device.offset_us is None else f"{device.offset_us:+.0f} ± {device.sigma_us or 0.0:.0f} µs",
        device.state,
    )


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def _as_json(devices: Sequence[Device]) -> str:
    return json.dumps({"devices": [asdict(one) for one in devices]})


def _as_table(devices: Sequence[Device]) -> str:
    return "\n".join(table(devices))


def _on_screen(devices: Sequence[Device]) -> str:
    return _HOME + _as_table(devices)


def _listen(
    bus: Bus,
    roll: Roll,
    period_s: float,
    watch: bool,
    stop: threading.Event,
    show: Callable[[Sequence[Device]], str],
) -> None:
    inbox = bus.subscribe("health", depth=256)
    due_s = time.monotonic() + period_s
    while not stop.is_set():
        poll_s = 0.1
        health = inbox.get(poll_s)
        if isinstance(health, Health):
            roll.push(health, time.monotonic())
        if time.monotonic() >= due_s:
            echo(show(roll.devices(time.monotonic())))
            due_s += period_s
            if not watch:
                return
