"""The driver of the x-IMU3 on a pseudo terminal: settings, units, gaps, broken bytes, loss and return."""

import os
import threading
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import ImuError
from common.messages import ImuSample
from slave.imu.ximu3 import Kind, SerialPlace, Ximu3Imu, divisor, open_port
from slave.reconnect import ReconnectingDriver
from slave.sources import ImuSource, Reporting
from tests.slave.imu.fake_ximu3 import FakeXimu3

CLOCK = SystemClock()


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that answers is waited for, however busy the machine is."""
    monkeypatch.setattr("slave.imu.ximu3.ANSWER_S", 20.0)


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "ttyACM0"


@pytest.fixture
def device(link: Path) -> Generator[FakeXimu3]:
    fake = FakeXimu3(link)
    yield fake
    fake.unplug()


def opened(link: Path, rate_hz: float = 120.0, baud: int | None = None) -> Ximu3Imu:
    return Ximu3Imu("imu", SerialPlace(str(link), baud), rate_hz, CLOCK, threading.Event())


def samples(imu: ImuSource, count: int) -> list[ImuSample]:
    found = [imu.read() for _ in range(count)]
    return [one for one in found if one is not None]


def test_it_is_given_its_settings_and_they_are_applied_but_not_saved(device: FakeXimu3, link: Path) -> None:
    imu = opened(link)
    assert device.settings == {
        "binarymodeenabled": True,
        "usbdatamessagesenabled": True,
        "serialdatamessagesenabled": True,
        "inertialmessageratedivisor": 3,
        "magnetometermessageratedivisor": 1,
        "temperaturemessageratedivisor": 5,
        "batterymessageratedivisor": 5,
        "ahrsmessageratedivisor": 0,
        "highgaccelerometermessageratedivisor": 0,
        "gyroscopeoffsetcorrectionenabled": False,
    }
    assert device.asked[0] == {"ping": None}
    assert device.asked[-1] == {"apply": None}
    assert {"save": None} not in device.asked
    imu.close()
    imu.close()
    assert imu.read() is None


def test_units_values_that_come_rarely_and_when_it_was_measured(device: FakeXimu3, link: Path) -> None:
    imu = opened(link)
    device.send(Kind.TEMPERATURE, 31.25)
    device.send(Kind.BATTERY, 87.0, 4.1, 0.0)
    device.send(Kind.MAGNETOMETER, 1.0, -0.5, float("nan"))
    device.inertial(2, gyro=(180.0, -90.0, 0.5))
    before_ns = CLOCK.now_ns()
    first, second = samples(imu, 2)
    np.testing.assert_allclose(first.gyro_rad_s, [np.pi, -np.pi / 2, np.radians(0.5)], rtol=1e-7)
    np.testing.assert_allclose(first.accel_m_s2, [0.0, 0.0, 9.80665], rtol=1e-7)
    np.testing.assert_allclose(first.mag_ut, [50.0, -25.0, np.nan])
    assert np.isnan(second.mag_ut).all(), "none has come since"
    assert np.isnan(first.orientation_wxyz).all()
    assert (first.source, first.session, first.seq, second.seq) == ("imu", 0, 0, 1)
    assert second.t_ns - first.t_ns == 7_500_000
    assert second.t_ns <= CLOCK.now_ns()
    assert abs(second.t_ns - before_ns) < 60e9
    assert imu.metrics() == {"temperature_c": 31.25, "battery_percent": 87.0}
    assert imu.counts()["imu.inertial"] == 2
    assert imu.counts()["broken"] == 0
    imu.close()


def test_what_is_lost_on_the_way_is_a_gap_and_what_is_broken_is_counted(
    device: FakeXimu3, link: Path
) -> None:
    imu = opened(link)
    device.inertial()
    device.now_us += 4 * device.period_us
    device.inertial()
    device.write(b"I,1,2\n\xdb\xdb\nhello\n{}\n" + bytes(34) + b"\n")
    device.now_us += device.period_us
    device.send(Kind.INERTIAL, 4000.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # twice its range
    device.now_us += device.period_us
    device.send(Kind.INERTIAL, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, t_us=2**63)
    device.now_us += device.period_us
    device.send(Kind.INERTIAL, float("nan"), 0.0, 0.0, 0.0, 0.0, 1.0)
    device.inertial()
    assert [one.seq for one in samples(imu, 4)] == [0, 5, 8, 9]
    counts = imu.counts()
    assert counts["broken"] == 7
    assert {key: value for key, value in counts.items() if key.startswith("broken.")} == {
        "broken.text": 1,
        "broken.escape": 1,
        "broken.letter": 2,
        "broken.json": 1,
        "broken.value": 1,
        "broken.time": 1,
    }
    imu.close()


def test_a_device_that_speaks_text_is_read_as_well(device: FakeXimu3, link: Path) -> None:
    imu = opened(link)
    for k in range(3):
        device.write(b"I,%d,0.0000,57.2958,0.0000,0.0000,0.0000,-1.0000\r\n" % (6_000_000 + 7500 * k))
    found = samples(imu, 3)
    np.testing.assert_allclose([one.gyro_rad_s[1] for one in found], 1.0, atol=1e-6)
    assert [one.seq for one in found] == [0, 1, 2]
    imu.close()


def test_behind_a_uart_the_wire_takes_its_time(link: Path) -> None:
    device = FakeXimu3(link, interface="Serial")
    imu = opened(link, baud=115200)
    assert {"serial_data_messages_enabled": True} in device.asked
    assert {"usb_data_messages_enabled": True} not in device.asked
    device.inertial()
    [one] = samples(imu, 1)
    assert CLOCK.now_ns() - one.t_ns > 2_900_000, "34 bytes at 115200 baud take 3 ms"
    imu.close()
    device.unplug()


@pytest.mark.parametrize(
    ("behaviour", "expected"),
    [
        ({"mute": True}, "no x-IMU3 answers: is it switched on"),
        (
            {"refuses": "inertial_message_rate_divisor"},
            "refused inertial_message_rate_divisor=3: Unknown key",
        ),
    ],
)
def test_who_does_not_answer_or_refuses_is_reported(
    behaviour: dict[str, object], expected: str, link: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "mute" in behaviour:
        monkeypatch.setattr("slave.imu.ximu3.ANSWER_S", 0.05)
    device = FakeXimu3(link, **behaviour)
    with pytest.raises(ImuError, match=expected):
        opened(link)
    device.unplug()


def test_a_setting_that_older_devices_lack_is_only_reported(
    link: Path, caplog: pytest.LogCaptureFixture
) -> None:
    device = FakeXimu3(link, refuses="gyroscope_offset_correction_enabled")
    opened(link).close()
    assert "refused gyroscope_offset_correction_enabled=False: Unknown key" in caplog.text
    device.unplug()


def test_ports_that_cannot_be_opened_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ImuError, match=r"nowhere cannot be opened: there is no such port; .* --ports"):
        opened(tmp_path / "nowhere")
    locked = FakeXimu3(tmp_path / "locked")
    other = open_port(SerialPlace(str(tmp_path / "locked")))
    with pytest.raises(ImuError, match="another program has it open"):
        opened(tmp_path / "locked")
    other.close()
    locked.unplug()
    (tmp_path / "file").write_text("no terminal")
    with pytest.raises(ImuError, match="file cannot be opened"):
        opened(tmp_path / "file")

    def forbidden(_place: SerialPlace) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("slave.imu.ximu3.open_port", forbidden)
    with pytest.raises(ImuError, match="dialout"):
        opened(tmp_path / "x")


@pytest.mark.parametrize(
    ("rate_hz", "expected"), [(400.0, 1), (201.0, 1), (200.0, 2), (120.0, 3), (100.0, 4)]
)
def test_the_rate_is_the_next_above(rate_hz: float, expected: int) -> None:
    assert divisor(rate_hz) == expected


def test_a_rate_it_does_not_have_is_refused() -> None:
    with pytest.raises(ImuError, match="at most 400 Hz"):
        divisor(500.0)


def reconnecting(link: Path, stop: threading.Event) -> ReconnectingDriver[ImuSample]:
    def opener() -> Ximu3Imu:
        return Ximu3Imu("imu", SerialPlace(str(link)), 120.0, CLOCK, stop)

    return ReconnectingDriver("IMU", opener, CLOCK, stop, rate_hz=400.0 / 3.0)


def test_unplugged_it_is_lost_and_plugged_in_again_it_is_back(link: Path) -> None:
    device = FakeXimu3(link)
    imu = reconnecting(link, threading.Event())
    device.inertial(3)
    before = samples(imu, 3)
    device.unplug()
    back = threading.Thread(target=lambda: _return(link))
    back.start()
    after = samples(imu, 2)  # nothing in between is made up
    back.join()
    gap = after[0].seq - before[-1].seq
    assert gap == max(1, round((after[0].t_ns - before[-1].t_ns) * 1e-9 * 400.0 / 3.0)) > 1
    assert after[1].seq == after[0].seq + 1
    assert isinstance(imu, Reporting)
    counts = imu.counts()
    assert (counts["lost"], counts["back"], counts["imu.inertial"]) == (1, 1, 5)
    assert imu.metrics()["away_s"] == 0.0
    imu.close()


def _return(link: Path) -> FakeXimu3:
    device = FakeXimu3(link, begins_us=0)
    while not device.applied:
        os.sched_yield()
    device.inertial(2)
    return device


def test_a_reboot_is_a_loss_and_its_settings_are_written_again(device: FakeXimu3, link: Path) -> None:
    imu = reconnecting(link, threading.Event())
    device.inertial(3)
    assert len(samples(imu, 3)) == 3
    device.now_us = 0
    device.settings["inertialmessageratedivisor"] = 8
    device.applied = 0
    device.inertial(3)

    def go_on() -> None:
        while not device.applied:
            os.sched_yield()
        device.inertial(1)

    back = threading.Thread(target=go_on)
    back.start()
    [after] = samples(imu, 1)
    back.join()
    assert device.settings["inertialmessageratedivisor"] == 3
    assert after.seq > 3
    assert imu.counts()["lost"] == 1
    assert imu.counts()["broken.time"] == 2
    imu.close()


def test_while_it_is_away_the_slave_can_be_stopped(link: Path) -> None:
    stop = threading.Event()
    device = FakeXimu3(link)
    imu = reconnecting(link, stop)
    device.unplug()
    threading.Timer(0.1, stop.set).start()
    assert imu.read() is None
    assert imu.counts()["lost"] == 1
    assert imu.metrics()["away_s"] > 0.0
    imu.close()


def test_one_that_falls_silent_is_lost(
    device: FakeXimu3, link: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slave.imu.ximu3.SILENT_READS", 2)
    imu = opened(link)
    device.inertial(1)
    assert len(samples(imu, 1)) == 1
    with pytest.raises(ImuError, match="sends no samples any more"):
        imu.read()
    imu.close()
