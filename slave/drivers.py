"""Name the drivers and the engines that options choose from."""

from collections.abc import Callable
from typing import TypeVar

REAL_CAMERAS = "picamera2[:INDEX] | v4l2[:DEVICE] | opencv:INDEX"
CAMERAS = f"{REAL_CAMERAS} | synthetic | replay:FOLDER"
SERVICE = "service"  # a camera of `record`: that of the running slave
REAL_IMUS = "ximu3:PORT[@BAUD] | lsm6dsox:BUS[:ADDRESS]"
IMUS = f"{REAL_IMUS} | synthetic"
REAL_TRACKERS = "openvr | survive | survive:FILE"
TRACKERS = f"{REAL_TRACKERS} | synthetic"
SWITCHED_LIGHTS = "gpio:CHIP:LASER,LED[,SYNC] | i2c:BUS[:ADDRESS]"
LIGHTS = f"{SWITCHED_LIGHTS} | camera | external"
SCANS = ("auto", "full", "windows")
# The units of a table of an IMU, by what is measured; a test compares them with `common.imu.csv_table`.
IMU_UNITS = {
    "time": ("s", "ms", "us", "ns"),
    "gyro": ("rad/s", "deg/s", "mdeg/s"),
    "accel": ("m/s^2", "g", "mg"),
    "mag": ("uT", "T", "mT", "nT", "gauss", "mgauss"),
}


ENGINES = ("numpy", "numba")
_Engine = TypeVar("_Engine")


def engine_of(name: str, numpy: _Engine, numba: Callable[[], _Engine]) -> _Engine:
    """The engine `name`; `numba` loads the optional one, `numpy` is always there.

    Raises:
        PhalanxError: numba is asked for and not installed; the message states how to install it.
        ValueError: No such name.
    """
    if name == "numpy":
        return numpy
    if name == "numba":
        return numba()
    raise ValueError(f"engine {name!r}, not one of {', '.join(ENGINES)}")
