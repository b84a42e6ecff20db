"""Switch laser (LED1) and LEDs (LED2) behind one LM3644 flash driver on I2C.

Texas Instruments, LM3644, SNVSA52E (September 2016); sections of that data sheet below. Its flash mode is begun by
one write and ended by another, or by the chip itself: after the time-out, 10 ms at the least, it clears the mode bits
(8.3.1, 8.4.5.2). So a pulse ends though the slave was killed, the bus is cut or the kernel has died. It also
regulates the currents, and stops for shorts and heat. The LM3644TT, whose shortest time-out is 40 ms, is refused.

A fault takes the chip to standby until both flag registers are read, which clears them (8.4.5.1): they are read after
every pulse, and counted by name. After an unplug all registers have their defaults: everything is written and read
back again before the next pulse. Registers are written at 400 kHz in 70 us, at 100 kHz in 0.3 ms: well within the
lead. Torch and IR mode, in which no time-out ends the light, are never written. A chip that is missing, another one
or not dark, and currents out of range, raise `LightsError`.
"""

import fcntl
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from typing import NamedTuple

from smbus2 import SMBus

from common.calibration.strobe import StrobeCalibration
from common.errors import LightsError
from common.recording.frame_recording import Illumination
from slave.lights.interlock import Lights


class Register(NamedTuple):
    """Registers of the LM3644 and their values, data sheet section 8.6."""

    # 8.6.1 to 8.6.12
    enable: int = 0x01
    led1_flash: int = 0x03
    led2_flash: int = 0x04
    timing: int = 0x08
    flags1: int = 0x0A
    flags2: int = 0x0B
    device_id: int = 0x0C
    standby: int = 0x00  # 8.6.1: mode 00, no LED, and neither TX, strobe nor torch pin has an effect
    lm3644tt: int = 0x04  # 8.6.12


REGISTER = Register()
FLASH = {Illumination.LASER: 0x0D, Illumination.LED: 0x0E}  # 8.6.1: mode 11 (flash) with LED1, with LED2
# 8.6.10, 8.6.11, from bit 0 on
FAULTS1 = "timeout undervoltage overheated current_limit led_short laser_short out_short tx"
FAULTS2 = "led_hot overvoltage input_low ntc_open ntc_short"


class FlashDriverLights(Lights):
    """`Lights` behind the flash driver chip; counts its faults."""

    def __init__(self, place: str, strobe: StrobeCalibration) -> None:
        """Open the bus of BUS[:ADDRESS], the address in C's notation; set up, dark."""
        bus, colon, address = place.partition(":")
        try:
            # 8.5.2.4
            self._number, self._address = int(bus), int(address, 0) if colon else 0x63
        except ValueError as error:
            raise LightsError(
                f"--lights i2c:{place}: write i2c:BUS, or i2c:BUS:ADDRESS, for example i2c:1:0x63"
            ) from error
        self._where = f"I2C bus {self._number}, address 0x{self._address:02x}"
        self._codes = [
            current_code(light.current_a, name)
            for name, light in (("laser", strobe.laser), ("led", strobe.led))
        ]
        self._bus: SMBus | None = None
        self._ready = self._closed = False
        self._counts: Counter[str] = Counter({"reopened": 0})
        self._set_up()

    def switch(self, lit: Illumination) -> None:
        """Begin a flash, or end it; a chip that was away is set up again first."""
        if self._closed:
            return
        if lit not in FLASH:
            self._standby()
            return
        if not self._ready:
            self._set_up()
            self._counts["reopened"] += 1
        self._write(REGISTER.enable, FLASH[lit])

    def _standby(self) -> None:
        """Have both off, read back; then the flags."""
        self._write(REGISTER.enable, REGISTER.standby)
        is_on = 0x0F  # 8.6.1: mode and LED bits
        if (got := self._read(REGISTER.enable)) & is_on:
            raise LightsError(f"{self._where}: was sent to standby, and reports 0x{got:02x}: it may be lit")
        self._count_faults()

    def close(self) -> None:
        """Standby, and the bus given back."""
        if self._closed:
            return
        try:
            self.off()
        finally:
            self._closed = True
            self._drop()

    def counts(self) -> dict[str, int]:
        """`fault.<name>`: of the chip's flags; `reopened`: how often it was lost."""
        return dict(self._counts)

    def _set_up(self) -> None:
        """Check which chip it is, and write and read back what it needs."""
        self._write(REGISTER.enable, REGISTER.standby)
        id_mask, lm3644 = 0x3F, 0x02  # 8.6.12
        kind = self._read(REGISTER.device_id) & id_mask
        if kind != lm3644:
            slower = "an LM3644TT, whose shortest time-out is 40 ms"
            what = slower if kind == REGISTER.lm3644tt else f"id 0x{kind:02x}"
            raise LightsError(f"{self._where}: is {what}; an LM3644 (id 0x{lm3644:02x}) is needed")
        laser, led = self._codes  # bit 7 of LED1's register clear: LED2 has a current of its own (8.6.3)
        timeout_10_ms = 0x10  # 8.6.8: bits 3-0 0000: 10 ms; bits 6-4, the torch's ramp, as after a reset
        wanted = {
            REGISTER.led1_flash: laser,
            REGISTER.led2_flash: led,
            REGISTER.timing: timeout_10_ms,
            REGISTER.enable: REGISTER.standby,
        }
        for register, value in wanted.items():
            self._write(register, value)
        for register, value in wanted.items():
            if (got := self._read(register)) != value:
                raise LightsError(
                    f"{self._where}: register 0x{register:02x} was set to 0x{value:02x} and reads 0x{got:02x}"
                )
        self._count_faults()
        self._ready = True

    def _count_faults(self) -> None:
        for register, names in ((REGISTER.flags1, FAULTS1), (REGISTER.flags2, FAULTS2)):
            flags = self._read(register)
            self._counts.update(f"fault.{name}" for bit, name in enumerate(names.split()) if flags >> bit & 1)

    def _write(self, register: int, value: int) -> None:
        with self._opened() as bus:
            bus.write_byte_data(self._address, register, value)

    def _read(self, register: int) -> int:
        with self._opened() as bus:
            return int(bus.read_byte_data(self._address, register))

    @contextmanager
    def _opened(self) -> Generator[SMBus]:
        """The bus; after an error, maybe of an unplugged adapter, opened again next time."""
        if self._bus is None:
            self._bus = self._locked()
        try:
            yield self._bus
        except OSError as error:
            self._drop()
            raise LightsError(
                f"{self._where}: no answer ({error.strerror or error}); `i2cdetect -y {self._number}` shows who"
                " answers"
            ) from error

    def _drop(self) -> None:
        bus, self._bus, self._ready = self._bus, None, False
        if bus is not None:
            bus.close()

    def _locked(self) -> SMBus:
        """The open bus, locked: each program of lights keeps the limits for itself alone."""
        try:
            bus = SMBus(self._number)
        except FileNotFoundError as error:
            raise LightsError(
                f"I2C bus {self._number}: no /dev/i2c-{self._number}; on a Pi: sudo raspi-config nonint do_i2c 0"
            ) from error
        except PermissionError as error:
            raise LightsError(
                f"I2C bus {self._number}: not allowed; add the user to the group i2c"
            ) from error
        except OSError as error:
            raise LightsError(f"I2C bus {self._number}: cannot be opened: {error.strerror}") from error
        assert bus.fd is not None  # it was opened
        try:
            fcntl.flock(bus.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            bus.close()
            raise LightsError(
                f"I2C bus {self._number}: another phalanx-slave has its lights ({error.strerror}); stop that first"
            ) from error
        return bus


def current_code(current_a: float | None, light: str) -> int:
    """Code of the largest current that is not above `current_a` [A] (8.6.3)."""
    least_a, step_a, most_code = 0.0109, 0.011725, 0x7F  # 8.6.3, 8.6.4: I = code x 11.725 mA + 10.9 mA
    most_a = least_a + most_code * step_a
    if current_a is None or not least_a <= current_a <= most_a:
        has = "missing" if current_a is None else f"{current_a:g}"
        raise LightsError(
            f"--lights i2c: strobe.{light}.current_a of the rig file: {has}; the chip has {least_a:g} to"
            f" {most_a:.2f} A"
        )
    return int((current_a - least_a) / step_a + 1e-9)
