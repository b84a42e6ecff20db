"""An LSM6DSOX on a bus that a test holds: its registers, its FIFO, and the ways in which it does not answer."""

import struct
from collections import deque
from errno import EREMOTEIO
from typing import cast

from smbus2 import SMBus, i2c_msg

from slave.imu.lsm6dsox import Register

RATES = {code: 6667.0 / (1 << (10 - code)) for code in range(1, 7)}


class FakeLsm6dsox:
    """Holds registers and FIFO; `plugged` False: the bus gives no answer."""

    def __init__(self, address: int = 0x6A, identity: int = 0x6C, fine: int = -7) -> None:
        """Power it up."""
        self.address, self.identity, self.fine = address, identity, fine
        self.plugged = True
        self.stuck: dict[int, int] = {}  # registers that keep a value whatever is written
        self.opened = self.closed = 0
        self.power_up()

    def power_up(self) -> None:
        """As after the supply came back: nothing measured, time zero."""
        self.registers: dict[int, int] = {
            Register.WHO_AM_I: self.identity,
            Register.INTERNAL_FREQ_FINE: self.fine & 0xFF,
        }
        self.registers |= {Register.CTRL3_C: 0x04, Register.CTRL9_XL: 0xE0}
        self.fifo: deque[bytes] = deque()
        self.ticks = 1000
        self.slot = 0
        self.overrun = False
        self.temperature = 0

    def __call__(self, bus: int) -> SMBus:
        """Open the bus."""
        assert bus == 1
        self.opened += 1
        return cast(SMBus, self)

    def close(self) -> None:
        """Give the bus back."""
        self.closed += 1

    @property
    def ticks_per_sample(self) -> float:
        """The rates and the stamps are of one oscillator: nominal ticks, however fast it runs."""
        return 40_000.0 / RATES[self.registers[Register.CTRL2_G] >> 4]

    def measure(
        self, count: int = 1, gyro: tuple[int, ...] = (0, 0, 0), accel: tuple[int, ...] = (0, 0, 2049)
    ) -> None:
        """Put time slots into the FIFO."""
        for _ in range(count):
            self.ticks += round(self.ticks_per_sample)
            self.slot = (self.slot + 1) % 4
            if self.registers[Register.FIFO_CTRL4] == 0x46:
                self.word(1, struct.pack("<3h", *gyro))
                self.word(2, struct.pack("<3h", *accel))
                self.word(4, struct.pack("<IH", self.ticks % (1 << 32), 0))

    def word(self, what: int, data: bytes, flip: int = 0) -> None:
        """Put one word there, its tag with even parity."""
        tag = what << 3 | self.slot << 1
        tag |= tag.bit_count() % 2
        self.fifo.append(bytes([tag ^ flip]) + data)
        if len(self.fifo) > 512:
            self.fifo.popleft()
            self.overrun = True

    def write_byte_data(self, i2c_addr: int, register: int, value: int, /) -> None:
        """Write one register."""
        self._answers(i2c_addr)
        if register == Register.CTRL3_C and value & 1:
            self.power_up()
            return
        self.registers[register] = self.stuck.get(register, value)

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        """A register address out, bytes in."""
        asked, answer = i2c_msgs
        self._answers(asked.addr)
        register = asked.buf[0][0]
        data = self._read(register, answer.len)
        for k, byte in enumerate(data):
            answer.buf[k] = bytes([byte])

    def _read(self, register: int, count: int) -> bytes:
        if register == Register.FIFO_DATA_OUT_TAG:
            assert count % 7 == 0
            return b"".join(self.fifo.popleft() for _ in range(count // 7))
        if register == Register.FIFO_STATUS1:
            overrun, self.overrun = self.overrun, False
            return struct.pack("<H", len(self.fifo) | overrun << 11)[:count]
        if register == Register.OUT_TEMP_L:
            return struct.pack("<h", self.temperature)
        return bytes(self.registers.get(register + k, 0) for k in range(count))

    def _answers(self, address: int) -> None:
        if not self.plugged or address != self.address:
            raise OSError(EREMOTEIO, "Remote I/O error")
