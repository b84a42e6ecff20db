"""Removing leaves nothing; and the hosts begin again, with wheels that are here already."""

from tests.hosts.deployment import FIRST_S, Deployment, differences, first_data
from tests.hosts.measured import Measured
from tests.hosts.rig import Rig

# What systemd makes for any service with DynamicUser= and a state or cache folder, and keeps.
OF_SYSTEMD = ("var/cache/private:", "var/lib/private:", "var/log/private:")
BACKUPS = ("etc/group-:", "etc/gshadow-:")  # of groupdel


def test_uninstall_leaves_nothing_behind(deployed: Deployment, rig: Rig, measured: Measured) -> None:
    ran = rig.uninstall()
    assert ran.code == 0, str(ran)
    measured("uninstall of both", ran.seconds)
    for name, host in rig.fleet.hosts.items():
        changed = differences(deployed.clean[name], host.files())
        left = [line for line in changed if not line.startswith(OF_SYSTEMD + BACKUPS)]
        assert left == [], "\n".join(left)
        # Where the system itself writes, too, so that it is not compared.
        assert host.run("find /run /tmp /var/tmp /var/cache /var/log -iname '*phalanx*'") == ""
        assert host.run("systemctl list-units --all --no-legend 'phalanx*'") == ""
        assert host.run("systemctl --failed --no-legend") == ""
        assert host.processes(host.unit) == []


def test_with_wheels_that_are_here_it_goes_faster(deployed: Deployment, rig: Rig, measured: Measured) -> None:
    ran = rig.deploy()
    assert ran.code == 0, str(ran)
    slowest = max(first_data(rig, ran.began).values())
    within = measured.at_most(
        FIRST_S, "deploy to two clean hosts, wheels here, to both first datagrams", slowest
    )
    assert within, str(ran)


def test_the_master_lost_little_meanwhile(deployed: Deployment, rig: Rig) -> None:
    summary = rig.stop_master()
    counts = summary["counts"]
    assert isinstance(counts, dict)
    assert counts["poses"] > 0
    assert {name: count for name, count in counts.items() if "refused" in name and count > 0} == {}
