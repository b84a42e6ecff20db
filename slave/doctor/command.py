"""Run `phalanx-slave doctor`: every check of each slave, or test of its lights."""

import argparse
import shlex
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.strobe import Limit, StrobeCalibration, limits_of
from common.clock import SystemClock
from common.command_line import WRONG_USAGE, UsageError, echo
from common.errors import LightsError
from common.machine import program
from common.recording.frame_recording import Illumination
from slave.cli.table import PROGRAM
from slave.commands.devices import camera_path, imu_places, open_lights, rig_of
from slave.doctor.devices import cameras_of, check_camera, check_devices, check_groups
from slave.doctor.host import (
    Finding,
    System,
    as_json,
    as_text,
    check_clock,
    check_host,
    check_programs,
    check_strobe,
    check_unit,
    exit_code,
    fail,
    pairs,
    unseen,
)
from slave.doctor.master import check_keys, check_master, folder_of
from slave.drivers import SWITCHED_LIGHTS
from slave.lights.controller import CYCLE
from slave.lights.interlock import Interlock
from slave.lights.strobed import check_pulses, schedule_of
from slave.service import stop_by_signal

SHOWN = {"J": (1e6, "uJ"), "W": (1e3, "mW"), "W/m2/sr": (1e-3, "kW/m2/sr")}


def budget(rig: RigCalibration, camera: CameraCalibration) -> str:
    """Pulse, duty, power and every limit with its share, as lines."""
    check_pulses(rig, camera)
    strobe, laser = rig.strobe, rig.laser
    assert strobe is not None
    assert laser is not None
    assert laser.fan_rad is not None  # the file was checked
    period_s = len(CYCLE) / camera.frame_rate_hz
    pulse_s = schedule_of(rig, camera).length_ns * 1e-9
    duty = pulse_s / period_s
    limits = limits_of(strobe, laser.fan_rad)
    return "\n".join(
        [
            f"rig {rig.name}, camera {camera.name}: {1.0 / period_s:.1f} cycles/s, exposure {camera.exposure_us:g} us",
            f"  each light  pulse {pulse_s * 1e6:.0f} us (at most {strobe.max_pulse_us:g})",
            f"              duty {duty:.3f} (at most {strobe.max_duty:g} of any second)",
            *_powers(strobe, duty),
            "",
            "at the longest pulse and the highest duty that the rig file allows:",
            *_table([limit for limit in limits if not limit.fault]),
            "",
            "after a fault that leaves a light on:",
            *_table([limit for limit in limits if limit.fault]),
            "",
            "Calculated from the numbers of the rig file; this is no certificate (docs/safety.md).",
        ]
    )


def blink(
    interlock: Interlock,
    rig: RigCalibration,
    camera: CameraCalibration,
    stop: threading.Event,
    seconds: float,
) -> int:
    """Switch laser and LEDs in turn, as before the camera; the number of pulses."""
    clock = SystemClock()
    length_ns = schedule_of(rig, camera).length_ns
    period_ns = round(1e9 / camera.frame_rate_hz)
    next_ns = clock.now_ns()
    end_ns = next_ns + round(seconds * 1e9)
    frame = 0
    while next_ns < end_ns and not stop.is_set():
        lit = CYCLE[frame % len(CYCLE)]
        if lit is not Illumination.AMBIENT and interlock.begin(lit, length_ns):
            stop.wait(length_ns * 1e-9)
            interlock.end()
        frame, next_ns = frame + 1, max(next_ns + period_ns, clock.now_ns())
        stop.wait((next_ns - clock.now_ns()) * 1e-9)
    if interlock.counts["pulses"] == 0 and not stop.is_set():
        raise LightsError("no pulse was allowed: the limits of the rig file refuse them all")
    return interlock.counts["pulses"]


def _powers(strobe: StrobeCalibration, duty: float) -> list[str]:
    laser, led = strobe.laser, strobe.led
    on_mw, mean_mw = laser.power_w * 1e3, laser.power_w * duty * 1e3
    sr_mw, mean_sr_mw = led.intensity_w_sr * 1e3, led.intensity_w_sr * duty * 1e3
    draws = [watts * duty * 1e3 for watts in (laser.electrical_w, led.electrical_w)]
    others_mw, most_mw = strobe.others_w * 1e3, strobe.max_electrical_w * 1e3
    return [
        f"  laser       {on_mw:.3g} mW of light at {laser.wavelength_nm:g} nm while on, {mean_mw:.3g} mW in the mean",
        f"  {led.count} LEDs      {sr_mw:.3g} mW/sr each at {led.wavelength_nm:g} nm, {mean_sr_mw:.3g} in the mean",
        f"  supply      laser {draws[0]:.3g} + LEDs {draws[1]:.3g} + camera and IMU {others_mw:.3g} mW in the mean",
        f"              together {sum(draws) + others_mw:.3g} mW (at most {most_mw:g})",
    ]


def _table(limits: list[Limit]) -> list[str]:
    wide = max(len(limit.name) for limit in limits)
    lines: list[str] = []
    for limit in limits:
        scale, unit = SHOWN.get(limit.unit, (1.0, limit.unit))
        value, bound = scale * limit.value, scale * limit.bound
        lines.append(
            f"  {limit.name:<{wide}}  {value:8.3g} of {bound:8.3g} {unit:<8}{100.0 * limit.share:5.1f} %"
            f"  {limit.source}"
        )
    return lines


def look_at_lights(options: argparse.Namespace) -> int:
    """Print the budget; switch lights only where that is asked for."""
    rig = rig_of(options, "wrist")
    camera = load(camera_path(options, rig.cameras[0]), CameraCalibration)
    if not (options.blink or options.off):
        echo(budget(rig, camera))
        return 0
    if not options.lights:
        raise LightsError(f"--blink and --off need the lights: --lights {SWITCHED_LIGHTS}")
    with stop_by_signal() as stop:
        interlock = open_lights(options.lights, rig)  # dark from here on
        try:
            if options.blink:
                echo(budget(rig, camera))
                blink(interlock, rig, camera, stop, options.blink)
        finally:
            interlock.close()
    events = ", ".join(f"{event} {count}" for event, count in interlock.events().items())
    echo(events if options.blink else "dark")
    return 0


ETC = "/etc/phalanx"


def run(options: argparse.Namespace) -> int:
    """Check and report, or list ports, or look at the lights; the exit code."""
    if options.ports:
        echo(imu_places())
        return 0
    if options.lights is not None:
        return look_at_lights(options)
    if options.blink or options.off:
        raise UsageError(f"--blink and --off need the lights: --lights {SWITCHED_LIGHTS}")
    findings = list(examine(options, System.here()))
    echo(as_json(findings, program()) if options.json else as_text(findings))
    return exit_code(findings)


def examine(options: argparse.Namespace, system: System) -> Iterator[Finding]:
    """All findings: the machine, then each slave."""
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
        prefix = f"{name}: " if len(names) > 1 else ""
        for one in _look(system, folder, name, slave):
            yield replace(one, check=prefix + one.check)
    port = next((one.beacon_port for one in given), options.beacon_port)
    yield from check_master(system, folder, options.master, port)


def _look(
    system: System, folder: Path, name: str, slave: "argparse.Namespace | Finding"
) -> Iterator[Finding]:
    service, runs = check_unit(system, name)
    yield service
    yield from check_keys(system, folder, name)
    if isinstance(slave, Finding):
        yield slave
        return
    yield from check_devices(system, slave)
    if str(slave.lights).partition(":")[0] in ("gpio", "i2c"):
        yield check_strobe(system, name)
    if slave.camera is not None:
        yield from check_camera(slave, runs)
    else:
        sensor = "IMU" if slave.imu is not None else "tracker"
        yield unseen("device", f"{sensor}: the service reports whether it answers")


def _slave(options: argparse.Namespace, system: System, name: str) -> "argparse.Namespace | Finding":
    """Options of a slave's service, replaced by the doctor's own where given."""
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
        if error.code != WRONG_USAGE:
            raise
        fix = f"{ETC}/{name}.env: phalanx-slave run --help"
        return fail("options", f"of {name}: see the line above", fix)


def _extras(slave: argparse.Namespace) -> Iterator[str]:
    camera, imu, lights = (
        str(value or "").partition(":")[0] for value in (slave.camera, slave.imu, slave.lights)
    )
    if camera == "picamera2":
        yield "picamera2"
    if lights == "gpio":
        yield "gpiod"
    if lights == "i2c" or imu == "lsm6dsox":
        yield "smbus2"
    if imu == "ximu3":
        yield "serial"
    if slave.engine == "numba":
        yield "numba"
