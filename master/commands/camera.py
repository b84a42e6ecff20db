"""`phalanx camera` shows and changes the settings of a running camera."""

import time
from argparse import Namespace
from contextlib import closing
from pathlib import Path

import msgspec

from common.bus.bus import Bus
from common.calibration import CameraCalibration, load
from common.calibration.camera_settings import ROI_LEAST, ROI_MOST, WANTED, CameraSettings, ColourPick
from common.command_line import echo
from common.errors import BusError, CalibrationError, PhalanxError
from common.messages import Command, Health
from common.messages.streams import MASTER
from master.run.process import join_bus

# 60 frames of a slow camera until it shows its settings, as many to go back, and a colour table.
ANSWER_S = 15.0
APPEAR_S = 4.0  # whoever has just connected is not known everywhere yet
_ALSO = ("digital_gain", "focus_dioptres", "sensor_celsius", "sync_locked", "sync_error_us", "roi_margin")
_MORE = ("control.", "marker.", "pick.")
_EVENTS = ("camera.", "reload.")


def camera(options: Namespace) -> None:
    """Show or change a running camera's settings at once, read back and compared."""
    wanted = settings(
        options.exposure_us, options.gain, options.colour_gains, options.rate_hz, options.roi_margin
    )
    steps = commands(options.name, wanted, options.pick, options.load_file, options.save)
    with closing(join_bus(options.bus)) as bus:
        health = send_all(bus, steps)
    echo("\n".join(table(health)))


def settings(
    exposure_us: float | None = None,
    gain: float | None = None,
    colour_gains: str | None = None,
    rate_hz: float | None = None,
    roi_margin: float | None = None,
) -> CameraSettings:
    """What the options ask to be set.

    Raises:
        PhalanxError: A value is none.
    """
    if roi_margin is not None and not ROI_LEAST <= roi_margin <= ROI_MOST:
        raise PhalanxError(f"--roi-margin {roi_margin:g}: must be from {ROI_LEAST:g} to {ROI_MOST:g}")
    return CameraSettings(
        exposure_us=_positive(exposure_us, "--exposure-us"),
        analogue_gain=_positive(gain, "--gain"),
        colour_gains=_pair(colour_gains),
        frame_rate_hz=_positive(rate_hz, "--rate-hz"),
        roi_margin=roi_margin,
    )


def commands(
    name: str,
    wanted: CameraSettings,
    pick: str | None = None,
    load_file: Path | None = None,
    save: bool = False,
) -> list[Command]:
    """Return the commands to the slave; the last answer is how the camera is set.

    Raises:
        CalibrationError: The file is broken or of another camera.
        PhalanxError: The pick is none.
    """
    steps: list[Command] = []
    if load_file is not None:
        file = load(load_file, CameraCalibration)
        if file.name != name:
            raise CalibrationError(
                f"{load_file}: name: it is the file of camera {file.name!r}, not of {name!r}"
            )
        steps.append(Command(name, "load", msgspec.json.encode(file).decode()))
    if wanted != CameraSettings():
        steps.append(Command(name, "set", msgspec.json.encode(wanted).decode()))
    if pick is not None:
        steps.append(Command(name, "pick", msgspec.json.encode(_pick(pick)).decode()))
    if save:
        steps.append(Command(name, "save"))
    return steps or [Command(name, "settings")]


def send_all(bus: Bus, steps: list[Command]) -> Health:
    """Ask one after the other; the last answer.

    Raises:
        BusError: No such camera is on the bus, or it refused; what was set before stays.
    """
    _appear(bus, steps[0].target)
    return [bus.ask(step, ANSWER_S) for step in steps][-1]


def table(health: Health) -> list[str]:
    """Format each setting, wanted and read back, and what else the camera reports."""
    rows = [("setting", "wanted", "read back")]
    for metric, value in health.metrics.items():
        if metric.startswith(WANTED):
            setting = metric.removeprefix(WANTED)
            got = health.metrics.get(setting)
            rows.append((setting, f"{value:.6g}", "-" if got is None else f"{got:.6g}"))
    also = [metric for metric in health.metrics if metric in _ALSO or metric.startswith(_MORE)]
    rows += [(metric, "", f"{health.metrics[metric]:.6g}") for metric in also]
    rows += [(event, "", str(n)) for event, n in health.counts.items() if event.startswith(_EVENTS)]
    return [f"{name:<22} {wanted:>10} {got:>10}".rstrip() for name, wanted, got in rows]


def _appear(bus: Bus, name: str) -> None:
    """Wait a moment for the camera; else a BusError names those that are there."""
    step_s = 0.1
    for _ in range(round(APPEAR_S / step_s)):
        if name in bus.alive():
            return
        time.sleep(step_s)
    there = ", ".join(sorted(bus.alive() - {MASTER})) or "none"
    raise BusError(
        f"no camera {name!r} is on the bus; there are: {there}. Is its slave running, and named so?"
    )


def _positive(value: float | None, option: str) -> float | None:
    most = 1e9
    if value is not None and not 0.0 < value <= most:
        raise PhalanxError(f"{option} {value:g}: must be positive and at most {most:g}")
    return value


def _pick(text: str) -> ColourPick:
    marker, _, place = text.rpartition("@")
    try:
        u, v = (float(part) for part in place.split(","))
        return msgspec.convert({"marker": marker, "uv": (u, v)}, ColourPick)
    except (ValueError, msgspec.ValidationError) as error:
        raise PhalanxError(f"--pick {text}: write MARKER@U,V, for example index@310,204") from error


def _pair(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        red, blue = (float(part) for part in text.split(","))
    except ValueError as error:
        raise PhalanxError(f"--colour-gains {text}: write RED,BLUE, for example 1.1,1.6") from error
    for value in (red, blue):
        _positive(value, "--colour-gains")
    return red, blue
