"""The x-io x-IMU3 on a serial port: over USB, or a UART at a baud rate.

Opened, it is asked who it is, given its settings, and each answer is compared with what was written: binary messages;
inertial ones at the lowest rate that is not below the rig's; magnetometer, temperature and battery at their own;
no orientation of its own and no high-g, which nobody reads; no correction of its own for the gyroscope's offset, which
would shift the rates while they are measured. The settings are applied, not saved: it keeps them itself when it is
switched off (User Manual v1.11, section "Save command").

    gyroscope deg/s -> rad/s    accelerometer g -> m/s^2    magnetometer a.u. -> uT, 1 a.u. about 50 uT

The magnetometer gives 20 values a second: a sample that none has come with since the last one has NaN. An inertial
message is the mean of as many samples as the rate is divided by, stamped with the last (section "Sample averaging"):
the end of the period that its rates are the mean of, which is what the filter takes a sample for. Its stamps become
times by `DeviceClock`.
"""

import logging
import math
import termios
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from errno import EACCES, EBUSY, ENOENT, EWOULDBLOCK
from typing import Protocol

import numpy as np
import serial
from serial.tools import list_ports

from common.clock import Clock
from common.errors import ImuError
from common.messages import ImuSample
from slave.clocks import ClockSteppedError, DeviceClock
from slave.imu.ximu3_protocol import Answer, Data, Decoder, Fault, Kind, encode, plain

SAMPLE_RATE_HZ = 400.0  # of the inertial sensor, whatever of it is sent
STANDARD_GRAVITY = 9.80665  # m/s^2
RANGE_RAD_S, RANGE_M_S2 = 1.2 * math.radians(2000.0), 1.2 * 24.0 * STANDARD_GRAVITY  # sections 3.2.1, 3.2.2
ANSWER_S = 0.5  # an answer is sent within milliseconds
SILENT_READS = 20  # reads without a byte since the last sample: it sends no more
_NONE = (np.full(3, np.nan), np.full(4, np.nan))
_LOG = logging.getLogger(__name__)


class Port(Protocol):
    """What is used of `serial.Serial`."""

    @property
    def in_waiting(self) -> int:
        """How many bytes have come."""
        ...

    def read(self, size: int = 1, /) -> bytes:
        """Wait for bytes, no longer than its timeout."""
        ...

    def write(self, b: bytes, /) -> int | None:
        """Send bytes."""
        ...

    def close(self) -> None:
        """Give it back."""
        ...


@dataclass(frozen=True, slots=True)
class SerialPlace:
    """Where it is connected; `baud` None: over USB, where there is no baud rate."""

    path: str
    baud: int | None = None

    @classmethod
    def of(cls, text: str) -> "SerialPlace":
        """PORT or PORT@BAUD.

        Raises:
            ImuError: Neither.
        """
        path, at, baud = text.rpartition("@")
        if not at:
            return cls(text)
        if not path or not baud.isdecimal() or int(baud) < 1:
            raise ImuError(
                f"--imu ximu3:{text}: write ximu3:PORT or ximu3:PORT@BAUD, for example /dev/serial0@115200"
            )
        return cls(path, int(baud))


def open_port(place: SerialPlace) -> Port:
    """Open the port for this program alone.

    Raises:
        OSError: It cannot be opened.
    """
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


class Ximu3Imu:
    """An `ImuSource` of the x-IMU3.

    Holds the port, the samples that are not handed over yet, and the newest of each slow value.
    """

    def __init__(
        self,
        name: str,
        place: SerialPlace,
        rate_hz: float,
        clock: Clock,
        stop: threading.Event,
        opener: Callable[[SerialPlace], Port] = open_port,
    ) -> None:
        """Open it, ask who it is, write its settings.

        Args:
            name: The rig's IMU.
            place: Where it is.
            rate_hz: Samples per second that are needed; it gives as many or a few more.
            clock: The slave's clock.
            stop: Ends the stream, also while a sample is waited for.
            opener: Opens the port.

        Raises:
            ImuError: There is no such port, it may not be opened, nobody answers, or a setting was refused.
        """
        self._name, self._place, self._clock, self._stop = name, place, clock, stop
        self._divisor = divisor(rate_hz)
        self._decoder = Decoder()
        self._came: deque[Data] = deque()
        self._answers: deque[Answer] = deque()
        self._counts: Counter[str] = Counter()
        self._metrics: dict[str, float] = {}
        self._bytes = self._silent = 0
        self._seq = -1
        self._stamp_us: int | None = None
        self._mag = _NONE[0]
        self._closed = False
        with self._errors("cannot be opened"):
            self._port = opener(place)
        message_bits = 340  # of one inertial message on a UART: 34 bytes with start and stop bit
        least_ns = 0 if place.baud is None else round(1e9 * message_bits / place.baud)
        clock_error = 200e-6  # of its crystal against the slave's, each within 100 ppm
        self._device_clock = DeviceClock(clock_error, least_ns)
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
                    raise ImuError(f"{self._place.path}: the x-IMU3 sends no samples any more")
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
            _LOG.debug("%s: could not be closed", self._place.path)

    def counts(self) -> Mapping[str, int]:
        """`broken` in all and by reason, messages by kind."""
        counts = dict(self._counts)
        return {"broken": sum(v for k, v in counts.items() if k.startswith("broken.")), **counts}

    def metrics(self) -> Mapping[str, float]:
        """Return the last received `temperature_c` and `battery_percent`."""
        return dict(self._metrics)

    def _begin(self) -> None:
        pong = self._ask("ping", None)
        if pong is None:
            received = f", though {self._bytes} bytes came" if self._bytes else ""
            raise ImuError(
                f"{self._place.path}: no x-IMU3 answers{received}: is it switched on, is it another device, or has it "
                "another baud rate (behind @)? `phalanx-slave doctor --ports` lists what is there"
            )
        answer = [str(pong.fields.get(part, "?")) for part in ("name", "sn", "interface")]
        _LOG.info("%s: x-IMU3 %r, serial number %s, over %s", self._place.path, *answer)
        over = "serial" if answer[2].lower() == "serial" else "usb"
        for key, value in settings(over, self._divisor):
            self._write(key, value)
        if self._ask("apply", None) is None:
            raise ImuError(f"{self._place.path}: the x-IMU3 does not answer to apply its settings")
        self._silent = 0

    def _write(self, key: str, value: bool | int) -> None:
        answer = self._ask(key, value)
        if answer is None:
            raise ImuError(f"{self._place.path}: the x-IMU3 does not answer to {key}={value}")
        if answer.value == value:
            return
        text = answer.fields.get("error", f"it has {answer.value}")
        if key in NEEDED:
            raise ImuError(f"{self._place.path}: the x-IMU3 refused {key}={value}: {text}")
        _LOG.warning("%s: the x-IMU3 refused %s=%s: %s", self._place.path, key, value, text)

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
        """Read what has come, and wait a little for it."""
        with self._errors("is lost"):
            data = self._port.read(max(1, self._port.in_waiting))
        arrival_ns = self._clock.now_ns()
        self._bytes += len(data)
        self._silent += not data
        for message in self._decoder.push(data):
            if isinstance(message, Data):
                self._counts[f"imu.{message.kind.name.lower()}"] += 1
                if message.kind is not Kind.INERTIAL or self._dated(message, arrival_ns):
                    self._came.append(message)
            elif isinstance(message, Answer):
                self._answers.append(message)
                self._came.clear()  # what was sent with other settings
            elif isinstance(message, Fault):
                self._counts[f"broken.{message.name.lower()}"] += 1

    def _dated(self, message: Data, arrival_ns: int) -> bool:
        """Return whether the time stamp of a message is possible."""
        try:
            possible = self._device_clock.observe(message.t_us * 1000, arrival_ns)
        except ClockSteppedError:
            raise ImuError(f"{self._place.path}: the x-IMU3 began anew, or its clock was set") from None
        self._counts["broken.time"] += not possible
        return possible

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
                _LOG.warning(
                    "%s: the x-IMU3 reports: %s", self._place.path, message.text.decode(errors="replace")
                )
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
        period_us = 1e6 * self._divisor / SAMPLE_RATE_HZ
        passed = 1 if self._stamp_us is None else max(1, round((message.t_us - self._stamp_us) / period_us))
        self._seq, self._stamp_us = self._seq + passed, message.t_us
        t_ns = self._device_clock.at(message.t_us * 1000)
        mag, self._mag = self._mag, _NONE[0]
        return ImuSample(self._name, 0, self._seq, t_ns, gyro, accel, mag, _NONE[1])

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
            raise ImuError(f"{self._place.path} {what}: {_why(number, error)}") from error


NEEDED = ("binary_mode_enabled", "usb_data_messages_enabled", "serial_data_messages_enabled")
NEEDED += ("inertial_message_rate_divisor",)


def settings(over: str, inertial_divisor: int) -> Iterator[tuple[str, bool | int]]:
    """Yield the settings of the x-IMU3.

    The names are those of User Manual v1.11, section "Individual settings"; `over` is usb or serial.
    """
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
    """By what its 400 Hz are divided so that no less than `rate_hz` remains.

    Raises:
        ImuError: It has no such rate.
    """
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
