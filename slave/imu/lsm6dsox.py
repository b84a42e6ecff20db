"""Drive the ST LSM6DSOX (or LSM6DSO) on an I2C bus.

Source: data sheet DS12814 and application note AN5272 of the LSM6DSOX; the LSM6DSO's state the same. A word of the
FIFO is a tag and six bytes, little endian:

    tag   7..3  what: 1 gyroscope, 2 accelerometer, 4 time stamp    2..1  number of the time slot, modulo 4    0  parity

All words of one time slot were measured together; the time stamp is among them, so that no sample is torn. One part's
clock is up to some percent off: `INTERNAL_FREQ_FINE` reports by how much, in steps of 0.15 %, for stamps and rates
alike.

Opened, it is asked who it is, reset, given its settings, and every register is read back and compared. It measures at
the lowest of its rates that is not below the rig's, 16 g and 2000 deg/s. The FIFO is fetched some hundred times a
second; a late process loses nothing for 0.8 s at 208 Hz (512 words). It has no magnetometer. `DeviceClock` makes its
stamps times.
"""

import struct
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from errno import EACCES, EIO, ENOENT, ENXIO, EREMOTEIO, ETIMEDOUT
from pathlib import Path
from typing import NamedTuple

import numpy as np
from smbus2 import SMBus, i2c_msg

from common.arrays import Float
from common.clock import Clock
from common.errors import ImuError
from common.messages import ImuSample
from slave.clocks import DeviceClock
from slave.sources import NO_FIELD, ClockedImu


class Fifo(NamedTuple):
    """Registers' values and scales of the LSM6DSOX and its FIFO."""

    standard_gravity: float = 9.80665  # m/s^2
    identity: int = 0x6C
    sw_reset: int = 0x01  # CTRL3_C, clears itself
    fifo_continuous: int = 0x46  # newest words replace the oldest
    overrun: int = 0x08  # FIFO_STATUS2: words were replaced since it was read
    word: int = 7  # bytes
    freq_fine_step: float = 0.0015
    gyro: int = 1
    accel: int = 2
    stamp: int = 4


FIFO = Fifo()


class Register(IntEnum):
    """Addresses, DS12814 section 8."""

    FIFO_CTRL1 = 0x07
    FIFO_CTRL2 = 0x08
    FIFO_CTRL3 = 0x09
    FIFO_CTRL4 = 0x0A
    WHO_AM_I = 0x0F
    CTRL1_XL = 0x10
    CTRL2_G = 0x11
    CTRL3_C = 0x12
    CTRL9_XL = 0x18
    CTRL10_C = 0x19
    OUT_TEMP_L = 0x20
    FIFO_STATUS1 = 0x3A
    INTERNAL_FREQ_FINE = 0x63
    FIFO_DATA_OUT_TAG = 0x78  # read on, it rolls over from 0x7E to here


OTHERS = {
    0x69: "LSM6DS3",
    0x6A: "LSM6DSL or LSM6DS3TR-C",
    0x6B: "ISM330DHCX",
    0xEA: "ICM-20948",
    0x68: "MPU-6050",
}
RAD_S_PER_LSB = float(np.radians(0.070))  # at 2000 deg/s, DS12814 table 2
M_S2_PER_LSB = 0.488e-3 * FIFO.standard_gravity  # at 16 g


class Rate(NamedTuple):
    """An output data rate [Hz, nominal]; its code in CTRL1_XL, CTRL2_G, FIFO_CTRL3."""

    code: int
    rate_hz: float


RATES = [Rate(code, 6667.0 / (1 << (10 - code))) for code in range(1, 7)]  # 13 to 417 Hz, AN5272 section 6.4


def settings(rate: Rate) -> dict[Register, int]:
    """Registers written at the start, FIFO off: 16 g, 2000 deg/s, no torn blocks."""
    fifo_off = 0x40  # FIFO_CTRL4: a time stamp in every slot
    return {
        Register.CTRL9_XL: 0xE2,  # I3C off
        Register.CTRL3_C: 0x44,  # block data update; addresses count on
        Register.CTRL1_XL: rate.code << 4 | 0b01 << 2,
        Register.CTRL2_G: rate.code << 4 | 0b11 << 2,
        Register.CTRL10_C: 0x20,
        Register.FIFO_CTRL1: 0,
        Register.FIFO_CTRL2: 0,
        Register.FIFO_CTRL3: rate.code << 4 | rate.code,
        Register.FIFO_CTRL4: fifo_off,
    }


def temperature_c(data: bytes) -> float:
    """Two bytes of OUT_TEMP; DS12814 section 4.3."""
    [raw] = struct.unpack("<h", data)
    return 25.0 + raw / 256.0


class Measured(NamedTuple):
    """Measurements of one time slot."""

    ticks: int  # stamp [25 us nominally] since the start
    gyro_rad_s: Float  # (3,)
    accel_m_s2: Float  # (3,)


class Slots:
    """Assembles FIFO words into time slots; counts broken ones, clipped axes (NaN)."""

    def __init__(self) -> None:
        """Begin between two slots."""
        self.counts: Counter[str] = Counter()
        self._slot = -1
        self._words: dict[int, bytes] = {}
        self._ticks: int | None = None

    def push(self, data: bytes) -> Iterator[Measured]:
        """The slots that whole words of the FIFO complete, in order."""
        for start in range(0, len(data) - FIFO.word + 1, FIFO.word):
            tag, word = data[start], data[start + 1 : start + FIFO.word]
            if tag.bit_count() % 2:
                self.counts["broken.parity"] += 1
                continue
            what, slot = tag >> 3, tag >> 1 & 3
            if slot != self._slot:
                self.counts["broken.incomplete"] += bool(self._words)
                self._slot, self._words = slot, {}
            if what in (FIFO.gyro, FIFO.accel, FIFO.stamp):
                self._words[what] = word
            if len(self._words) == 3:
                yield self._measured(self._words)
                self._words = {}

    def _measured(self, words: dict[int, bytes]) -> Measured:
        [raw] = struct.unpack("<I2x", words[FIFO.stamp])
        if self._ticks is None:
            self._ticks = raw
        else:
            self._ticks += (raw - self._ticks) % (1 << 32)  # it wraps after 30 hours
        return Measured(
            self._ticks,
            self._vector(words[FIFO.gyro], RAD_S_PER_LSB),
            self._vector(words[FIFO.accel], M_S2_PER_LSB),
        )

    def _vector(self, word: bytes, scale: float) -> Float:
        raw = np.array(struct.unpack("<3h", word), float)
        clipped = np.abs(raw) >= 32767
        self.counts["clipped"] += int(clipped.sum())
        return np.where(clipped, np.nan, raw * scale)


ADDRESS = 0x6A  # its pin SA0 to ground; 0x6B: to the supply
POLL_S = 0.004
SILENT_POLLS = 250  # without a word: it measures no more
_SILENT = (EIO, ENXIO, EREMOTEIO, ETIMEDOUT)


@dataclass(frozen=True, slots=True)
class I2cPlace:
    """Where it is connected: /dev/i2c-BUS, and the address of the part there."""

    bus: int
    address: int = ADDRESS

    @classmethod
    def of(cls, text: str) -> "I2cPlace":
        """BUS or BUS:ADDRESS in C's notation; ImuError: neither, or no part's address."""
        bus, _, address = text.partition(":")
        try:
            place = cls(int(bus), int(address, 0) if address else ADDRESS)
        except ValueError:
            place = None
        if place is None or place.bus < 0 or not 0x08 <= place.address <= 0x77:
            raise ImuError(
                f"--imu lsm6dsox:{text}: write lsm6dsox:BUS or lsm6dsox:BUS:ADDRESS, for example lsm6dsox:1:0x6b"
            )
        return place

    def __str__(self) -> str:
        """For people."""
        return f"I2C bus {self.bus}, address {self.address:#04x}"


def rate_of(rate_hz: float) -> Rate:
    """The lowest of its rates that is no less than `rate_hz`; ImuError: none."""
    for rate in RATES:
        if rate.rate_hz >= rate_hz:
            return rate
    most = RATES[-1].rate_hz
    raise ImuError(f"imu.rate_hz: {rate_hz:g} Hz: an LSM6DSOX on I2C gives at most {most:.0f} Hz")


def buses(where: Path = Path("/dev")) -> list[str]:
    """The I2C buses of this machine."""
    return [path.name.removeprefix("i2c-") for path in sorted(where.glob("i2c-*"))]


class Lsm6dsoxImu(ClockedImu):
    """An `ImuSource` of the ST LSM6DSOX."""

    def __init__(
        self,
        name: str,
        place: I2cPlace,
        rate_hz: float,
        clock: Clock,
        stop: threading.Event,
        opener: Callable[[int], SMBus] = SMBus,
    ) -> None:
        """Open the bus, ask who is there, write and compare the settings, start.

        `rate_hz`: samples per second that are needed. `stop` ends the stream, also while a sample is waited for.
        Raises ImuError: no such bus, nobody answers, it is another part, or a setting did not stick.
        """
        # of its oscillator, once its fine frequency is taken into account: what temperature does
        clock_error = 0.02
        super().__init__(name, "LSM6DSOX", str(place), clock, stop, DeviceClock(clock_error))
        self._place = place
        rate = rate_of(rate_hz)
        self._slots = Slots()
        self._counts = self._slots.counts
        self._came: deque[ImuSample] = deque()
        self._heated_ns: int | None = None
        self._silent = 0
        with self._errors():
            self._bus = opener(place.bus)
        try:
            fine = self._begin(rate)
        except ImuError:
            self.close()
            raise
        self._tick_ns = 25_000.0 / fine
        self._period_ns = 1e9 / (rate.rate_hz * fine)

    def read(self) -> ImuSample | None:
        """Next sample; None once closed or stopped."""
        while not (self._closed or self._stop.is_set()):
            if self._came:
                return self._came.popleft()
            self._fetch()
        return None

    def close(self) -> None:
        """Give the bus back. It goes on measuring."""
        self._closed = True
        self._bus.close()

    def _begin(self, rate: Rate) -> float:
        """Set it up; how much faster than nominal its clock runs."""
        identity = self._get(Register.WHO_AM_I)[0]
        if identity != FIFO.identity:
            other = OTHERS.get(identity, "another part")
            raise ImuError(
                f"{self._place}: WHO_AM_I is {identity:#04x}, {other}; an LSM6DSOX reports {FIFO.identity:#04x}"
            )
        self._put(Register.CTRL3_C, FIFO.sw_reset)
        reset_polls = 20
        for _ in range(reset_polls):
            if not self._get(Register.CTRL3_C)[0] & FIFO.sw_reset:
                break
            self._stop.wait(POLL_S)
        for register, value in settings(rate).items():
            self._set(register, value)
        fine = int.from_bytes(self._get(Register.INTERNAL_FREQ_FINE), signed=True)
        settle_s = 0.1  # a gyroscope starts within 70 ms
        self._stop.wait(settle_s)
        self._set(Register.FIFO_CTRL4, FIFO.fifo_continuous)
        return 1.0 + FIFO.freq_fine_step * fine

    def _fetch(self) -> None:
        """Take from the FIFO what is there, or wait a little."""
        low, high = self._get(Register.FIFO_STATUS1, 2)
        arrival_ns = self._clock.now_ns()
        most_words = 90  # of one read: half a kilobyte
        words = min((high & 3) << 8 | low, most_words)
        self._counts["imu.overrun"] += bool(high & FIFO.overrun)
        temperature_ns = 1_000_000_000
        if self._heated_ns is None or arrival_ns - self._heated_ns >= temperature_ns:
            self._heated_ns = arrival_ns
            self._metrics["temperature_c"] = temperature_c(self._get(Register.OUT_TEMP_L, 2))
        if not words:
            self._silent += 1
            if self._silent > SILENT_POLLS:
                raise ImuError(f"{self._place}: the LSM6DSOX measures no more")
            self._stop.wait(POLL_S)
            return
        self._silent = 0
        fresh = self._slots.push(self._get(Register.FIFO_DATA_OUT_TAG, words * FIFO.word))
        stamped = [(round(one.ticks * self._tick_ns), one) for one in fresh]
        possible = [(stamp, one) for stamp, one in stamped if self._possible(stamp, arrival_ns)]
        self._came.extend(
            self._sample(stamp, self._period_ns, one.gyro_rad_s, one.accel_m_s2, NO_FIELD)
            for stamp, one in possible
        )

    def _set(self, register: Register, value: int) -> None:
        self._put(register, value)
        if (has := self._get(register)[0]) != value:
            raise ImuError(
                f"{self._place}: register {register.name} has {has:#04x}, {value:#04x} was written: are the wires "
                "long or loose, is the bus too fast?"
            )

    def _put(self, register: Register, value: int) -> None:
        with self._errors():
            self._bus.write_byte_data(self._place.address, register, value)

    def _get(self, register: Register, count: int = 1) -> bytes:
        answer = i2c_msg.read(self._place.address, count)
        with self._errors():
            self._bus.i2c_rdwr(i2c_msg.write(self._place.address, [register]), answer)
        return bytes(answer)

    @contextmanager
    def _errors(self) -> Generator[None]:
        """Convert errors of the bus to messages that state what to do."""
        try:
            yield
        except OSError as error:
            raise ImuError(f"{self._place}: {_why(self._place, error)}") from error


def _why(place: I2cPlace, error: OSError) -> str:
    if error.errno == ENOENT:
        return f"there is no /dev/i2c-{place.bus}: is I2C on? (`raspi-config`, or dtparam=i2c_arm=on)"
    if error.errno == EACCES:
        return "permission denied: `sudo usermod -aG i2c $USER`, then log in again"
    if error.errno in _SILENT:
        return f"nobody answers: look at the wires and the address, `i2cdetect -y {place.bus}`"
    return str(error)
