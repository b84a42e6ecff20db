"""A version that does not run, one that runs and says nothing, a good one, a host that is off, a disk that is full."""

import time
from pathlib import Path

from tests.hosts.deployment import Deployment, differences, streams
from tests.hosts.host import Host
from tests.hosts.measured import Measured
from tests.hosts.rig import Ran, Rig, changed_wheels

CANNOT_START = """import sys


def main(arguments=None):
    print("phalanx-slave: planted: this version cannot start", file=sys.stderr)
    return 1
"""
DOES_NOT_LOAD = "import planted_and_missing\n"
SAYS_NOTHING = """import os
import socket
import time


def main(arguments=None):
    manager, address = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM), os.environ["NOTIFY_SOCKET"]
    told = "READY=1"
    while True:
        manager.sendto(told.encode(), address)
        told = "WATCHDOG=1"
        time.sleep(1.0)
"""
HANGS = """import time


def main(arguments=None):
    time.sleep(1e6)
"""
SILENT_S, HANGS_S = 12.0, 16.0  # of stream that such a version may cost
DEADLINE_S = 150.0  # of a host; the one that is off is given up long before


NOTES = "opt/phalanx/before"  # what can be taken back; it has been


def release(host: Host) -> str:
    return host.run("readlink /opt/phalanx/current")


def last_line(ran: Ran) -> str:
    return ran.err.strip().splitlines()[-1]


def refused(rig: Rig, name: str, wheelhouse: Path, measured: Measured, gap_s: float = 60.0) -> Ran:
    """Deploy to one host a version that is no good; everything on it has to be as before, after `gap_s` at most."""
    host, tap = rig.fleet.hosts[name], rig.fleet.tap
    streams(rig, name)
    before, files, begin = release(host), host.files(), time.monotonic()
    ran = rig.deploy("--wheelhouse", str(wheelhouse), targets=(f"{name}={host.login}",))
    assert ran.code == 1, str(ran)
    assert release(host) == before, str(ran)
    changed = [line for line in differences(files, host.files()) if not line.startswith(NOTES)]
    assert changed == [], "\n".join(changed)
    streams(rig, name)
    measured(f"... refused after, of {wheelhouse.name}", ran.seconds)
    gap = tap.longest_gap_s(host.address, begin)
    assert measured.at_most(gap_s, f"... longest gap, of {wheelhouse.name}", gap), str(ran)
    return ran


def test_a_version_that_does_not_load_interrupts_nothing(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    host, pid = rig.fleet.hosts["left"], rig.fleet.hosts["left"].main_pid()
    bad = changed_wheels(rig.cache, rig.folder / "does not load", "89.0", {"slave/live.py": DOES_NOT_LOAD})
    ran = refused(rig, "left", bad, measured)
    assert "planted_and_missing" in last_line(ran), str(ran)
    assert host.main_pid() == pid


def test_a_version_that_cannot_start_is_taken_back(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    bad = changed_wheels(rig.cache, rig.folder / "cannot start", "90.0", {"slave/__main__.py": CANNOT_START})
    ran = refused(rig, "left", bad, measured)
    assert "planted: this version cannot start" in last_line(ran), str(ran)


def test_a_version_that_sends_nothing_is_taken_back(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    bad = changed_wheels(rig.cache, rig.folder / "sends nothing", "91.0", {"slave/__main__.py": SAYS_NOTHING})
    ran = refused(rig, "right", bad, measured, SILENT_S)
    assert "no datagram of right" in last_line(ran), str(ran)


def test_a_version_that_hangs_before_it_is_ready_is_taken_back(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    bad = changed_wheels(rig.cache, rig.folder / "hangs", "91.5", {"slave/__main__.py": HANGS})
    ran = refused(rig, "left", bad, measured, HANGS_S)
    assert "phalanx-slave@left.service is not ready after" in last_line(ran), str(ran)
    assert "it reports nothing; everything is as before" in last_line(ran), str(ran)


def test_a_full_disk_is_reported_and_nothing_stops(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    host, tap = rig.fleet.hosts["left"], rig.fleet.tap
    good = changed_wheels(rig.cache, rig.folder / "disk full", "92.0", {})
    streams(rig, "left")
    before, begin, pid = release(host), time.monotonic(), host.main_pid()
    host.run("fallocate -l $(($(df --output=avail -B1 / | tail -1) - 20000000)) /var/filler")
    try:
        ran = rig.deploy("--wheelhouse", str(good), targets=(f"left={host.login}",))
    finally:
        host.run("rm /var/filler")
    assert ran.code == 1, str(ran)
    assert "No space left on device" in last_line(ran) or "MB free" in last_line(ran), str(ran)
    assert (release(host), host.main_pid()) == (before, pid)
    gap = tap.longest_gap_s(host.address, begin)
    assert measured.at_most(1.0, "longest gap while the disk is full and a version refused", gap)


def test_a_host_that_is_off_does_not_keep_the_other_from_a_new_version(
    deployed: Deployment, rig: Rig, measured: Measured
) -> None:
    left, right = rig.fleet.hosts["left"], rig.fleet.hosts["right"]
    good = changed_wheels(rig.cache, rig.folder / "good", "93.0", {})
    left.cut_power()
    try:
        ran = rig.deploy("--wheelhouse", str(good), "--deadline", str(DEADLINE_S))
    finally:
        left.boot()
    measured("a deployment, one of two hosts off", ran.seconds)
    assert ran.code == 1, str(ran)
    assert ran.seconds <= DEADLINE_S
    failures = [line for line in ran.err.splitlines() if "FAILED" in line]
    assert len(failures) == 1, str(ran)
    assert left.address in failures[0], str(ran)
    assert release(right).startswith("releases/93.0-")
    assert release(left).startswith(f"releases/{rig.version}-")
    streams(rig)


def test_a_good_version_comes_and_goes_back(deployed: Deployment, rig: Rig, measured: Measured) -> None:
    before = {name: release(rig.fleet.hosts["left"]) for name in rig.fleet.hosts}
    begin = time.monotonic()
    ran = rig.deploy("--wheelhouse", str(rig.folder / "good"))
    assert ran.code == 0, str(ran)
    gap = max(rig.fleet.tap.longest_gap_s(host.address, begin) for host in rig.fleet.hosts.values())
    measured("longest gap of a good new version", gap)
    assert all(release(host).startswith("releases/93.0-") for host in rig.fleet.hosts.values())
    streams(rig)
    would = rig.rollback("--dry-run")
    assert would.code == 0, str(would)
    assert all(
        f"would go back to {one.replace('releases/', 'release ')}" in would.out for one in before.values()
    )
    assert all(release(host).startswith("releases/93.0-") for host in rig.fleet.hosts.values())
    begin = time.monotonic()
    back = rig.rollback()
    assert back.code == 0, str(back)
    measured("going back to the version before", back.seconds)
    gap = max(rig.fleet.tap.longest_gap_s(host.address, begin) for host in rig.fleet.hosts.values())
    measured("longest gap of going back", gap)
    assert {name: release(host) for name, host in rig.fleet.hosts.items()} == before, str(back)
    streams(rig)
    again = rig.rollback()
    assert again.code == 1, str(again)
    assert again.err.count("there is no earlier installation to go back to") == len(before), str(again)
    streams(rig)
