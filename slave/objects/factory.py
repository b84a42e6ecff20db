"""The trackers behind `--device`: what they are called, and how they are opened, and opened again."""

import argparse
import threading
from collections.abc import Callable
from pathlib import Path

from common.calibration import RigCalibration, load
from common.clock import Clock
from common.errors import CalibrationError, TrackerError
from common.object_profile import ObjectProfile
from slave.objects.reconnecting import ReconnectingTracker
from slave.service import ConnectionLost, nobody
from slave.sources import TrackerSource

REAL = "openvr | survive | survive:FILE"
DEVICES = f"{REAL} | synthetic"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a tracker that is sent live."""
    parser.add_argument("--device", required=True, metavar="SYSTEM", help=DEVICES)
    parser.add_argument(
        "--serial",
        metavar="SERIAL",
        help="which device: its serial number (LHR-...), for survive also its name there (WM0, T20); not needed if "
        "there is one only",
    )
    parser.add_argument(
        "--program", default="survive-cli", metavar="PATH", help="survive-cli (default: that on the path)"
    )


def object_with(calibration: Path, rig: RigCalibration, name: str) -> ObjectProfile:
    """The object of a rig on which the tracker `name` sits.

    Raises:
        CalibrationError: There is none; a file is missing or broken.
    """
    profiles = [load(calibration / "objects" / f"{one}.json", ObjectProfile) for one in rig.objects]
    for profile in profiles:
        if profile.tracker == name:
            return profile
    there = ", ".join(f"{one.tracker!r} on {one.name}" for one in profiles if one.tracker is not None)
    raise CalibrationError(
        f"rig {rig.name!r}: no object has the tracker {name!r}; there is {there or 'none'}: name it under `tracker` of "
        "calib_json/objects/OBJECT.json, and the object under `objects` of the rig"
    )


def open_real(
    name: str,
    device: str,
    serial: str | None,
    program: str,
    clock: Clock,
    stop: threading.Event,
    connection_lost: ConnectionLost = nobody,
) -> TrackerSource:
    """Open the tracker that `--device` names; one that is no recording is opened again when it was lost.

    Args:
        name: Of the device in our messages.
        device: The value of `--device`.
        serial: Which device, if there are several.
        program: survive-cli.
        clock: The slave's clock.
        stop: Set when the slave is to end.
        away: Told when it is lost.

    Raises:
        TrackerError: There is no such system, or it cannot be opened.
    """
    kind, colon, path = device.partition(":")
    opener: Callable[[], TrackerSource]
    if kind == "survive" and path:
        from slave.objects.survive import SurviveFile

        return SurviveFile(name, serial, Path(path), clock, stop)
    if kind == "survive" and not colon:
        from slave.objects.survive import SurviveTracker

        opener = lambda: SurviveTracker(name, serial, clock, stop, program)  # noqa: E731
    elif device == "openvr":
        from slave.objects.openvr_tracker import OpenVrTracker

        opener = lambda: OpenVrTracker(name, serial, clock, stop)  # noqa: E731
    else:
        raise TrackerError(f"--device {device}: no such system; there are {DEVICES}")
    return ReconnectingTracker(name, opener, clock, stop, connection_lost)
