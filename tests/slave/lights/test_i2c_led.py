"""The LM3644 behind a stand-in bus that has its registers, its time-out, its faults, and can be unplugged."""

import errno
import inspect
import os
from pathlib import Path

import msgspec
import pytest
import smbus2

from common.errors import LightsError
from slave.lights import i2c_led
from slave.lights.i2c_led import FlashDriverLights, current_code
from tests.slave.lights.stage import AMBIENT, LASER, LED, MS, STROBE, SetClock

# Defaults after power-on: SNVSA52E, 8.6.
DEFAULTS = {
    0x01: 0x80,
    0x02: 0x01,
    0x03: 0xBF,
    0x04: 0x3F,
    0x05: 0xBF,
    0x06: 0x3F,
    0x07: 0x09,
    0x08: 0x1A,
    0x09: 0x08,
}


class Chip:
    """What the data sheet says of the chip, as far as a strobe meets it."""

    def __init__(self) -> None:
        self.clock = SetClock()
        self.kind = 0x02
        self.present = True
        self.registers = dict(DEFAULTS)
        self.flags = {0x0A: 0, 0x0B: 0}
        self.since_ns: int | None = None
        self.deaf: set[int] = set()
        self.pulses: list[tuple[str, float]] = []

    def write(self, register: int, value: int) -> None:
        self._time_passes()
        if register in self.deaf:
            return
        if register == 0x01 and self.lit and value & 0x0C != 0x0C:
            self._end()
        self.registers[register] = value
        if register == 0x01 and value & 0x0C == 0x0C:
            if any(self.flags.values()):  # 8.4.5.1: standby until the flags are read
                self.registers[0x01] = value & 0xF0
            else:
                self.since_ns = self.clock.t_ns

    def read(self, register: int) -> int:
        self._time_passes()
        if register in self.flags:
            value, self.flags[register] = self.flags[register], 0
            return value
        return self.kind if register == 0x0C else self.registers[register]

    @property
    def lit(self) -> str:
        """Which outputs carry current."""
        on = self.registers[0x01]
        if on & 0x0C != 0x0C:
            return ""
        return " ".join(name for bit, name in ((1, "laser"), (2, "led")) if on & bit)

    def current_a(self, register: int) -> float:
        return (self.registers[register] & 0x7F) * 0.011725 + 0.0109

    def power_cycle(self) -> None:
        self.registers, self.since_ns = dict(DEFAULTS), None

    def fault(self, register: int, bit: int) -> None:
        self.flags[register] |= 1 << bit
        self.registers[0x01] &= 0xF0
        self.since_ns = None

    def _time_passes(self) -> None:
        timeout_ns = ((self.registers[0x08] & 0x0F) + 1) * 10 * MS  # codes 0 to 9: 8.6.8
        if self.since_ns is not None and self.clock.t_ns - self.since_ns >= timeout_ns:
            self._end(timeout_ns)
            self.fault(0x0A, 0)

    def _end(self, at_most_ns: int = 10**12) -> None:
        assert self.since_ns is not None
        self.pulses.append((self.lit, min(self.clock.t_ns - self.since_ns, at_most_ns) / MS))
        self.since_ns = None


class FakeBus:
    """`smbus2.SMBus` as far as it is used; a chip that is away does not acknowledge."""

    chip: Chip
    opened: list["FakeBus"]
    fails: OSError | None
    node: Path

    def __init__(self, bus: int) -> None:
        if (error := type(self).fails) is not None:
            raise error
        self.closed = False
        self.fd = os.open(self.node, os.O_RDWR)
        type(self).opened.append(self)

    def write_byte_data(self, i2c_addr: int, register: int, value: int, force: bool | None = None) -> None:
        self._acknowledged(i2c_addr)
        self.chip.write(register, value)

    def read_byte_data(self, i2c_addr: int, register: int, force: bool | None = None) -> int:
        self._acknowledged(i2c_addr)
        return self.chip.read(register)

    def close(self) -> None:
        if not self.closed:
            os.close(self.fd)
        self.closed = True

    def _acknowledged(self, address: int) -> None:
        assert not self.closed
        if address != 0x63 or not self.chip.present:
            raise OSError(errno.EREMOTEIO, "Remote I/O error")


@pytest.fixture
def chip(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Chip:
    FakeBus.chip, FakeBus.opened, FakeBus.fails, FakeBus.node = Chip(), [], None, tmp_path / "i2c-1"
    FakeBus.node.touch()
    monkeypatch.setattr(i2c_led, "SMBus", FakeBus)
    return FakeBus.chip


def test_the_stand_in_has_the_signatures_of_the_library() -> None:
    for name in ("write_byte_data", "read_byte_data"):
        real, fake = (inspect.signature(getattr(kind, name)) for kind in (smbus2.SMBus, FakeBus))
        assert list(real.parameters) == list(fake.parameters)


def test_it_is_set_up_dark_with_the_currents_of_the_rig_file(chip: Chip) -> None:
    chip.write(0x01, 0x0F)  # somebody left it lit
    FlashDriverLights("1", STROBE)
    assert chip.lit == ""
    assert STROBE.laser.current_a is not None
    assert STROBE.led.current_a is not None
    for register, wanted_a in ((0x03, STROBE.laser.current_a), (0x04, STROBE.led.current_a)):
        assert wanted_a - 0.011725 < chip.current_a(register) <= wanted_a
    assert chip.registers[0x03] & 0x80 == 0  # else the LEDs had the laser's current
    assert chip.registers[0x08] & 0x0F == 0  # 10 ms


def test_one_light_at_a_time_and_dark_after(chip: Chip) -> None:
    lights = FlashDriverLights("1:0x63", STROBE)
    for kind, seen in ((LASER, "laser"), (AMBIENT, ""), (LED, "led"), (AMBIENT, "")):
        lights.switch(kind)
        assert chip.lit == seen
        chip.clock.t_ns += 3 * MS
    assert chip.pulses == [("laser", 3.0), ("led", 3.0)]
    lights.switch(LED)
    lights.close()
    lights.close()
    assert chip.lit == ""
    assert FakeBus.opened[-1].closed
    lights.switch(LASER)
    assert chip.lit == ""
    assert lights.counts() == {"reopened": 0}


def test_the_chip_ends_a_pulse_that_nobody_ends_and_the_next_one_works(chip: Chip) -> None:
    lights = FlashDriverLights("1", STROBE)
    lights.switch(LASER)
    chip.clock.t_ns += 700 * MS  # the software is gone
    assert chip.read(0x01) & 0x0F == 0
    assert chip.pulses == [("laser", 10.0)]
    lights.off()
    assert lights.counts()["fault.timeout"] == 1
    lights.switch(LED)
    assert chip.lit == "led"


def test_faults_are_counted_by_name_and_cleared(chip: Chip) -> None:
    lights = FlashDriverLights("1", STROBE)
    for register, bit in ((0x0A, 5), (0x0A, 4), (0x0B, 1)):
        lights.switch(LASER)
        chip.fault(register, bit)
        assert chip.lit == ""
        lights.off()
    counts = lights.counts()
    assert (counts["fault.laser_short"], counts["fault.led_short"], counts["fault.overvoltage"]) == (1, 1, 1)
    lights.switch(LASER)
    assert chip.lit == "laser"


def test_an_unplugged_chip_is_an_error_and_is_set_up_again_when_it_returns(chip: Chip) -> None:
    lights = FlashDriverLights("1", STROBE)
    chip.present = False
    for act in (lambda: lights.switch(LASER), lights.off, lambda: lights.switch(LED)):
        with pytest.raises(LightsError, match=r"I2C bus 1, address 0x63: no answer \(Remote I/O error\)"):
            act()
    assert all(bus.closed for bus in FakeBus.opened)
    chip.power_cycle()
    chip.present = True
    lights.switch(LED)
    assert chip.lit == "led"
    assert chip.registers[0x08] & 0x0F == 0
    assert lights.counts()["reopened"] == 1


def test_two_do_not_light_by_one_chip(chip: Chip) -> None:
    first = FlashDriverLights("1", STROBE)
    with pytest.raises(LightsError, match="another phalanx-slave has its lights"):
        FlashDriverLights("1", STROBE)
    assert FakeBus.opened[-1].closed
    first.close()
    FlashDriverLights("1", STROBE).close()


def test_a_chip_that_does_not_go_dark_is_said(chip: Chip) -> None:
    lights = FlashDriverLights("1", STROBE)
    lights.switch(LASER)
    chip.deaf = {0x01}
    with pytest.raises(LightsError, match="was sent to standby, and reports 0x0d: it may be lit"):
        lights.off()


@pytest.mark.parametrize(
    ("kind", "expected"), [(0x04, "LM3644TT, whose shortest time-out is 40 ms"), (0x1A, "id 0x1a")]
)
def test_another_chip_is_refused(chip: Chip, kind: int, expected: str) -> None:
    chip.kind = kind
    with pytest.raises(LightsError, match=expected):
        FlashDriverLights("1", STROBE)


def test_a_register_that_does_not_take_its_value_is_refused(chip: Chip) -> None:
    chip.deaf = {0x08}
    with pytest.raises(LightsError, match="register 0x08 was set to 0x10 and reads 0x1a"):
        FlashDriverLights("1", STROBE)


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (FileNotFoundError(errno.ENOENT, "x"), "no /dev/i2c-1; on a Pi: sudo raspi-config"),
        (PermissionError(errno.EACCES, "x"), "not allowed; add the user to the group i2c"),
        (OSError(errno.EIO, "broken"), "cannot be opened: broken"),
    ],
)
def test_a_bus_that_cannot_be_opened_says_why(chip: Chip, error: OSError, expected: str) -> None:
    FakeBus.fails = error
    with pytest.raises(LightsError, match=expected):
        FlashDriverLights("1", STROBE)


@pytest.mark.parametrize("place", ["", "one", "1:x", "1:0x63:2"])
def test_a_place_that_is_none_is_refused(chip: Chip, place: str) -> None:
    with pytest.raises(LightsError, match="write i2c:BUS"):
        FlashDriverLights(place, STROBE)


def test_currents_are_rounded_down_and_never_guessed() -> None:
    assert current_code(0.0109, "laser") == 0
    assert current_code(0.0109 + 0.011725 * 3, "laser") == 3
    assert current_code(0.0109 + 0.011725 * 3.99, "laser") == 3
    assert current_code(0.0109 + 0.011725 * 127, "led") == 127
    for wrong in (None, 0.001, 2.0):
        with pytest.raises(LightsError, match=r"strobe.laser.current_a of the rig file"):
            current_code(wrong, "laser")
    bare = msgspec.structs.replace(STROBE, led=msgspec.structs.replace(STROBE.led, current_a=None))
    with pytest.raises(LightsError, match=r"strobe.led.current_a of the rig file: missing"):
        FlashDriverLights("1", bare)
