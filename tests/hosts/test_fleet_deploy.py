"""Two hosts from clean to their first datagrams by one command; the same command again changes nothing."""

import time

from tests.hosts.deployment import FIRST_S, Deployment, streams
from tests.hosts.measured import Measured, strain
from tests.hosts.rig import RATE_HZ, Rig


def test_a_dry_run_says_what_it_would_do_and_writes_nothing(deployed: Deployment) -> None:
    assert deployed.dry.code == 0, str(deployed.dry)
    assert "phalanx-slave@left.service" in deployed.dry.out, str(deployed.dry)
    assert deployed.dry_changed == {"left": [], "right": []}


def test_two_clean_hosts_send_after_one_command(deployed: Deployment, rig: Rig, measured: Measured) -> None:
    assert deployed.ran.code == 0, str(deployed.ran)
    measured("deploy to two clean hosts, nothing loaded before", deployed.ran.seconds)
    slowest = max(deployed.first_s.values())
    within = measured.at_most(FIRST_S, "  ... to the first datagrams of both", slowest)
    assert within, str(deployed.ran)
    streams(rig)


def test_both_send_as_fast_as_their_cameras_see(deployed: Deployment, rig: Rig, measured: Measured) -> None:
    for name, host in rig.fleet.hosts.items():
        rate = rig.fleet.tap.rate_hz(host.address, 2.0)
        measured(f"datagrams of {name}", rate, "Hz")
        assert rate > 0.8 * RATE_HZ / strain()


def test_the_same_command_again_changes_nothing(deployed: Deployment, rig: Rig, measured: Measured) -> None:
    hosts = rig.fleet.hosts
    before = {name: (host.main_pid(), host.files(), host.changes()) for name, host in hosts.items()}
    begin = time.monotonic()
    again = rig.deploy()
    assert again.code == 0, str(again)
    for name, host in hosts.items():
        pid, files, changes = before[name]
        assert host.main_pid() == pid, f"{name} was restarted: {again}"
        assert host.files() == files
        assert {path: at for path, at in host.changes().items() if changes.get(path) != at} == {}
        measured(f"longest gap of {name} meanwhile", rig.fleet.tap.longest_gap_s(host.address, begin))
    measured("the same deployment again", again.seconds)


def test_the_fleet_is_listed_by_name_and_version(deployed: Deployment, rig: Rig) -> None:
    output = rig.program(
        "master", "fleet", "status", "--bus", rig.bus, "--keys", str(rig.keys), timeout_s=20.0
    )
    assert output.code == 0, str(output)
    for name in rig.fleet.hosts:
        line = next((line for line in output.out.splitlines() if name in line), None)
        assert line is not None, str(output)
        assert rig.version in line, str(output)
