"""`phalanx fleet status` shows each process of a rig, or waits for senders.

A row has what a process and the master report of it on the bus. With --wait it reports whether senders are
received here; an installer rolls back if they are not. Where a master runs, it is asked what it takes. Where
none does, this command gives the start and counts the datagrams that come; when it ends, slaves wait for
their master again.
"""

import json
import os
import threading
import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

from common.bus.bus import Bus
from common.bus.keys import FOLDER, keys_folder, link_key
from common.bus.zenoh_bus import ZenohBus
from common.calibration import RigCalibration, load
from common.clock import SystemClock
from common.command_line import UsageError, echo
from common.errors import BusError, PhalanxError
from common.link.datagram import Address, LinkKey
from common.messages import Health
from common.messages.streams import MASTER
from master.commands.options import HERE_BUS, address, bus_end
from master.run.ingest import Ingest
from master.run.process import join_bus, stop_on_signals

_POLL_S = 0.1
Received = dict[str, float]


def wait_for_senders(options: Namespace) -> int:
    """Wait for datagrams of all these senders; return exit code 1 if one is missing."""
    stop = stop_on_signals()
    names: list[str] = options.wait
    seconds = options.seconds or 20.0
    connection = _running(options.bus)
    if connection is not None:
        with closing(connection):
            received = at_master(connection, names, seconds, stop)
    else:
        setup = load(options.calibration / "rigs" / f"{options.rig}.json", RigCalibration)
        received = here(names, setup, link_key(os.environ, options.key_file), address(options.beacon, "--beacon"),
                     address(options.bind, "--bind"), seconds, stop)  # fmt: skip
    if options.as_json:
        echo(json.dumps({"heard": received, "master": connection is not None}))
    for name in names if not options.as_json else ():
        echo(f"{name}: {f'{received[name]:.0f} datagrams a second' if name in received else 'not received'}")
    return int(len(received) < len(set(names)))


def at_master(bus: Bus, names: Sequence[str], seconds: float, stop: threading.Event) -> Received:
    """Return name -> datagrams a second that the running master receives, if any.

    Raises:
        PhalanxError: It does not know one of them.
    """
    inbox = bus.subscribe("health", MASTER)
    first: Health | None = None
    received: Received = {}
    end = time.monotonic() + seconds
    while len(received) < len(set(names)) and time.monotonic() < end and not stop.is_set():
        health = inbox.get(_POLL_S)
        if not isinstance(health, Health):
            continue
        for name in names:
            if f"{name}.received" not in health.counts:
                raise PhalanxError(
                    f"the master that runs here does not know {name!r}: does it run with --rig of that?"
                )
        if first is None or first.session != health.session:
            first, received = health, {}
        passed_s = (health.t_ns - first.t_ns) * 1e-9
        for name in names:
            count = health.counts[f"{name}.received"] - first.counts[f"{name}.received"]
            if count > 0 and passed_s > 0.0:
                received[name] = count / passed_s
    inbox.close()
    return received


def here(
    names: Sequence[str],
    rig: RigCalibration,
    key: LinkKey | bytes,
    beacon: Address,
    bind: Address,
    seconds: float,
    stop: threading.Event,
) -> Received:
    """Start the senders and return name -> datagrams a second of those received here.

    Raises:
        PhalanxError: A name is none of the rig's.
        BusError: The port is taken.
    """
    imus = () if rig.imu is None else (rig.imu.name,)
    for name in names:
        if name not in (*rig.cameras, *imus):
            raise PhalanxError(f"rig {rig.name!r} has no camera or IMU {name!r}")
    wrists = rig.cameras if rig.kind == "wrist" else ()
    try:
        ingest = Ingest(rig.cameras, key, SystemClock(), beacon, bind, "", 1.0, imus=imus, wrists=wrists)
    except BusError as error:
        raise BusError(f"{error}; if a master runs here, give its address: --bus ENDPOINT") from error
    with closing(ingest):
        return _counted(ingest, names, seconds, stop)


def _counted(ingest: Ingest, names: Sequence[str], seconds: float, stop: threading.Event) -> Received:
    began = time.monotonic()
    first: dict[str, float] = {}
    received: Received = {}
    while time.monotonic() - began < seconds and len(received) < len(set(names)) and not stop.is_set():
        ingest.get(_POLL_S)
        while ingest.get(0.0) is not None:
            pass  # that it came is enough
        now = time.monotonic()
        for name in names:
            count = ingest.counts_of(name).received
            if count:
                passed_s = now - first.setdefault(name, now)
                rate_s = 1.0  # how long datagrams are counted after the first of each
                if passed_s >= rate_s or now - began > seconds - _POLL_S:
                    received[name] = count / max(passed_s, rate_s)
    return received


def _running(endpoint: str) -> ZenohBus | None:
    """The bus of a master that runs; None: none does."""
    try:
        bus = join_bus(endpoint)
    except BusError as error:
        if error.__cause__ is None:  # the endpoint is malformed, or keys are missing
            raise
        return None
    appear_s = 1.5  # whoever has just connected is not known everywhere yet
    end = time.monotonic() + appear_s
    while time.monotonic() < end:
        if MASTER in bus.alive():
            return bus
        time.sleep(_POLL_S)
    bus.close()
    return None


_HEAD = ("device", "host", "version", "temperature", "throttled", "rate", "clock offset", "state")
_HOME = "\x1b[H\x1b[J"  # to the top of the screen, and clear it
DEFAULT_KEYS = ".config/phalanx/keys"  # where `phalanx fleet deploy` makes them


@dataclass(frozen=True, slots=True)
class Device:
    """A process of the rig: camera, IMU, tracker, master or another program.

    Attributes:
        state: streaming, waiting (it reports, and sends nothing), silent (no report any more) or unknown
            (never one); running: the master, and what is no sender of it and has no keys of a device, as a
            recorder.
        temperature_c: Of its machine [degrees C].
        throttled: Whether that machine lowers its clock now, or its supply is too weak.
        rate_hz: Messages a second that the master takes from it.
        offset_us, sigma_us: Its clock against the master's, and how sure that is [us].
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
    """Status reports of all processes: the last two of each, and when the last came."""

    def __init__(self, expected: Sequence[str]) -> None:
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
        if silent and not rate:
            state = "silent"
        elif name == MASTER or self._is_program(name):
            state = "running"
        else:
            state = "streaming" if rate else "waiting"
        metrics = own.metrics
        throttled = metrics.get("throttled")
        return Device(
            name, state, own.host, own.version, metrics.get("temperature_c"),
            None if throttled is None else bool(throttled), rate, *clock,
        )  # fmt: skip

    def _is_program(self, name: str) -> bool:
        """Whether it is nothing that a master takes measurements from, as a recorder."""
        last = self._last.get(MASTER)
        return name not in self._expected and last is not None and f"{name}.received" not in last.counts

    def _rate(self, name: str) -> float | None:
        """Return the messages per second that the master took from a process, or None."""
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
    """Show each process of the rig, or wait for some; return the exit code.

    Raises:
        UsageError: `--wait` and `--watch` are both given.
    """
    _use_default_keys(options)
    if options.wait:
        if options.watch:
            raise UsageError("--watch has no meaning with --wait: leave it out")
        return wait_for_senders(options)

    def show(devices: Sequence[Device]) -> str:
        if options.as_json:
            return json.dumps({"devices": [asdict(one) for one in devices]})
        return (_HOME if options.watch else "") + "\n".join(table(devices))

    period_s = 1.0 if options.watch else options.seconds or 3.0
    with closing(join_bus(options.bus)) as bus:
        roll = Roll(expected_devices(os.environ))
        _listen(bus, roll, period_s, options.watch, stop_on_signals(), show)
    return 0


def _use_default_keys(options: Namespace) -> None:
    """Use the keys folder of deployments, where no other is named."""
    folder, bus = Path.home() / DEFAULT_KEYS, bus_end(HERE_BUS)
    if FOLDER in os.environ or not folder.is_dir():
        return
    os.environ[FOLDER] = str(folder)
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
        "-" if device.temperature_c is None else f"{device.temperature_c:.0f} °C",
        {None: "-", True: "yes", False: "no"}[device.throttled],
        "-" if device.rate_hz is None else f"{device.rate_hz:.1f}/s",
        "-" if device.offset_us is None else f"{device.offset_us:+.0f} ± {device.sigma_us or 0.0:.0f} µs",
        device.state,
    )


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
        health = inbox.get(0.1)
        if isinstance(health, Health):
            roll.push(health, time.monotonic())
        if time.monotonic() >= due_s:
            echo(show(roll.devices(time.monotonic())))
            due_s += period_s
            if not watch:
                return
