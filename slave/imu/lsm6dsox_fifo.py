"""Registers, rates and FIFO format of an ST LSM6DSOX.

Pure: bytes in, measurements out.

Source: data sheet DS12814 and application note AN5272 of the LSM6DSOX; the LSM6DSO's state the same, and what
is used here is the same in it. A word of the FIFO is a tag and six bytes, little endian:

    tag   7..3  what: 1 gyroscope, 2 accelerometer, 4 time stamp    2..1  number of the time slot, modulo 4    0  parity

All words of one time slot were measured together; the time stamp is among them, so that none is torn and each has its
own time. One part's clock is up to some percent off: `INTERNAL_FREQ_FINE` reports by how much, in steps of 0.15 %, for
the time stamps and the rates alike.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from common.arrays import Float


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
    """An output data rate.

    Its code in CTRL1_XL, CTRL2_G and FIFO_CTRL3, and its nominal value [Hz].
    """

    code: int
    rate_hz: float


RATES = [Rate(code, 6667.0 / (1 << (10 - code))) for code in range(1, 7)]  # 13 to 417 Hz, AN5272 section 6.4


def settings(rate: Rate) -> dict[Register, int]:
    """Return the register values written at the start, with the FIFO still off.

    16 g, 2000 deg/s, blocks that do not tear, time stamps.
    """
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
    """Measurements of one time slot.

    Its stamp [25 us nominally] since the start, rate (3,) [rad/s], force (3,) [m/s^2].
    """

    ticks: int
    gyro_rad_s: Float
    accel_m_s2: Float


class Slots:
    """Push machine that assembles FIFO words into time slots.

    Holds the words of the slot that is not complete, and how often the stamps have wrapped.

    Attributes:
        counts: `broken.parity` of a tag, `broken.incomplete` slots, `clipped` axes, which are NaN.
    """

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
        # clipped
        clipped = np.abs(raw) >= 32767
        self.counts["clipped"] += int(clipped.sum())
        return np.where(clipped, np.nan, raw * scale)
