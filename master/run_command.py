"""`phalanx-master run`: track live until Ctrl-C."""

import os
from pathlib import Path
from typing import Annotated

import typer

from common.certificates import MASTER
from common.datagram import Address
from common.endpoints import check, encrypted, port_of
from common.errors import BusError
from common.keys import access_of, link_key
from master.estimator.settings import Settings
from master.live import LiveSettings, run_live
from master.options import (
    CALIB_JSON,
    HERE_BEACON,
    HERE_BIND,
    HERE_BUS,
    Beacon,
    Bind,
    BusEnd,
    Calibration,
    Hand,
    KeyFile,
    Rigs,
    address,
)
from master.rig import RigFiles
from master.stopping import stop_on_signals
from master.terminal import print_line


def run(
    rig: Rigs,
    calibration: Calibration = CALIB_JSON,
    hand: Hand = None,
    beacon: Beacon = HERE_BEACON,
    bind: Bind = HERE_BIND,
    bus: BusEnd = HERE_BUS,
    key_file: KeyFile = None,
    start_timeout_s: Annotated[
        float, typer.Option(help="How long the first camera waits for the others.")
    ] = 5.0,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Write every pose to this .npz; of a second hand beside it, with its name, and in the same folder"
            " object_NAME.npz, contact_HAND_NAME.npz and gestures.jsonl."
        ),
    ] = None,
    summary: Annotated[Path | None, typer.Option(help="Write the figures of the run to this .json.")] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="Record all that is taken and told to this .mcap, from the first message on: `play` solves it again,"
            " bit for bit."
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Try another number of the estimator, estimator.NAME=VALUE, such as estimator.tracked_m=0.015; a wrong"
            " name lists all.",
        ),
    ] = None,
) -> None:
    """Track live until Ctrl-C; hands, objects, contact and gestures go to the bus (phalanx/hand/<name>, .../object/...)
    and, if asked, to files.

    Several rigs of one hand are one hand: cameras that watch its markers and the device on its wrist are solved
    together. Rigs of two hands are two hands, each published under its own name. The files of rigs, cameras, hands,
    objects and gestures are followed: what changes there is used at once.

    Examples:

      phalanx-master run --rig desk

      phalanx-master run --rig desk --rig wrist

      phalanx-master run --rig desk --rig wrist-left

      phalanx-master run --rig desk-wand --poses out/poses.npz

      phalanx-master run --rig desk --record out/wave.mcap

      phalanx-master run --rig desk --keys DIR --beacon 192.168.1.255:47800 --bind 0.0.0.0:47801 --bus tls/0.0.0.0:47802
    """
    files = RigFiles(calibration, tuple(rig), hand, Settings.of(changes or []))
    setups = files.load()
    settings = LiveSettings(
        *checked_ends(beacon, bind, bus),
        bus,
        start_timeout_s,
        poses,
        summary,
        files,
        record,
    )
    run_live(setups, link_key(os.environ, key_file), settings, stop_on_signals(), print_line)


def checked_ends(beacon: str, bind: str, bus: str) -> tuple[Address, Address]:
    """Where the beacon goes and where datagrams come; the bus is checked as well.

    Raises:
        PhalanxError: One of them is malformed; the bus would leave the machine as plain text, or its keys are missing.
    """
    addresses = address(beacon, "--beacon"), address(bind, "--bind")
    access = access_of(os.environ, MASTER)
    check(bus, access.open)
    if port_of(bus) == 0:
        raise BusError(f"--bus {bus!r}: expected a port at its end, for example tls/0.0.0.0:47802")
    if encrypted(bus):
        access.identity()
    return addresses
