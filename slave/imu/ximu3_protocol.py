"""Byte stream of an x-io x-IMU3.

Bytes in, messages out, no input or output of its own.

Source: x-IMU3 User Manual v1.11, section "Communication protocol". Every message ends with LF (0x0A), which stands
nowhere else:

    {"key":value} LF                      command or its answer, JSON with one key
    I,timestamp,value,...  LF             data as text: a capital letter, microseconds, numbers or a text
    0xC9 u64 f32 f32 ...   LF             data as bytes: 0x80 + the letter, little endian, LF and ESC stuffed as in SLIP

    stuffed: 0x0A -> 0xDB 0xDC, 0xDB -> 0xDB 0xDD

A binary message carries no checksum: its length, its escapes and its letter are all that shows a broken one. What
counts as broken, and by which name, is what the vendor's own library reports for the same bytes (ximu3 1.9; the tests
compare): text behind the last number is ignored, a message longer than its buffer of 4096 bytes is broken.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, cast

import msgspec

END, ESC, ESC_END, ESC_ESC = b"\n", b"\xdb", b"\xdb\xdc", b"\xdb\xdd"
LONGEST = 4096  # bytes; the vendor's library drops what has not ended by then
_FALSE_ESCAPE = re.compile(rb"\xdb(?![\xdc\xdd])")
_COMMA = r"[ \t\r\n]*,[ \t\r\n]*+"
_STAMP = rf"[A-Z]{_COMMA}\+?(\d+)"
_FLOAT = rf"{_COMMA}([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d*)?)"  # half an exponent makes it broken
_TEXT = re.compile(rf"{_STAMP}{_COMMA}([^\n]+)\n")


class Kind(Enum):
    """A kind of data message.

    Its letter, and how many numbers it carries; 0 is a text.
    """

    INERTIAL = ("I", 6)  # gyroscope x y z [deg/s], accelerometer x y z [g]
    MAGNETOMETER = ("M", 3)  # [a.u.]
    QUATERNION = ("Q", 4)  # w x y z
    ROTATION_MATRIX = ("R", 9)  # row by row
    EULER_ANGLES = ("A", 3)  # roll, pitch, yaw [deg]
    LINEAR_ACCELERATION = ("L", 3)  # [g]
    EARTH_ACCELERATION = ("E", 3)  # [g]
    AHRS_STATUS = ("U", 0)
    HIGH_G_ACCELEROMETER = ("H", 3)  # [g]
    TEMPERATURE = ("T", 1)  # [deg C]
    BATTERY = ("B", 3)  # [%], [V], charging status
    RSSI = ("W", 2)  # [%], [dBm]
    SERIAL_ACCESSORY = ("S", 0)
    SYNC = ("Y", 1)
    BUTTON = ("O", 1)
    TIMECODE = ("C", 0)
    NOTIFICATION = ("N", 0)
    ERROR = ("F", 0)

    def __init__(self, letter: str, numbers: int) -> None:
        """Take letter and count, and prepare what reads them."""
        self.letter = letter
        self.numbers = numbers
        self.binary = struct.Struct(f"<xQ{numbers}fx")
        self.text = re.compile(_STAMP + _FLOAT * numbers) if numbers else _TEXT


KINDS = {ord(kind.letter): kind for kind in Kind}
_HEADER = struct.Struct("<xQ")


class Fault(Enum):
    """Why bytes were no message, in the words of the vendor's library."""

    OVERRUN = "buffer overrun"
    LETTER = "invalid message identifier"
    JSON = "invalid json"
    MUX = "invalid mux message length"
    ESCAPE = "invalid escape sequence"
    LENGTH = "invalid binary message length"
    TEXT = "unable to parse ascii message"


class Data(NamedTuple):
    """A data message.

    Its kind, its time by the device's clock [us], and its numbers, or its text as bytes.
    """

    kind: Kind
    t_us: int
    values: tuple[float, ...]
    text: bytes = b""


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer of the device to a command.

    The key has small letters and figures only, as the device compares keys itself.

    A refusal is a value of one part, `error`.
    """

    key: str
    value: object

    @property
    def fields(self) -> dict[str, object]:
        """Return the fields of a value of several parts.

        A plain value has none.
        """
        return cast(dict[str, object], self.value) if isinstance(self.value, dict) else {}


class Decoder:
    """Push machine. Holds the bytes of the message that has not ended."""

    def __init__(self) -> None:
        """Begin between two messages."""
        self._rest = b""

    def push(self, data: bytes) -> Iterator[Data | Answer | Fault | None]:
        """Yield the messages that end in `data`, in order.

        A `Fault` stands for each that is no message; None: of another channel.
        """
        pieces = (self._rest + data).split(END)
        self._rest = pieces.pop()
        for piece in pieces:
            over, line = divmod(len(piece) + 1, LONGEST)
            yield from [Fault.OVERRUN] * over
            if line:
                yield _message(piece[len(piece) + 1 - line :] + END)
        over = len(self._rest) // LONGEST
        yield from [Fault.OVERRUN] * over
        self._rest = self._rest[over * LONGEST :]


def encode(key: str, value: object = None) -> bytes:
    """A command: null reads a setting or gives an order, a value writes a setting."""
    return msgspec.json.encode({key: value}) + END


def plain(key: str) -> str:
    """A key as the device compares it: neither case nor punctuation matters."""
    return "".join(one for one in key.lower() if one.isalnum())


def stuff(message: bytes) -> bytes:
    """A binary data message, without its end, as it is sent."""
    return message.replace(ESC, ESC_ESC).replace(END, ESC_END) + END


def _message(line: bytes) -> Data | Answer | Fault | None:
    """One message with its end."""
    if line.startswith(b"{"):
        return _answer(line)
    if line.startswith(b"^"):  # of another device behind this one
        return None if len(line) > 2 else Fault.MUX
    if _FALSE_ESCAPE.search(line):
        return Fault.ESCAPE
    line = line.replace(ESC_END, END).replace(ESC_ESC, ESC)
    if (kind := KINDS.get(line[0])) is not None:
        return _text(kind, line)
    binary = 0x80
    if (kind := KINDS.get(line[0] - binary)) is None:
        return Fault.LETTER
    if kind.numbers:
        if len(line) != kind.binary.size:
            return Fault.LENGTH
        t_us, *values = kind.binary.unpack(line)
        return Data(kind, t_us, tuple(values))
    if len(line) <= _HEADER.size:
        return Fault.LENGTH
    [t_us] = _HEADER.unpack_from(line)
    return Data(kind, t_us, (), line[_HEADER.size : -1])


def _text(kind: Kind, line: bytes) -> Data | Fault:
    try:
        found = kind.text.match(line.decode())
    except UnicodeDecodeError:
        return Fault.TEXT
    if found is None:
        return Fault.TEXT
    stamp, *values = found.groups()
    if not stamp.isascii() or int(stamp) >= 1 << 64:
        return Fault.TEXT
    if not kind.numbers:
        return Data(kind, int(stamp), (), values[0].encode())
    if not all(value.isascii() and value[-1] not in "e+-" for value in values):
        return Fault.TEXT
    return Data(kind, int(stamp), tuple(float(value) for value in values))


def _answer(line: bytes) -> Answer | Fault:
    try:
        found = msgspec.json.decode(line, type=dict[str, object])
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        return Fault.JSON
    if len(found) != 1:
        return Fault.JSON
    [(key, value)] = found.items()
    return Answer(plain(key), value)
