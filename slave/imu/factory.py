"""The IMUs behind `--imu`: what they are called, and how they are opened, and opened again."""

import argparse
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from common.calibration import ImuCalibration
from common.clock import Clock
from common.errors import CalibrationError, ImuError
from common.imu_fusion import OrientationFilter
from slave.imu.reconnecting import ReconnectingImu
from slave.service import ConnectionLost, nobody
from slave.sources import ImuSource

if TYPE_CHECKING:  # the drivers are imported where one is opened: other commands start without them
    from slave.imu.lsm6dsox import I2cPlace
    from slave.imu.ximu3 import SerialPlace

REAL = "ximu3:PORT[@BAUD] | lsm6dsox:BUS[:ADDRESS]"
IMUS = f"{REAL} | synthetic"


class ListPlaces(argparse.Action):
    """The option that says where an IMU may be, and ends."""

    def __init__(self, option_strings: Sequence[str], dest: str, **others: Any) -> None:
        """Take no value."""
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, **others)

    def __call__(self, parser: argparse.ArgumentParser, *_others: object) -> None:
        """Notify it."""
        sys.stdout.write(places() + "\n")
        parser.exit()


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that name an IMU, live or recorded."""
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--imu", metavar="DRIVER", help=IMUS)
    which.add_argument(
        "--csv", type=Path, metavar="FILE", help="a recording: a CSV with a header, time, rates, forces"
    )
    parser.add_argument("--list", action=ListPlaces, help="say where an IMU may be connected, and end")


def orientation_of(imu: ImuCalibration) -> OrientationFilter:
    """What makes the orientation of the samples.

    Raises:
        CalibrationError: The rig trusts a heading that nobody knows.
    """
    if imu.heading_sigma_rad is not None:
        raise CalibrationError(
            f"imu.heading_sigma_rad: {imu.heading_sigma_rad:g}, but an orientation from rates and forces has no "
            "heading that means anything in the rig: set it to null, then tilt alone is used"
        )
    return OrientationFilter(imu.rate_hz)


def open_real(
    name: str,
    driver: str,
    rate_hz: float,
    clock: Clock,
    stop: threading.Event,
    connection_lost: ConnectionLost = nobody,
) -> ReconnectingImu:
    """Open the IMU that `--imu DRIVER:PLACE` names; until `stop` is set, it is opened again when it was lost.

    Args:
        name: The rig's IMU.
        driver: The value of `--imu`.
        rate_hz: Samples per second that the rig needs.
        clock: The slave's clock.
        stop: Set when the slave is to end.
        away: Told when it is lost.

    Raises:
        ImuError: There is no such driver, or the IMU cannot be opened.
    """
    from slave.imu import lsm6dsox, ximu3

    kind, _, where = driver.partition(":")
    opener: Callable[[], ImuSource]
    if kind == "ximu3" and where:
        port = _serial(where)
        true_hz = ximu3.SAMPLE_RATE_HZ / ximu3.divisor(rate_hz)
        opener = lambda: ximu3.Ximu3Imu(name, port, rate_hz, clock, stop)  # noqa: E731
    elif kind == "lsm6dsox" and where:
        wires = _i2c(where)
        true_hz = lsm6dsox.rate_of(rate_hz).rate_hz
        opener = lambda: lsm6dsox.Lsm6dsoxImu(name, wires, rate_hz, clock, stop)  # noqa: E731
    else:
        raise ImuError(f"--imu {driver}: no such driver; there are {IMUS}")
    return ReconnectingImu(opener, true_hz, clock, stop, connection_lost)


def places() -> str:
    """Where an IMU may be: the serial ports and I2C buses of this machine, as text for people."""
    from slave.imu import lsm6dsox, ximu3

    ports = [f"  ximu3:{line}" for line in ximu3.ports()] or ["  none"]
    buses = [f"  lsm6dsox:{bus}" for bus in lsm6dsox.buses()] or ["  none (on a Pi: dtparam=i2c_arm=on)"]
    return "\n".join(["serial ports:", *ports, "I2C buses:", *buses])


def _serial(where: str) -> "SerialPlace":
    from slave.imu import ximu3

    path, at, baud = where.rpartition("@")
    if not at:
        return ximu3.SerialPlace(where)
    if not path or not baud.isdecimal() or int(baud) < 1:
        raise ImuError(
            f"--imu ximu3:{where}: write ximu3:PORT or ximu3:PORT@BAUD, for example /dev/serial0@115200"
        )
    return ximu3.SerialPlace(path, int(baud))


def _i2c(where: str) -> "I2cPlace":
    from slave.imu import lsm6dsox

    bus, _, address = where.partition(":")
    try:
        place = lsm6dsox.I2cPlace(int(bus), int(address, 0) if address else lsm6dsox.ADDRESS)
    except ValueError:
        place = None
    if place is None or place.bus < 0 or not 0x08 <= place.address <= 0x77:
        raise ImuError(
            f"--imu lsm6dsox:{where}: write lsm6dsox:BUS or lsm6dsox:BUS:ADDRESS, for example lsm6dsox:1:0x6b"
        )
    return place
