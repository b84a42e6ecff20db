"""Options that several commands have, and what they name: numbers, files of calib_json, clocks, keys."""

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from common.calibration import CameraCalibration, RigCalibration, load
from common.clock import Clock, SkewedClock
from common.errors import CalibrationError
from common.object_profile import ObjectProfile

if TYPE_CHECKING:
    from common.keys import Access
    from common.link_key import LinkKey

BEACON_PORT = 47800
BOTH = "grasp | both-poses | both-curl | both-travel | both-moves | gestures"  # the same motion for both kinds of rig


def add_place(command: argparse.ArgumentParser, who: str, default: str | None = None) -> None:
    """Who this slave is, and whose; without a default it has to be said."""
    command.add_argument("--name", required=default is None, default=default, help=who)
    add_rig(command)


def add_rig(command: argparse.ArgumentParser, default: str = "desk", with_key: str = "") -> None:
    """Which rig, and where its files are; `with_key` says what its file must have."""
    text = f"rig, a file in DIR/rigs{with_key} (default: %(default)s)"
    command.add_argument("--rig", default=default, help=text)
    command.add_argument("--calibration", type=Path, default=Path("calib_json"), metavar="DIR")


def add_link(command: argparse.ArgumentParser) -> None:
    """How it finds its master."""
    command.add_argument(
        "--beacon-port", type=port, default=BEACON_PORT, metavar="PORT", help="default: %(default)s"
    )
    command.add_argument(
        "--bind", default="0.0.0.0", metavar="ADDRESS", help="own address (default: every network)"
    )
    command.add_argument(
        "--keys",
        type=Path,
        metavar="DIR",
        help="keys folder of this device: rig key and certificate (docs/keys.md); default: environment PHALANX_KEYS",
    )
    command.add_argument(
        "--key-file", type=Path, metavar="FILE", help="rig key alone; default: environment PHALANX_RIG_KEY"
    )
    command.add_argument(
        "--open",
        action="store_true",
        help="join the bus of a master that is not encrypted: only in a closed laboratory; also PHALANX_OPEN=1",
    )


def add_simulated(add: Callable[..., argparse.Action]) -> None:
    """Which scene a simulated sensor senses, and by what clock."""
    add(
        "--scene",
        default="standard",
        metavar="NAME",
        help=f"standard | lights | poses | hand-routine | object | leap:FILE.npz | {BOTH} | board | card; before a "
        f"wrist device standard | curl | subject | poses | spread | random | {BOTH}, each with @dark | @indoor | "
        "@bright | @sun, or board",
    )
    add("--seed", type=int, default=7)
    add(
        "--truth",
        type=Path,
        metavar="DIR",
        help="calib_json tree that says how the simulated world is: lenses, places, paints, hand; this slave goes on "
        "believing --calibration, where they may be unknown (default: it believes the truth)",
    )
    add("--truth-rig", metavar="NAME", help="the rig in it, a file in DIR/rigs (default: of the same name)")
    add("--scene-epoch-ns", type=int, metavar="N", help="CLOCK_MONOTONIC at scene time 0; default: now")
    add("--clock-offset-ms", type=number, default=0.0, metavar="X", help="this machine's clock is ahead")
    add("--clock-ppm", type=number, default=0.0, metavar="Y", help="and gains on the true one")


def positive(text: str) -> float:
    """A number above 0."""
    value = number(text)
    if not 0.0 < value:
        raise argparse.ArgumentTypeError(f"{text}: must be positive")
    return value


def port(text: str) -> int:
    """A port of UDP."""
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise argparse.ArgumentTypeError(f"{text}: must be a port, 1 to 65535")
    return int(text)


def count(text: str) -> int:
    """A whole number from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number, at least 1")
    return int(text)


def megabytes(text: str) -> float:
    """A number from 0 on."""
    value = number(text)
    if not 0.0 <= value:
        raise argparse.ArgumentTypeError(f"{text}: must not be negative")
    return value


def number(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError as error:  # argparse would tell the name of the function
        raise argparse.ArgumentTypeError(f"{text}: must be a number") from error
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text}: must be a finite number")
    return value


def rig_of(options: argparse.Namespace) -> RigCalibration:
    """The rig.

    Raises:
        CalibrationError: Its file is missing or broken.
    """
    return load(rig_path(options), RigCalibration)


def camera_of(options: argparse.Namespace) -> tuple[RigCalibration, CameraCalibration]:
    """The rig, and the camera of this slave.

    Raises:
        CalibrationError: It is none of the rig, or a file is missing or broken.
    """
    rig = rig_of(options)
    if options.name not in rig.cameras:
        raise CalibrationError(
            f"rig {rig.name!r} has no camera {options.name!r}; it has {', '.join(rig.cameras)}"
        )
    return rig, load(camera_path(options, options.name), CameraCalibration)


def objects_of(options: argparse.Namespace, rig: RigCalibration) -> dict[str, ObjectProfile]:
    """The objects of the rig, by name.

    Raises:
        CalibrationError: A file is missing or broken.
    """
    return {
        name: load(options.calibration / "objects" / f"{name}.json", ObjectProfile) for name in rig.objects
    }


def rig_path(options: argparse.Namespace) -> Path:
    """The rig file."""
    return options.calibration / "rigs" / f"{options.rig}.json"


def camera_path(options: argparse.Namespace, camera: str) -> Path:
    """The file of a camera."""
    return options.calibration / "cameras" / f"{camera}.json"


def world_of(options: argparse.Namespace, rig: RigCalibration) -> tuple[Path, RigCalibration]:
    """Folder and rig of the files that say how the simulated world is.

    Raises:
        CalibrationError: As `slave.simulated.world_of`.
    """
    from slave.simulated import world_of as world

    return world(options.calibration, rig, options.truth, options.truth_rig)


def epoch_of(options: argparse.Namespace, true_clock: Clock) -> int:
    """Scene time 0 on the true clock [ns]."""
    return true_clock.now_ns() if options.scene_epoch_ns is None else options.scene_epoch_ns


def clock_of(options: argparse.Namespace, true_clock: Clock) -> SkewedClock:
    """The slave's clock, which a simulated machine may have ahead of the true one."""
    return SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)


def skew_of(options: argparse.Namespace, true_clock: Clock) -> str:
    """How the slave's clock differs from the machine's, for whoever compares two recordings; empty: not at all."""
    skewed = f" {options.clock_offset_ms:+g} ms" if options.clock_offset_ms else ""
    return skewed + (f" {options.clock_ppm:+g} ppm from {true_clock.now_ns()}" if options.clock_ppm else "")


def secrets_of(options: argparse.Namespace) -> "tuple[LinkKey, Access]":
    """What this device seals its datagrams by, and how it comes to the bus.

    Raises:
        PhalanxError: There is no rig key, or the keys folder has no certificate or no secret of this device.
    """
    from common.keys import access_of, link_key

    access = access_of(os.environ, options.name, options.keys, options.open)
    if access.folder is not None:
        access.identity()  # said now, not when a master is heard
    return link_key(os.environ, options.key_file, options.keys, options.name), access
