"""Options of the commands that name a device."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from slave.devices import imu_places
from slave.drivers import IMUS, TRACKERS


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the real cameras."""
    parser.add_argument(
        "--luma",
        action="store_true",
        help="wrist device with a colour camera (without infrared filter): its luma in place of grey frames of a "
        "monochrome sensor; it is not linear in the light",
    )
    pi = parser.add_argument_group("Pi camera (picamera2)")
    pi.add_argument(
        "--sync",
        choices=("off", "server", "client"),
        default="off",
        help="frames in step with other Pi cameras: one leads, the others follow; start clients first",
    )
    pi.add_argument(
        "--sync-timeout",
        type=float,
        default=60.0,
        metavar="S",
        help="how long to wait for them (default: %(default)s)",
    )
    usb = parser.add_argument_group("USB camera (v4l2)")
    usb.add_argument(
        "--control",
        action="append",
        default=[],
        metavar="NAME=N",
        help="fix a control in codes of its maker, for example gain=32; may be repeated",
    )
    usb.add_argument(
        "--allow-missing",
        action="append",
        default=[],
        metavar="NAME",
        help="exposure | gain | white_balance: the camera lacks this control, and that is known; may be repeated",
    )


class ListPlaces(argparse.Action):
    """The option that says where an IMU may be, and ends."""

    def __init__(self, option_strings: Sequence[str], dest: str, **others: Any) -> None:
        """Take no value."""
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, **others)

    def __call__(self, parser: argparse.ArgumentParser, *_others: object) -> None:
        """Notify it."""
        sys.stdout.write(imu_places() + "\n")
        parser.exit()


def add_imu_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that name an IMU, live or recorded."""
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--imu", metavar="DRIVER", help=IMUS)
    which.add_argument(
        "--csv", type=Path, metavar="FILE", help="a recording: a CSV with a header, time, rates, forces"
    )
    parser.add_argument("--list", action=ListPlaces, help="say where an IMU may be connected, and end")


def add_tracker_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a tracker that is sent live."""
    parser.add_argument("--device", required=True, metavar="SYSTEM", help=TRACKERS)
    parser.add_argument(
        "--serial",
        metavar="SERIAL",
        help="which device: its serial number (LHR-...), for survive also its name there (WM0, T20); not needed if "
        "there is one only",
    )
    parser.add_argument(
        "--program", default="survive-cli", metavar="PATH", help="survive-cli (default: that on the path)"
    )
