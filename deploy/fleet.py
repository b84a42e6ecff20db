"""The table of a fleet, from what `phalanx-master fleet` reads on the bus."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import cast

from deploy.remote import run_bounded
from deploy.targets import DeployError

_ONCE_S = 30.0
_HEAD = ("device", "host", "version", "temperature", "throttled", "rate", "clock offset", "state")
_HOME = "\x1b[H\x1b[J"  # to the top of the screen, and clear it


def fleet_once(keys: Path, bus: str | None) -> list[dict[str, object]]:
    """A row for each device.

    Raises:
        DeployError: No master answers.
    """
    lines: list[str] = []
    code, errors = run_bounded(_words(bus, False), b"", lines.append, _ONCE_S, _keys(keys))
    if code != 0 or not lines:
        raise DeployError(([*lines, *errors] or ["phalanx-master fleet says nothing"])[-1])
    return _devices(lines[-1])


def watch_fleet(keys: Path, bus: str | None, show: Callable[[str], None]) -> int:
    """Show the table each second, until Ctrl-C or the master ends; the exit code."""
    with subprocess.Popen(
        _words(bus, True), stdout=subprocess.PIPE, text=True, env={**os.environ, **_keys(keys)}
    ) as child:
        assert child.stdout is not None
        try:
            for line in child.stdout:
                show(_HOME + "\n".join(table(_devices(line))))
        except KeyboardInterrupt:
            child.terminate()
        return child.wait()


def table(devices: list[dict[str, object]]) -> list[str]:
    """Lines for a person; a dash where nothing is known."""
    rows = [_HEAD, *(_row(device) for device in devices)]
    widths = [max(len(row[n]) for row in rows) for n in range(len(_HEAD))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _row(device: Mapping[str, object]) -> tuple[str, ...]:
    offset, sigma = device.get("offset_us"), device.get("sigma_us")
    throttled = device.get("throttled")
    return (
        str(device["name"]),
        str(device.get("host") or "-"),
        str(device.get("version") or "-"),
        _number(device.get("temperature_c"), "{:.0f} °C"),
        "-" if throttled is None else "yes" if throttled else "no",
        _number(device.get("rate_hz"), "{:.1f}/s"),
        "-" if offset is None else f"{offset:+.0f} ± {sigma or 0.0:.0f} µs",
        str(device["state"]),
    )


def _number(value: object, form: str) -> str:
    return "-" if value is None else form.format(value)


def _words(bus: str | None, watch: bool) -> list[str]:
    words = [sys.executable, "-m", "master.fleet"]
    words += ["--bus", bus] if bus is not None else []
    return words + (["--watch"] if watch else [])


def _keys(folder: Path) -> dict[str, str]:
    return {"PHALANX_KEYS": str(folder)} if folder.is_dir() else {}


def _devices(line: str) -> list[dict[str, object]]:
    try:
        return cast(list[dict[str, object]], json.loads(line)["devices"])
    except (ValueError, KeyError, TypeError) as error:
        raise DeployError(line.strip() or "phalanx-master fleet says nothing") from error
