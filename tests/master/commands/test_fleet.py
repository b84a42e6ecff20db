"""Who of a fleet streams, waits, is silent or was never heard; and whether a sender is heard at all."""

import os
import threading
from itertools import count
from pathlib import Path

import pytest

from common.calibration import RigCalibration, load
from common.clock import SystemClock
from common.errors import BusError, PhalanxError
from common.messages import Health
from master.commands.fleet import Roll, at_master, expected_devices, here
from slave.uplink import Uplink
from tests.memory_bus import LoopbackBus
from tests.network_helpers import detections, free_udp_port

DESK = load(Path(__file__).parents[3] / "calib_json/rigs/desk.json", RigCalibration)
CLOCK = {"left.clock_offset_us": -12.5, "left.clock_sigma_us": 8.0}


def of_master(second: int, session: int = 1, **received: int) -> Health:
    counts = {f"{name}.received": number for name, number in received.items()}
    return Health("master", session, second * 10**9, counts, dict(CLOCK), "pc", "0.1.0")


def of_slave(name: str, throttled: float = 0.0) -> Health:
    return Health(name, 3, 1, {}, {"temperature_c": 51.0, "throttled": throttled}, f"pi-{name}", "0.2.0")


def test_a_row_shows_machine_version_rate_and_clock() -> None:
    roll = Roll(["left", "right"])
    roll.push(of_master(1, left=100, right=0), 1.0)
    roll.push(of_slave("left", throttled=4.0), 1.5)
    roll.push(of_master(2, left=190, right=0), 2.0)
    left, right, master = roll.devices(2.0)
    assert (left.name, left.state, left.host, left.version) == ("left", "streaming", "pi-left", "0.2.0")
    assert (left.rate_hz, left.offset_us, left.sigma_us) == (90.0, -12.5, 8.0)
    assert (left.temperature_c, left.throttled) == (51.0, True)
    assert (right.state, right.rate_hz, right.host) == ("unknown", 0.0, "")
    assert (master.name, master.state) == ("master", "running")


def test_who_reports_and_sends_nothing_waits_and_who_stops_reporting_is_silent() -> None:
    roll = Roll(["left"])
    roll.push(of_slave("left"), 0.0)
    roll.push(of_master(1, left=7), 0.0)
    roll.push(of_master(2, left=7), 1.0)
    assert roll.devices(1.0)[0].state == "waiting"
    assert roll.devices(9.0)[0].state == "silent"


def test_a_program_that_sends_no_measurements_runs_and_a_camera_without_keys_waits() -> None:
    roll = Roll([])
    roll.push(of_master(1, left=0), 0.0)
    roll.push(of_slave("left"), 0.5)
    roll.push(Health("recorder", 4, 1, {"taken": 9}, {}, "pc", "0.1.0"), 0.5)
    assert {one.name: one.state for one in roll.devices(1.0)} == {
        "left": "waiting",
        "master": "running",
        "recorder": "running",
    }


def test_a_master_that_began_anew_gives_no_rate_of_two_lives() -> None:
    roll = Roll(["left"])
    roll.push(of_master(1, session=1, left=1000), 0.0)
    roll.push(of_master(2, session=2, left=3), 1.0)
    assert roll.devices(1.0)[0].rate_hz is None


def test_those_with_keys_are_expected(tmp_path: Path) -> None:
    (tmp_path / "devices").mkdir()
    for name in ("right", "left"):
        (tmp_path / f"devices/{name}.pem").touch()
    assert expected_devices({"PHALANX_KEYS": str(tmp_path)}) == ["left", "right"]
    assert expected_devices({}) == []


def test_a_master_that_runs_is_asked_what_it_takes() -> None:
    bus, done = LoopbackBus(), threading.Event()
    other = bus.join()

    def master() -> None:
        for second in count(1):
            other.publish("health", "master", of_master(second, left=90 * second, right=0))
            if done.wait(0.02):
                return

    thread = threading.Thread(target=master)
    thread.start()
    try:
        assert at_master(bus, ["left", "right"], 0.5, threading.Event()) == {"left": 90.0}
        with pytest.raises(PhalanxError, match="does not know 'up'"):
            at_master(bus, ["up"], 5.0, threading.Event())
    finally:
        done.set()
        thread.join()


def test_where_no_master_runs_the_start_is_given_and_datagrams_are_counted() -> None:
    key, beacon_port, port = os.urandom(32), free_udp_port(), free_udp_port()
    uplink = Uplink("left", key, SystemClock(), beacon_port, "127.0.0.1")
    done = threading.Event()

    def slave() -> None:
        for seq in count():
            if uplink.started:
                uplink.send(detections("left", uplink.session, seq, SystemClock().now_ns()))
            if done.wait(0.02):
                return

    thread = threading.Thread(target=slave)
    thread.start()
    ends = ("127.255.255.255", beacon_port), ("127.0.0.1", port)
    try:
        received = here(["left"], DESK, key, *ends, 20.0, threading.Event())
        assert set(received) == {"left"}
        assert received["left"] > 0.0
        assert here(["left"], DESK, os.urandom(32), *ends, 1.0, threading.Event()) == {}, "of another rig key"
    finally:
        done.set()
        thread.join()
        uplink.close()
    with pytest.raises(PhalanxError, match="rig 'desk' has no camera or IMU 'up'"):
        here(["up"], DESK, key, *ends, 1.0, threading.Event())
    with pytest.raises(BusError, match="if a master runs here, give its address: --bus ENDPOINT"):
        here(["left"], DESK, key, ends[0], ("192.0.2.1", port), 1.0, threading.Event())
