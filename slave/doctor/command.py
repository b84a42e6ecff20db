"""`phalanx-slave doctor`: which slaves this machine has, and every check of each."""

import argparse
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from common.command_line import UsageError
from common.machine import program
from common.terminal import echo
from slave.cli.table import PROGRAM
from slave.doctor.camera import check_camera
from slave.doctor.clock import check_clock
from slave.doctor.devices import cameras_of, check_devices, check_groups
from slave.doctor.finding import Finding, as_json, as_text, exit_code, fail, unseen
from slave.doctor.host import check_host
from slave.doctor.identity import check_keys, folder_of
from slave.doctor.master import check_master
from slave.doctor.programs import check_programs
from slave.doctor.system import System, pairs
from slave.doctor.unit import check_unit
from slave.drivers import SWITCHED_LIGHTS

ETC = "/etc/phalanx"


def run(options: argparse.Namespace) -> int:
    """Report what is well and what is not, and return the exit code.

    Instead, it may check the lights or list ports.

    Raises:
        UsageError: An option of the lights is given without them.
        PhalanxError: The lights cannot be looked at or switched.
    """
    if options.ports:
        from slave.devices import imu_places as places

        echo(places())
        return 0
    if options.lights is not None:
        from slave.commands.lights import look_at_lights

        return look_at_lights(options)
    if options.blink or options.off:
        raise UsageError(f"--blink and --off need the lights: --lights {SWITCHED_LIGHTS}")
    findings = list(examine(options, System.here()))
    echo(as_json(findings, program()) if options.json else as_text(findings))
    return exit_code(findings)


def examine(options: argparse.Namespace, system: System) -> Iterator[Finding]:
    """All findings: the machine, then each slave.

    Args:
        options: Of `phalanx-slave doctor`.
        system: The computer.
    """
    yield from check_host(system)
    yield from check_clock(system, options.master)
    yield check_groups(system)
    names = [options.name] if options.name else sorted(path.stem for path in system.path(ETC).glob("*.env"))
    slaves = [_slave(options, system, name) for name in names]
    given = [one for one in slaves if isinstance(one, argparse.Namespace)]
    yield from check_programs(system, sorted({extra for one in given for extra in _extras(one)}))
    yield cameras_of(system)
    folder = folder_of(system, options.keys)
    if not names:
        yield unseen("slave", f"none in {ETC}: give --name, --rig, --camera, or install it first")
        yield from check_keys(system, folder, None)
    for name, slave in zip(names, slaves, strict=True):
        yield from _of(f"{name}: " if len(names) > 1 else "", _look(system, folder, name, slave))
    port = next((one.beacon_port for one in given), options.beacon_port)
    yield from check_master(system, folder, options.master, port)


def _look(
    system: System, folder: Path, name: str, slave: "argparse.Namespace | Finding"
) -> Iterator[Finding]:
    """The checks of one slave."""
    unit = check_unit(system, name)
    yield unit.finding
    yield from check_keys(system, folder, name)
    if isinstance(slave, Finding):
        yield slave
        return
    yield from check_devices(system, slave)
    if slave.camera is not None:
        yield from check_camera(slave, unit.runs)
    else:
        sensor = "IMU" if slave.imu is not None else "tracker"
        yield unseen("device", f"{sensor}: the service reports whether it answers")


def _slave(options: argparse.Namespace, system: System, name: str) -> "argparse.Namespace | Finding":
    """Return the options of a slave.

    They are those of its service, each replaced by the doctor's own option where given.
    """
    given = [
        word
        for option in ("rig", "camera", "calibration")
        if (value := getattr(options, option)) is not None
        for word in (f"--{option}", str(value))
    ]
    text = system.text(f"{ETC}/{name}.env")
    if text is None:
        if options.camera is None:
            return unseen("camera", f"no {ETC}/{name}.env: give --camera, and --rig, --calibration")
        return _parsed(["--name", name, *given], name)
    stated = pairs(text)
    try:
        words = shlex.split(stated.get("PHALANX_OPTIONS", ""))
    except ValueError as error:
        return fail(
            "options", f"{ETC}/{name}.env: PHALANX_OPTIONS: {error}", "phalanx fleet deploy writes it again"
        )
    return _parsed([*words, *(given if "--camera" in words else [])], name)


def _parsed(words: Sequence[str], name: str) -> "argparse.Namespace | Finding":
    try:
        return PROGRAM.parse(["run", *words])[1]
    except SystemExit as error:
        parser_exit = 2
        if error.code == parser_exit:
            return fail(
                "options", f"of {name}: see the line above", f"{ETC}/{name}.env: phalanx-slave run --help"
            )
        raise


def _extras(slave: argparse.Namespace) -> Iterator[str]:
    """Libraries that only this slave needs."""
    if str(getattr(slave, "camera", "")).partition(":")[0] == "picamera2":
        yield "picamera2"
    if str(getattr(slave, "lights", "")).startswith("gpio:"):
        yield "gpiod"
    if "i2c:" in str(getattr(slave, "lights", "")) or "lsm6dsox" in str(getattr(slave, "imu", "")):
        yield "smbus2"
    if "ximu3" in str(getattr(slave, "imu", "")):
        yield "serial"
    if getattr(slave, "engine", "") == "numba":
        yield "numba"


def _of(prefix: str, findings: Iterator[Finding]) -> Iterator[Finding]:
    for one in findings:
        yield Finding(prefix + one.check, one.verdict, one.text, one.fix)
