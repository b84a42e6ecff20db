"""`phalanx-master fleet`: one row for each process of a rig, from what it and the master say of it on the bus."""

import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import typer

from common.bus import Bus
from common.errors import PhalanxError
from common.keys import keys_folder
from common.messages import Health
from common.streams import MASTER
from master.master_bus import join_bus
from master.options import HERE_BUS, BusEnd
from master.stopping import stop_on_signals

_POLL_S = 0.1
_SILENT_S = 3.0  # three reports


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
    """Reports of all processes as they come. Holds the last two of each, and when the last one came."""

    def __init__(self, expected: Sequence[str]) -> None:
        """Of these, which are told as unknown until they report."""
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
        silent = now_s - self._at[name] > _SILENT_S
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
        """Messages a second that the master took from it since its report before; None: the master does not know it."""
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


def fleet(
    bus: BusEnd = HERE_BUS,
    seconds: Annotated[float, typer.Option(min=0.5, max=3600.0, help="How long it listens.")] = 3.0,
    watch: Annotated[bool, typer.Option("--watch", help="A line of JSON each second, until Ctrl-C.")] = False,
) -> None:
    """Say how each process of the rig is, as JSON; `phalanx fleet` shows it as a table.

    Examples:

      phalanx-master fleet --keys ~/.config/phalanx/keys

      phalanx-master fleet --watch | jq -c '.devices[] | [.name, .state]'
    """
    connection = join_bus(bus)
    try:
        roll = Roll(expected_devices(os.environ))
        _listen(connection, roll, 1.0 if watch else seconds, watch, stop_on_signals())
    finally:
        connection.close()


def main() -> None:
    """`python -m master.fleet`: the same, without loading what else the master's program can do."""
    try:
        typer.run(fleet)
    except PhalanxError as error:
        raise SystemExit(f"fleet: {error}") from error


def _listen(bus: Bus, roll: Roll, period_s: float, watch: bool, stop: threading.Event) -> None:
    inbox = bus.subscribe("health", depth=256)
    due_s = time.monotonic() + period_s
    while not stop.is_set():
        health = inbox.get(_POLL_S)
        if isinstance(health, Health):
            roll.push(health, time.monotonic())
        if time.monotonic() >= due_s:
            typer.echo(json.dumps({"devices": [asdict(one) for one in roll.devices(time.monotonic())]}))
            due_s += period_s
            if not watch:
                return


if __name__ == "__main__":
    main()
