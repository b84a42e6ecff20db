"""`phalanx-slave run --imu` and `record --imu-csv`.

The first sends what an IMU measures, the second imports a table of IMU samples.
"""

import argparse
import os
from typing import TYPE_CHECKING

from common.clock import SystemClock
from common.errors import CalibrationError
from common.imu.csv_columns import ACCEL, GYRO, MAG, TIME
from common.terminal import echo
from slave import devices
from slave.commands.options import clock_of, epoch_of, rig_of, secrets_of, world_of
from slave.service import Service
from slave.stopping import stop_by_signal

if TYPE_CHECKING:
    from slave.sources import ImuSource

USUAL_NAME = "imu"


def send_imu(options: argparse.Namespace) -> int:
    """Send samples until stopped.

    Raises:
        PhalanxError: A file, the IMU, a key or the network is not as it must be.
    """
    from slave.sender import Sender, send_samples
    from slave.simulated import SyntheticSensor, imu_of
    from slave.uplink import Uplink

    rig = rig_of(options)
    if options.name is None:
        options.name = USUAL_NAME if rig.imu is None else rig.imu.name
    if rig.imu is None or options.name != rig.imu.name:
        has = "it has none" if rig.imu is None else f"its IMU is {rig.imu.name!r}"
        raise CalibrationError(f"rig {rig.name!r} has no IMU {options.name!r}; {has}")
    orientation = devices.orientation_of(rig.imu)
    true_clock = SystemClock()
    clock = clock_of(options, true_clock)
    key, access = secrets_of(options)

    def print_line(line: str) -> None:
        echo(f"{options.name}: {line}")

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
        sender = Sender(options.name, uplink, clock, stop, print_line, service, access)
        send_samples(sender, source, orientation)
    return 0


def import_table_of_imu(options: argparse.Namespace) -> int:
    """Notify what is in the table of an IMU, and write imu.csv if a folder is given.

    Raises:
        PhalanxError: It is missing or broken.
    """
    from common.imu.csv_table import read_csv
    from slave.imu.importing import import_table

    units = {what: unit for what in (TIME, GYRO, ACCEL, MAG) if (unit := getattr(options, f"{what}_unit"))}
    table = read_csv(options.imu_csv, units, options.rate_hz)
    import_table(table, options.name or USUAL_NAME, options.output, echo)
    return 0
