"""What ends, hangs or is cut off comes back by itself, and how soon."""

import os
import signal
import time

from tests.hosts.deployment import Deployment, streams
from tests.hosts.measured import Measured
from tests.hosts.rig import Rig

KILL_S, HANG_S, LINK_S = 4.0, 10.0, 2.0
CUT_S = 5.0  # how long a cable is out


def test_a_killed_slave_is_back_soon(deployed: Deployment, rig: Rig, measured: Measured) -> None:
    streams(rig)
    host, tap = rig.fleet.hosts["left"], rig.fleet.tap
    begin = time.monotonic()
    os.kill(host.processes(host.unit)[0], signal.SIGKILL)
    time.sleep(KILL_S + 2.0)
    gap = tap.longest_gap_s(host.address, begin)
    within = measured.at_most(KILL_S, "gap after kill -9 of a slave", gap)
    assert within, host.journal()


def test_a_slave_that_hangs_is_ended_by_its_watchdog(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    streams(rig)
    host, tap = rig.fleet.hosts["right"], rig.fleet.tap
    before, begin = host.main_pid(), time.monotonic()
    os.kill(host.processes(host.unit)[0], signal.SIGSTOP)
    time.sleep(0.2)
    back = tap.wait(host.address, begin + 0.2, HANG_S + 5.0)
    assert back is not None, host.journal()
    within = measured.at_most(HANG_S, "gap after SIGSTOP of a slave, by the watchdog", back - begin)
    assert host.main_pid() != before, "it went on by itself: nothing was stopped"
    assert "watchdog" in host.journal(60).lower()
    assert within, host.journal()


def test_after_a_cable_was_out_it_sends_again_at_once(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    streams(rig)
    host, tap = rig.fleet.hosts["left"], rig.fleet.tap
    pid = host.main_pid()
    rig.fleet.set_link(host, up=False)
    cut = time.monotonic()
    time.sleep(CUT_S)
    assert tap.times(host.address, cut + 0.2) == [], "the cable is out, yet something arrives"
    rig.fleet.set_link(host, up=True)
    plugged = time.monotonic()
    back = tap.wait(host.address, plugged, 20.0)
    assert back is not None, host.journal()
    within = measured.at_most(LINK_S, f"back after {CUT_S:g} s without a cable", back - plugged)
    assert within, host.journal()
    assert host.main_pid() == pid, "a cable is no reason to start again"


def test_a_slave_whose_camera_is_bad_is_tried_for_ever(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    streams(rig)
    host, tap = rig.fleet.hosts["right"], rig.fleet.tap
    environment = f"/etc/phalanx/{host.name}.env"
    host.run(f"sed -i.good 's/--camera synthetic/--camera replay:missing/' {environment}")
    try:
        started = host.restarts()
        os.kill(host.processes(host.unit)[0], signal.SIGTERM)
        until = time.monotonic() + 45.0
        # The limit of systemd that has to be off is 5 starts in 10 s.
        while (tries := host.restarts() - started) < 7 and time.monotonic() < until:
            time.sleep(0.5)
        state = host.run(f"systemctl show -p ActiveState --value {host.unit}")
        assert tries >= 7, host.journal()
        assert state in ("activating", "active", "deactivating"), f"systemd gave up: {state}"
    finally:
        host.run(f"mv {environment}.good {environment}")
    mended = time.monotonic()
    back = tap.wait(host.address, mended, 20.0)
    assert back is not None, host.journal()
    within = measured.at_most(KILL_S, f"back after {tries} failed starts, cause mended", back - mended)
    assert within


def test_after_a_power_cut_a_host_sends_by_itself(deployed: Deployment, rig: Rig, measured: Measured) -> None:
    streams(rig)
    host, tap = rig.fleet.hosts["left"], rig.fleet.tap
    host.cut_power()
    begin = time.monotonic()
    host.boot()
    back = tap.wait(host.address, begin, 60.0)
    assert back is not None, host.journal()
    measured("from power to the first datagram", back - begin)
    streams(rig)
