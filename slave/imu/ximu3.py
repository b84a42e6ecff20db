"""Drive the x-io x-IMU3 on a serial port, and decode its byte stream.

Source: x-IMU3 User Manual v1.11, section "Communication protocol". Every message ends with LF (0x0A), which stands
nowhere else:

    {"key":value} LF                      command or its answer, JSON with one key
    I,timestamp,value,...  LF             data as text: a capital letter, microseconds, numbers or a text
    0xC9 u64 f32 f32 ...   LF             data as bytes: 0x80 + the letter, little endian, LF and ESC stuffed as in SLIP

    stuffed: 0x0A -> 0xDB 0xDC, 0xDB -> 0xDB 0xDD

A binary message has no checksum. What counts as broken, and by which name, is what the vendor's own library reports
for the same bytes (ximu3 1.9; the tests compare).

Opened, over USB or a UART, it is asked who it is, given its settings, and each answer is compared. No correction of
its own for the gyroscope's offset, which would shift the rates while they are measured. The settings are applied, not
saved: it keeps them itself when it is switched off (section "Save command").

    gyroscope deg/s -> rad/s    accelerometer g -> m/s^2    magnetometer a.u. -> uT, 1 a.u. about 50 uT

The magnetometer gives 20 values a second: a sample that none has come with since the last one has NaN. An inertial
message is the mean of as many samples as the rate is divided by, stamped with the last (section "Sample averaging"),
which is what the filter takes a sample for. `DeviceClock` makes its stamps times.
"""

import logging
import math
import re
import struct
import termios
import threading
from collections import deque
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from errno import EACCES, EBUSY, ENOENT, EWOULDBLOCK
from typing import NamedTuple, cast

import msgspec
import numpy as np
import serial
from serial.tools import list_ports

from common.clock import Clock
from common.errors import ImuError
from common.messages import ImuSample
from slave.clocks import DeviceClock
from slave.sources import NO_FIELD, ClockedImu

END, ESC, ESC_END, ESC_ESC = b"\n", b"\xdb", b"\xdb\xdc", b"\xdb\xdd"
LONGEST = 4096  # bytes; the vendor's library drops what has not ended by then
_FALSE_ESCAPE = re.compile(rb"\xdb(?![\xdc\xdd])")
_COMMA = r"[ \t\r\n]*,[ \t\r\n]*+"
_STAMP = rf"[A-Z]{_COMMA}\+?(\d+)"
_FLOAT = rf"{_COMMA}([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d*)?)"  # half an exponent makes it broken
_TEXT = re.compile(rf"{_STAMP}{_COMMA}([^\n]+)\n")


class Kind(Enum):
    """A kind of data message: its letter, and how many numbers; 0 is a text."""

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
    """A data message: numbers, or a text as bytes."""

    kind: Kind
    t_us: int  # by the device's clock [us]
    values: tuple[float, ...]
    text: bytes = b""


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer of the device to a command; a refusal is a value of one part, `error`.

    The key has small letters and figures only, as the device compares keys itself.
    """

    key: str
    value: object

    @property
    def fields(self) -> dict[str, object]:
        """Return the fields of a value of several parts; a plain value has none."""
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


def _message(line: bytes) -> Data | Answer | Fault | None:
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


SAMPLE_RATE_HZ = 400.0  # of the inertial sensor, whatever of it is sent
STANDARD_GRAVITY = 9.80665  # m/s^2
RANGE_RAD_S, RANGE_M_S2 = 1.2 * math.radians(2000.0), 1.2 * 24.0 * STANDARD_GRAVITY  # sections 3.2.1, 3.2.2
ANSWER_S = 0.5  # an answer is sent within milliseconds
SILENT_READS = 20  # reads without a byte since the last sample: it sends no more
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SerialPlace:
    """Where it is connected; `baud` None: over USB, where there is no baud rate."""

    path: str
    baud: int | None = None

    @classmethod
    def of(cls, text: str) -> "SerialPlace":
        """PORT or PORT@BAUD; ImuError: neither."""
        path, at, baud = text.rpartition("@")
        if not at:
            return cls(text)
        if not path or not baud.isdecimal() or int(baud) < 1:
            raise ImuError(
                f"--imu ximu3:{text}: write ximu3:PORT or ximu3:PORT@BAUD, for example /dev/serial0@115200"
            )
        return cls(path, int(baud))


def open_port(place: SerialPlace) -> serial.Serial:
    """Open the port for this program alone; raises OSError."""
    baud = 115200
    read_s = 0.1  # a read waits so long, and looks whether it is to stop
    return serial.Serial(place.path, place.baud or baud, timeout=read_s, write_timeout=1.0, exclusive=True)


def ports() -> list[str]:
    """The serial ports of this machine, a line each: where, what, whose."""
    lines: list[str] = []
    for port in sorted(list_ports.comports()):
        usb = (
            "" if port.vid is None else f"  {port.vid:04x}:{port.pid:04x}  serial number {port.serial_number}"
        )
        maker = f", {port.manufacturer}" if port.manufacturer else ""
        lines.append(f"{port.device}  {port.description}{maker}{usb}")
    return lines


class Ximu3Imu(ClockedImu):
    """An `ImuSource` of the x-IMU3."""

    def __init__(
        self, name: str, place: SerialPlace, rate_hz: float, clock: Clock, stop: threading.Event
    ) -> None:
        """Open it, ask who it is, write its settings.

        `rate_hz`: samples per second that are needed; it gives as many or a few more. `stop` ends the stream, also
        while a sample is waited for. Raises ImuError: no such port, it may not be opened, nobody answers, or a
        setting was refused.
        """
        message_bits = 340  # of one inertial message on a UART: 34 bytes with start and stop bit
        least_ns = 0 if place.baud is None else round(1e9 * message_bits / place.baud)
        clock_error = 200e-6  # of its crystal against the slave's, each within 100 ppm
        super().__init__(name, "x-IMU3", place.path, clock, stop, DeviceClock(clock_error, least_ns))
        self._divisor = divisor(rate_hz)
        self._decoder = Decoder()
        self._came: deque[Data] = deque()
        self._answers: deque[Answer] = deque()
        self._bytes = self._silent = 0
        self._mag = NO_FIELD
        with self._errors("cannot be opened"):
            self._port = open_port(place)
        try:
            self._begin()
        except ImuError:
            self.close()
            raise

    def read(self) -> ImuSample | None:
        """Next sample; None once closed or stopped."""
        while not (self._closed or self._stop.is_set()):
            if not self._came:
                if self._silent >= SILENT_READS:
                    raise ImuError(f"{self._where}: the x-IMU3 sends no samples any more")
                self._receive()
            elif (sample := self._take(self._came.popleft())) is not None:
                return sample
        return None

    def close(self) -> None:
        """Give the port back. It goes on sending."""
        self._closed = True
        try:
            self._port.close()
        except (OSError, termios.error):
            _LOG.debug("%s: could not be closed", self._where)

    def _begin(self) -> None:
        pong = self._ask("ping", None)
        if pong is None:
            received = f", though {self._bytes} bytes came" if self._bytes else ""
            raise ImuError(
                f"{self._where}: no x-IMU3 answers{received}: is it switched on, is it another device, or has it "
                "another baud rate (behind @)? `phalanx-slave doctor --ports` lists what is there"
            )
        answer = [str(pong.fields.get(part, "?")) for part in ("name", "sn", "interface")]
        _LOG.info("%s: x-IMU3 %r, serial number %s, over %s", self._where, *answer)
        over = "serial" if answer[2].lower() == "serial" else "usb"
        for key, value in settings(over, self._divisor):
            self._write(key, value)
        if self._ask("apply", None) is None:
            raise ImuError(f"{self._where}: the x-IMU3 does not answer to apply its settings")
        self._silent = 0

    def _write(self, key: str, value: bool | int) -> None:
        answer = self._ask(key, value)
        if answer is None:
            raise ImuError(f"{self._where}: the x-IMU3 does not answer to {key}={value}")
        if answer.value == value:
            return
        text = answer.fields.get("error", f"it has {answer.value}")
        if key in NEEDED:
            raise ImuError(f"{self._where}: the x-IMU3 refused {key}={value}: {text}")
        _LOG.warning("%s: the x-IMU3 refused %s=%s: %s", self._where, key, value, text)

    def _ask(self, key: str, value: bool | int | None) -> Answer | None:
        """What it answers to a command; None: nothing, though asked repeatedly."""
        tries = 4  # only a full line delays it
        for _ in range(tries):
            with self._errors("is lost"):
                self._port.write(encode(key, value))
            until_ns = self._clock.now_ns() + round(ANSWER_S * 1e9)
            while self._clock.now_ns() < until_ns and not self._stop.is_set():
                self._receive()
                while self._answers:
                    if (answer := self._answers.popleft()).key == plain(key):
                        return answer
        return None

    def _receive(self) -> None:
        with self._errors("is lost"):
            data = self._port.read(max(1, self._port.in_waiting))
        arrival_ns = self._clock.now_ns()
        self._bytes += len(data)
        self._silent += not data
        for message in self._decoder.push(data):
            if isinstance(message, Data):
                self._counts[f"imu.{message.kind.name.lower()}"] += 1
                if message.kind is not Kind.INERTIAL or self._possible(message.t_us * 1000, arrival_ns):
                    self._came.append(message)
            elif isinstance(message, Answer):
                self._answers.append(message)
                self._came.clear()  # what was sent with other settings
            elif isinstance(message, Fault):
                self._counts[f"broken.{message.name.lower()}"] += 1

    def _take(self, message: Data) -> ImuSample | None:
        """The sample in a message, or what else there is in it kept."""
        logged = 20  # notifications and errors of the device; more are counted only
        match message.kind:
            case Kind.INERTIAL:
                return self._inertial(message)
            case Kind.MAGNETOMETER:
                # one a.u., the field at the magnetometer's calibration; "approximately", section 3.2.3
                tesla_unit_ut = 50.0
                mag = np.array(message.values) * tesla_unit_ut
                self._mag = np.where(np.isfinite(mag), mag, np.nan)
            case Kind.TEMPERATURE:
                self._metric("temperature_c", message.values[0])
            case Kind.BATTERY:
                self._metric("battery_percent", message.values[0])
            case Kind.NOTIFICATION | Kind.ERROR if self._counts[f"imu.{message.kind.name.lower()}"] <= logged:
                _LOG.warning("%s: the x-IMU3 reports: %s", self._where, message.text.decode(errors="replace"))
            case _:
                pass
        return None

    def _inertial(self, message: Data) -> ImuSample | None:
        self._silent = 0
        gyro = np.radians(message.values[:3])
        accel = np.array(message.values[3:]) * STANDARD_GRAVITY
        if (np.abs(gyro) > RANGE_RAD_S).any() or (np.abs(accel) > RANGE_M_S2).any():
            self._counts["broken.value"] += 1  # no checksum: bytes that were hit by noise look like this
            return None
        mag, self._mag = self._mag, NO_FIELD
        period_ns = 1e9 * self._divisor / SAMPLE_RATE_HZ
        return self._sample(message.t_us * 1000, period_ns, gyro, accel, mag)

    def _metric(self, name: str, value: float) -> None:
        if math.isfinite(value):
            self._metrics[name] = value

    @contextmanager
    def _errors(self, what: str) -> Generator[None]:
        """Convert errors of the port to messages that state what to do."""
        try:
            yield
        except (OSError, termios.error, ValueError, OverflowError) as error:  # the last two: of a baud rate
            number = error.errno if isinstance(error, OSError) else None
            raise ImuError(f"{self._where} {what}: {_why(number, error)}") from error


NEEDED = ("binary_mode_enabled", "usb_data_messages_enabled", "serial_data_messages_enabled")
NEEDED += ("inertial_message_rate_divisor",)


def settings(over: str, inertial_divisor: int) -> Iterator[tuple[str, bool | int]]:
    """Settings over usb or serial, User Manual v1.11, section "Individual settings"."""
    yield "binary_mode_enabled", True
    yield f"{over}_data_messages_enabled", True
    yield "inertial_message_rate_divisor", inertial_divisor
    yield "magnetometer_message_rate_divisor", 1
    yield "temperature_message_rate_divisor", 5
    yield "battery_message_rate_divisor", 5
    yield "ahrs_message_rate_divisor", 0
    yield "high_g_accelerometer_message_rate_divisor", 0
    yield "gyroscope_offset_correction_enabled", False


def divisor(rate_hz: float) -> int:
    """What divides its 400 Hz so that no less than `rate_hz` remains, or ImuError."""
    if not 0.0 < rate_hz <= SAMPLE_RATE_HZ:
        raise ImuError(f"imu.rate_hz: {rate_hz:g} Hz: an x-IMU3 gives at most {SAMPLE_RATE_HZ:g} Hz")
    return int(SAMPLE_RATE_HZ / rate_hz)


def _why(number: int | None, error: Exception) -> str:
    if number == ENOENT:
        return "there is no such port; `phalanx-slave doctor --ports` lists those there are"
    if number == EACCES:
        return "permission denied: `sudo usermod -aG dialout $USER`, then log in again"
    if number in (EBUSY, EWOULDBLOCK):
        return "another program has it open"
    if "configure" in str(error):  # pyserial's word, without a number
        return f"it is no serial port, or has not this baud rate ({error}); `phalanx-slave doctor --ports` lists ports"
    if isinstance(error, ValueError | OverflowError):
        return f"it does not take this baud rate: {error}"
    return str(error)
