"""State of the computer: temperature, throttling, free disk space.

Linux; what is not available is not reported. A Raspberry Pi reports by its firmware that it throttles, its clock is
capped, or its supply is too weak. Others define by the trip points of their thermal zones how warm is too warm.
Everything is read below a root, / unless the variable `PHALANX_SYSTEM_ROOT` is set: there a rehearsal or a test lays
its own files, with the room of the disk in `disk_free_mb`.
"""

import contextlib
import os
import shutil
import socket
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

ROOT = "PHALANX_SYSTEM_ROOT"
_ZONES = "sys/class/thermal"
# Below soc or, on a Pi 5 with newer kernels, soc@107c000000. The file is deprecated, and some kernels have none: these
# report a weak supply alone, as an alarm of the sensor rpi_volt (Linux, drivers/hwmon/raspberrypi-hwmon.c).
_THROTTLED = "sys/devices/platform/soc*/soc*:firmware/get_throttled"
_SENSORS, _SUPPLY, _WEAK = "sys/class/hwmon/hwmon*", "rpi_volt", "in0_lcrit_alarm"
_TRIPS = ("passive", "hot", "critical")


class Program(NamedTuple):
    """Host and version of a program, as `Health` reports them."""

    host: str
    version: str


@cache
def program() -> Program:
    """This program on this machine; its version is empty if never installed."""
    try:
        installed = version("phalanx-hand")
    except PackageNotFoundError:
        installed = ""
    return Program(socket.gethostname()[:64], installed[:64])


class Machine:
    """Reader of the computer's metrics."""

    def __init__(self, folder: Path, environment: Mapping[str, str] = os.environ) -> None:
        """Of this computer, and the disk that `folder` is on."""
        self._root = Path(environment.get(ROOT, "/"))
        self._folder = folder
        self._rehearsed = ROOT in environment
        self._flags = next(iter(sorted(self._root.glob(_THROTTLED))), None)
        sensors = (path / _WEAK for path in self._root.glob(_SENSORS) if _text(path / "name") == _SUPPLY)
        self._weak = next(sensors, None) if self._flags is None else None

    def metrics(self) -> dict[str, float]:
        """Temperature, throttling and free disk space, as far as known.

        temperature_c and temperature_limit_c of the zone nearest to its limit, throttled (flags), disk_free_mb.
        """
        found: dict[str, float] = {}
        zones = [
            zone for path in sorted((self._root / _ZONES).glob("thermal_zone*")) if (zone := _zone(path))
        ]
        if zones:
            now, limit = max(zones, key=lambda zone: zone[0] - zone[1])
            found |= {"temperature_c": round(now, 1), "temperature_limit_c": limit}
        if (flags_path := self._flags or self._weak) is not None and (flags := _text(flags_path)) is not None:
            with contextlib.suppress(ValueError):  # of another firmware: nothing is known
                found["throttled"] = float(int(flags, 16) & 0xF)  # now; bits above: since the start
        if (free := self.disk_free_mb()) is not None:
            found["disk_free_mb"] = round(free, 1)
        return found

    def disk_free_mb(self) -> float | None:
        """Room on the disk [MB]; None: not known."""
        if self._rehearsed and (text := _text(self._root / "disk_free_mb")) is not None:
            with contextlib.suppress(ValueError):  # it is being written
                return float(text)
        try:
            return shutil.disk_usage(self._folder).free * 1e-6
        except OSError:
            return None


def _zone(path: Path) -> tuple[float, float] | None:
    """Temperature of a thermal zone and its limit [degrees C]; None: no limit."""
    kind, milli = _text(path / "type"), _text(path / "temp")
    if kind is None or milli is None:
        return None
    try:
        now = int(milli) * 1e-3
        trips = [
            int(text) * 1e-3
            for trip in path.glob("trip_point_*_type")
            if _text(trip) in _TRIPS and (text := _text(trip.with_name(trip.name[:-4] + "temp"))) is not None
        ]
    except ValueError:
        return None
    if kind == "cpu-thermal":  # of a Raspberry Pi; its only trip point is far above what its firmware allows
        hot_c = 80.0  # from here on its clock is lowered (Raspberry Pi documentation, "Frequency management")
        return now, hot_c
    least_trip_c = 50.0  # a lower one switches a fan, or is a dummy of the firmware
    trips = [trip for trip in trips if trip >= least_trip_c]
    below_trip_c = 5.0
    return (now, min(trips) - below_trip_c) if trips else None


def _text(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except (OSError, UnicodeDecodeError):
        return None
