"""The lines that libsurvive writes with --record-stdout or --record: bytes in, messages out, no input or output.

Every line begins with the program's time [s since its start], then who, then what (src/survive_recording.c of
https://github.com/collabora/libsurvive, read at the versions of 2019 to 2025):

    8.042091 WM0 POSE -0.284080 0.936063 0.374069 0.707107 0.000000 0.000000 0.707107 CR LF
    0.331402 WM0 CONFIG {... "device_serial_number": "LHR-1A2B3C4D" ...} CR LF
    9.112874 WM0 DISCONNECT CR LF
    8.042070 WM0 VELOCITY ...     0.001240 OPTION ...     7.120011 0 LH_POSE ...     0.001000 INFO LOG ...

A pose is the device's in libsurvive's world, metres, its quaternion with w first. The world is z up, its origin and
heading those of its calibration. Numbers are decimals, or hexadecimal where it was built with SURVIVE_HEX_FLOATS. Lines
carry no checksum: that a quaternion has length 1 is what shows a line whose end was cut or run into by another thread.
"""

import math
import re
from collections.abc import Iterator
from enum import Enum
from typing import NamedTuple, TypeAlias

LONGEST = 1 << 17  # bytes; the longest lines are CONFIG, some 10 kB
UNIT_WITHIN = 1e-3  # six decimals are within 3e-6; a component that lost its last digits is not
FARTHEST_M = 100.0  # no base station reaches so far
_SERIAL = re.compile(rb'"device_serial_number"\s*:\s*"([^"]{1,64})"')
_DEVICE = re.compile(rb"[A-Za-z0-9_.-]{1,32}")
_SIZE = 7  # numbers of a pose


class Pose(NamedTuple):
    """Where a device is: time [s] of the program, place [m], quaternion wxyz. NaN: it does not know."""

    device: str
    t_s: float
    position_m: tuple[float, float, float]
    orientation_wxyz: tuple[float, float, float, float]


class Serial(NamedTuple):
    """Which device hides behind a name that is given in the order of appearance."""

    device: str
    serial: str


class Gone(NamedTuple):
    """A device was unplugged or switched off."""

    device: str


class Fault(Enum):
    """Why a line about a pose is none."""

    OVERRUN = "a line without end"
    LENGTH = "not seven numbers"
    NUMBER = "not a number"
    QUATERNION = "quaternion not of length 1"
    PLACE = "farther than any base station reaches"


Found: TypeAlias = Pose | Serial | Gone | Fault


class LineDecoder:
    """Push machine. Holds the bytes of the line that has not ended."""

    def __init__(self) -> None:
        """Begin between two lines."""
        self._rest = b""

    def push(self, data: bytes) -> Iterator[Found]:
        """What the lines say that end in `data`, in order; lines about other things say nothing."""
        lines = (self._rest + data).split(b"\n")
        self._rest = lines.pop()
        if len(self._rest) > LONGEST:
            self._rest = b""
            yield Fault.OVERRUN
        for line in lines:
            found = read_line(line)
            if found is not None:
                yield found


def read_line(line: bytes) -> Found | None:
    """What one line without its end says; None: nothing that matters here."""
    words = line.split(None, 3)
    if len(words) < 3:
        return None
    who, what = words[1], words[2]
    if what not in (b"POSE", b"CONFIG", b"DISCONNECT") or not _DEVICE.fullmatch(who):
        return None
    device = who.decode("ascii")
    if what == b"DISCONNECT":
        return Gone(device)
    if what == b"CONFIG":
        found = _SERIAL.search(line)
        return None if found is None else Serial(device, found[1].decode("ascii", "replace"))
    return _pose(device, words[0], b"" if len(words) < 4 else words[3])


def _pose(device: str, stamp: bytes, rest: bytes) -> Pose | Fault:
    words = rest.split()
    if len(words) != _SIZE:
        return Fault.LENGTH
    try:
        t_s = _number(stamp)
        values = [_number(word) for word in words]
    except (ValueError, OverflowError):
        return Fault.NUMBER
    if not math.isfinite(t_s) or t_s < 0.0:
        return Fault.NUMBER
    if any(math.isnan(value) for value in values):  # it writes them when its solver fails
        values = [math.nan] * _SIZE
    x, y, z, *quaternion = values
    place, (qw, qx, qy, qz) = (x, y, z), quaternion
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > UNIT_WITHIN:
        return Fault.QUATERNION
    if math.hypot(*place) > FARTHEST_M:
        return Fault.PLACE
    return Pose(device, t_s, place, (qw / length, qx / length, qy / length, qz / length))


def _number(word: bytes) -> float:
    """A number as C's printf writes it by %f or %a."""
    text = word.decode("ascii")
    if "_" in text:  # Python's own spelling, which nobody sends
        raise ValueError(text)
    return float.fromhex(text) if "0x" in text else float(text)
