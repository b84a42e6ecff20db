"""`phalanx-slave imu`: sends what an IMU measures, or takes in a recording of one."""

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from common.clock import SystemClock
from common.errors import CalibrationError
from common.imu_csv_columns import ACCEL, GYRO, MAG, TIME, UNITS
from slave import devices
from slave.commands.device_options import add_imu_options
from slave.commands.options import (
    add_link,
    add_place,
    add_simulated,
    clock_of,
    epoch_of,
    positive,
    rig_of,
    secrets_of,
    world_of,
)
from slave.service import Service
from slave.stopping import stop_by_signal

if TYPE_CHECKING:
    from slave.sources import ImuSource

PURPOSE = "send what an IMU measures"
EXAMPLES = """\
  phalanx-slave imu --name imu --rig wrist --imu synthetic --bind 127.0.0.1 --key-file rig.key
        waits for the master's start, then sends one sealed datagram per sample: that of the simulated hand; with
        cameras in other processes, all with the same --scene, --seed and --scene-epoch-ns
  phalanx-slave imu --list
        says which serial ports and I2C buses there are, then ends
  phalanx-slave imu --name imu --rig wrist --imu ximu3:/dev/serial/by-id/PORT --key-file rig.key
        an x-IMU3 on USB; on the pins of a Pi: ximu3:/dev/serial0@115200; docs/imu.md says what is set and checked
  phalanx-slave imu --name imu --rig wrist --imu lsm6dsox:1:0x6a --key-file rig.key
        an LSM6DSOX on I2C bus 1 of a Pi
  phalanx-slave imu --csv walk.csv --gyro-unit deg/s --out recordings/walk
        reads a CSV with a header (docs/imu.md), says its rate, gaps, bias and orientation, and writes imu.csv;
        against a quaternion in it, how right the tilt is. No device, no master
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """The options of `imu`."""
    add_place(command, "IMU of this slave, that of the rig (default: imu)", default="imu")
    add_imu_options(command)
    _add_csv(command.add_argument_group("a recording (--csv)").add_argument)
    add_link(command)
    add_simulated(command.add_argument_group("synthetic IMU").add_argument)


def _add_csv(add: Callable[..., argparse.Action]) -> None:
    add(
        "--out",
        "-o",
        type=Path,
        metavar="FOLDER",
        help="where its imu.csv goes (default: it is only looked at)",
    )
    for what in (TIME, GYRO, ACCEL, MAG):
        text = f"unit of {what} where the header does not say it"
        add(f"--{what}-unit", choices=tuple(UNITS[what]), help=text)
    add(
        "--rate-hz",
        type=positive,
        metavar="HZ",
        help="samples per second of a table without a column of time",
    )


def run(options: argparse.Namespace, notify: Callable[[str], None]) -> int:
    """Send samples until it is told to end, or take in a recording.

    Raises:
        PhalanxError: A file, the IMU, a key or the network is not as it must be.
    """
    if options.csv is not None:
        return _take_in(options, notify)
    from slave.sender import Sender, send_imu
    from slave.simulated import SyntheticSensor, imu_of
    from slave.uplink import Uplink

    rig = rig_of(options)
    if rig.imu is None or options.name != rig.imu.name:
        has = "it has none" if rig.imu is None else f"its IMU is {rig.imu.name!r}"
        raise CalibrationError(f"rig {rig.name!r} has no IMU {options.name!r}; {has}")
    orientation = devices.orientation_of(rig.imu)
    true_clock = SystemClock()
    clock = clock_of(options, true_clock)
    key, access = secrets_of(options)

    def tell(line: str) -> None:
        notify(f"{options.name}: {line}")

    service = Service(os.environ, noun="samples")
    with stop_by_signal() as stop:
        if options.imu == "synthetic":
            epoch_ns = epoch_of(options, true_clock)
            imu = imu_of(options.imu, *world_of(options, rig), options.scene, options.seed)
            source: ImuSource = SyntheticSensor(imu.sample, imu.rate_hz, epoch_ns, clock, stop)
        else:
            source = devices.open_imu(
                options.name, options.imu, rig.imu.rate_hz, clock, stop, service.connection_lost
            )
        uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)
        sender = Sender(options.name, uplink, clock, stop, tell, service, access)
        send_imu(sender, source, orientation)
    return 0


def _take_in(options: argparse.Namespace, notify: Callable[[str], None]) -> int:
    from common.imu_csv import read_csv
    from slave.imu.importing import import_table

    units = {what: unit for what in (TIME, GYRO, ACCEL, MAG) if (unit := getattr(options, f"{what}_unit"))}
    import_table(read_csv(options.csv, units, options.rate_hz), options.name, options.out, notify)
    return 0
