"""The driver of the LSM6DSOX on a bus with its register map: settings, scale, stamps, gaps, loss and return."""

import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from smbus2 import SMBus

from common.clock import Clock
from common.errors import ImuError
from common.messages import ImuSample
from slave.imu.lsm6dsox import (
    SILENT_POLLS,
    I2cPlace,
    Lsm6dsoxImu,
    Register,
    Slots,
    buses,
    rate_of,
    temperature_c,
)
from slave.reconnect import ReconnectingDriver
from tests.slave.imu.fake_i2c import FakeLsm6dsox

PLACE = I2cPlace(1)


class Dispatcher(threading.Event, Clock):
    """A clock that waiting moves on, and with it a part that measures."""

    def __init__(self, part: FakeLsm6dsox) -> None:
        super().__init__()
        self.part, self.t_ns, self.epoch_ns = part, 70_000_000_000, 70_000_000_000
        self.measured = 0

    def now_ns(self) -> int:
        self.t_ns += 100_000  # a transfer takes its time
        return self.t_ns

    def wait(self, timeout: float | None = None) -> bool:
        self.t_ns += round((timeout or 0.0) * 1e9)
        while self.part.plugged and self.due():
            self.part.measure()
            self.measured += 1
        return self.is_set()

    def due(self) -> bool:
        if self.part.registers.get(Register.FIFO_CTRL4) != 0x46:
            self.measured = self.now_samples()
            return False
        return self.measured < self.now_samples()

    def now_samples(self) -> int:
        rate = 208.34375 * (1.0 + 0.0015 * self.part.fine)
        return int((self.t_ns - self.epoch_ns) * 1e-9 * rate)


def opened(part: FakeLsm6dsox, world: Dispatcher | None = None, place: I2cPlace = PLACE) -> Lsm6dsoxImu:
    world = Dispatcher(part) if world is None else world
    return Lsm6dsoxImu("imu", place, 120.0, world, world, part)


def samples(imu: Lsm6dsoxImu | ReconnectingDriver[ImuSample], count: int) -> Iterator[ImuSample]:
    for _ in range(count):
        sample = imu.read()
        assert sample is not None
        yield sample


def test_it_is_reset_and_given_its_settings() -> None:
    part = FakeLsm6dsox()
    part.registers[Register.CTRL1_XL] = 0xFF  # what another program left
    imu = opened(part)
    has = {register.name: part.registers[register] for register in Register if register in part.registers}
    assert (
        has | {"CTRL1_XL": 0x54, "CTRL2_G": 0x5C, "CTRL3_C": 0x44, "FIFO_CTRL3": 0x55, "FIFO_CTRL4": 0x46}
        == has
    )
    assert has["CTRL10_C"] == 0x20, "time stamps"
    imu.close()
    assert part.closed == 1
    assert imu.read() is None


def test_samples_have_the_units_of_the_data_sheet_and_the_times_of_its_stamps() -> None:
    part = FakeLsm6dsox()
    imu = opened(part)
    part.temperature = 256 * 6 + 128
    part.measure(1, gyro=(1000, -2000, 32767), accel=(0, -1000, 2049))
    [first] = samples(imu, 1)
    np.testing.assert_allclose(first.gyro_rad_s, [np.radians(70.0), np.radians(-140.0), np.nan], rtol=1e-12)
    np.testing.assert_allclose(first.accel_m_s2, np.array([0.0, -0.488, 0.999912]) * 9.80665, rtol=1e-12)
    assert np.isnan([*first.mag_ut, *first.orientation_wxyz]).all()
    assert imu.counts()["clipped"] == 1
    assert imu.metrics() == {"temperature_c": 31.5}
    rest = [*samples(imu, 400)]
    periods_ms = np.diff([one.t_ns for one in rest]) * 1e-6
    true_ms = 1e3 / (208.34375 * (1.0 - 7 * 0.0015))  # as its fine frequency says, 1 % off
    assert np.mean(periods_ms[50:]) == pytest.approx(true_ms, rel=1e-3)
    off_ms = np.abs(periods_ms - true_ms)  # steps are where the line below the lags still sinks
    assert np.percentile(off_ms, 90) < 0.1, "though it is looked every 4 ms only"
    assert off_ms.max() < 2.5
    assert [one.seq for one in rest] == list(range(1, 401))
    assert imu.counts()["broken"] == 0


def test_what_overran_is_a_gap_and_what_is_broken_is_counted() -> None:
    part = FakeLsm6dsox()
    world = Dispatcher(part)
    imu = opened(part, world)
    [first] = samples(imu, 1)
    world.t_ns += 2_000_000_000  # the machine stood still: 412 samples, and the FIFO has room for 170
    world.wait()
    late = [*samples(imu, 170)]
    assert late[0].seq - first.seq == pytest.approx(412 - 170, abs=3)
    assert np.diff([one.seq for one in late]).max() == 1
    assert imu.counts()["imu.overrun"] == 1
    assert late[-1].t_ns - first.t_ns == pytest.approx(2e9, abs=2e7)
    broken = imu.counts()["broken"]  # the slot of which words were replaced
    part.slot = (part.slot + 1) % 4
    part.word(1, bytes(6), flip=0x40)  # a tag that was hit
    part.word(2, bytes(6))
    part.measure(1)
    [after] = samples(imu, 1)
    assert after.seq > late[-1].seq
    assert imu.counts()["broken.parity"] == 1
    assert imu.counts()["broken"] == broken + 2, "the tag, and the slot it leaves incomplete"


@pytest.mark.parametrize(("rate_hz", "expected"), [(1.0, 1), (104.0, 4), (104.2, 5), (120.0, 5), (400.0, 6)])
def test_the_rate_is_the_next_above(rate_hz: float, expected: int) -> None:
    assert rate_of(rate_hz).code == expected


def test_the_impossible_is_reported() -> None:
    with pytest.raises(ImuError, match=r"imu.rate_hz: 800 Hz: .* at most 417 Hz"):
        rate_of(800.0)
    with pytest.raises(
        ImuError, match=r"I2C bus 1, address 0x6a: WHO_AM_I is 0xea, ICM-20948; an LSM6DSOX reports 0x6c"
    ):
        opened(FakeLsm6dsox(identity=0xEA))
    with pytest.raises(ImuError, match=r"I2C bus 1, address 0x6b: nobody answers: .*i2cdetect -y 1"):
        opened(FakeLsm6dsox(), place=I2cPlace(1, 0x6B))
    part = FakeLsm6dsox()
    part.stuck = {Register.CTRL2_G: 0x50}
    with pytest.raises(ImuError, match="register CTRL2_G has 0x50, 0x5c was written"):
        opened(part)
    assert part.closed == 1
    with pytest.raises(ImuError, match=r"I2C bus 99, address 0x6a: there is no /dev/i2c-99: is I2C on\?"):
        Lsm6dsoxImu("imu", I2cPlace(99), 120.0, Dispatcher(part), threading.Event())

    def forbidden(_bus: int) -> SMBus:
        raise PermissionError(13, "Permission denied")

    with pytest.raises(ImuError, match="usermod -aG i2c"):
        Lsm6dsoxImu("imu", PLACE, 120.0, Dispatcher(part), threading.Event(), forbidden)


def test_wires_that_come_off_are_a_loss_and_it_comes_back() -> None:
    part = FakeLsm6dsox()
    world = Dispatcher(part)
    imu = ReconnectingDriver(
        "IMU", lambda: Lsm6dsoxImu("imu", PLACE, 120.0, world, world, part), world, world, rate_hz=208.34375
    )
    before = [*samples(imu, 50)]
    part.plugged = False
    lost_ns = world.t_ns
    plain = world.wait

    def wait(timeout: float | None = None) -> bool:
        if world.t_ns - lost_ns > 5_000_000_000 and not part.plugged:
            part.plugged = True
            part.power_up()
        return plain(timeout)

    world.wait = wait
    after = [*samples(imu, 50)]
    away_s = (after[0].t_ns - before[-1].t_ns) * 1e-9
    assert 5.0 < away_s < 8.0
    assert after[0].seq - before[-1].seq == round(away_s * 208.34375)
    counts = imu.counts()
    assert (counts["lost"], counts["back"]) == (1, 1)
    assert part.registers[Register.CTRL2_G] == 0x5C, "written again"
    imu.close()
    assert part.opened == part.closed > 2


def test_one_that_measures_no_more_is_lost() -> None:
    part = FakeLsm6dsox()
    imu = opened(part)
    part.registers[Register.FIFO_CTRL4] = 0
    part.fifo.clear()
    with pytest.raises(ImuError, match="measures no more"):
        imu.read()
    assert SILENT_POLLS == 250


def test_a_reset_by_a_weak_supply_is_a_loss() -> None:
    part = FakeLsm6dsox()
    imu = opened(part)
    [*_] = samples(imu, 20)
    part.ticks = 0  # begins anew, and some other program lets it measure
    part.fifo.clear()
    part.measure(3)
    with pytest.raises(ImuError, match="began anew"):
        list(samples(imu, 4))


def word(what: int, slot: int, data: bytes) -> bytes:
    tag = what << 3 | slot << 1
    return bytes([tag | tag.bit_count() % 2]) + data


def test_stamps_wrap_after_thirty_hours() -> None:
    slots = Slots()
    ticks = [2**32 - 384, 2**32 - 192, 0, 192]
    data = b"".join(
        word(1, k, bytes(6)) + word(4, k, struct.pack("<IH", tick, 0)) + word(2, k, bytes(6))
        for k, tick in enumerate(ticks)
    )
    assert np.diff([one.ticks for one in slots.push(data)]).tolist() == [192, 192, 192]


@given(st.binary(max_size=700))
def test_any_words_give_whole_slots_or_are_counted(data: bytes) -> None:
    slots = Slots()
    for one in slots.push(data):
        assert one.gyro_rad_s.shape == one.accel_m_s2.shape == (3,)
    good = b"".join(word(what, slot, bytes(6)) for slot in (0, 1) for what in (1, 2, 4))
    assert list(slots.push(good))[-1].gyro_rad_s.tolist() == [0.0, 0.0, 0.0], "whatever came before"


def test_temperature_is_that_of_the_data_sheet() -> None:
    assert temperature_c(struct.pack("<h", 0)) == 25.0
    assert temperature_c(struct.pack("<h", -256)) == 24.0


def test_buses_are_found(tmp_path: Path) -> None:
    (tmp_path / "i2c-1").touch()
    (tmp_path / "null").touch()
    assert buses(tmp_path) == ["1"]
