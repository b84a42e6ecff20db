"""What the running service may not do, tried from inside its own sandbox; and what can be read on the network."""

import subprocess
import time
import zlib

import pytest

from tests.hosts.deployment import Deployment, streams
from tests.hosts.fleet import MASTER_PORT, Fleet
from tests.hosts.host import Host
from tests.hosts.measured import Measured, strain
from tests.hosts.rig import BUS_PORT, ROOT, Rig
from tests.hosts.tap import MAGIC, TCP, UDP, captured

UNIT = ROOT / "slave/install/files/phalanx-slave@.service"
CAPTURE_S = 5.0
FIRST_DYNAMIC, LAST_DYNAMIC = 61184, 65519  # users of DynamicUser=, systemd's UIDS-GIDS.md
READABLE = (
    b"thumb",
    b"middle",
    b"little",
    b"markers",
    b"quality",
    b"session",
    b"phalanx/",
    b"camera",
    b"health",
)


@pytest.fixture
def host(deployed: Deployment, rig: Rig) -> Host:
    return rig.fleet.hosts["left"]


def inside(host: Host, command: str) -> subprocess.CompletedProcess[str]:
    """Run a shell command as the slave's user, before the files that the slave sees."""
    pid = host.main_pid()
    user = host.run(f"awk '/^Uid:/ {{print $2}}' /proc/{pid}/status")
    return host.try_run(f"nsenter -t {pid} -m -S {user} -G {user} -- sh -c '{command}'")


def test_it_is_nobody_and_can_become_nobody(host: Host) -> None:
    lines = host.run(f"cat /proc/{host.main_pid()}/status").splitlines()
    status = {key: value.split() for key, _, value in (line.partition(":") for line in lines)}
    assert FIRST_DYNAMIC <= int(status["Uid"][0]) <= LAST_DYNAMIC
    assert len(set(status["Uid"])) == 1
    assert {status[name][0] for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
    assert status["NoNewPrivs"] == ["1"]
    assert status["Seccomp"] == ["2"]


@pytest.mark.parametrize(
    "place",
    ["/opt/phalanx", "/opt/phalanx/current/bin", "/etc/phalanx", "/usr/bin", "/var/lib", "/root", "/home"],
)
def test_it_writes_nowhere(host: Host, place: str) -> None:
    assert inside(host, f"touch {place}/planted").returncode != 0
    assert host.try_run(f"test -e {place}/planted").returncode != 0


def test_it_writes_to_its_state_alone(host: Host) -> None:
    assert inside(host, "touch /var/lib/phalanx/planted && rm /var/lib/phalanx/planted").returncode == 0


def test_it_reads_its_own_keys_and_not_those_of_the_machine(host: Host) -> None:
    folder = f"/run/credentials/{host.unit}"
    assert "PRIVATE KEY" in inside(host, f"cat {folder}/device.key").stdout
    for file in ("rig.key", f"device-{host.name}.key", f"device-{host.name}.secret"):
        assert host.run(f"test -f /etc/phalanx/keys/{file} && echo there") == "there"
        denied = inside(host, f"cat /etc/phalanx/keys/{file}")
        assert denied.returncode != 0
        assert "Permission denied" in denied.stderr
    others = host.try_run(f"nsenter -t {host.main_pid()} -m -S 65534 -G 65534 -- cat {folder}/rig.key")
    assert others.returncode != 0


RECORD = "/opt/phalanx/current/bin/phalanx-slave record --camera service --name {} --frames 5 -o {} 2>&1"


def test_frames_are_for_root_and_group_video_of_the_machine_while_it_tracks(host: Host, rig: Rig) -> None:
    streams(rig)
    assert host.run(f"stat -c '%a %F' /run/phalanx/{host.name}/frames") == "666 socket"
    assert host.run(f"stat -c '%a' /run/phalanx/{host.name}") == "755"
    restarts = host.restarts()
    try:
        output = host.run(RECORD.format(host.name, "/tmp/shared/root"), 60.0)
        assert "5 frames in" in output, output
        assert "0 dropped" in output
        assert len(host.run("tail -n +2 /tmp/shared/root/frames.csv").splitlines()) == 5
        host.run("chmod 777 /tmp/shared")
        for groups, said in (
            ("--clear-groups", "for root and group video"),
            ("--groups video", "5 frames in"),
        ):
            record = RECORD.format(host.name, f"/tmp/shared/{groups.split()[-1]}")
            output = host.try_run(f"setpriv --reuid 65534 --regid 65534 {groups} {record}", 60.0).stdout
            assert said in output, output
    finally:
        host.run("rm -rf /tmp/shared")
    streams(rig)
    assert host.restarts() == restarts
    host.run(f"systemctl restart {host.unit}")
    host.run(f"test -S /run/phalanx/{host.name}/frames")


# The unit with another program, which needs no keys and no groups: it asks for what the strobe asks for.
PROBE = """[Service]
Type=oneshot
WatchdogSec=0
Restart=no
EnvironmentFile=
LoadCredential=
SupplementaryGroups=
ExecStopPost=
ExecStart=
ExecStart=/usr/bin/python3 -c 'import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))'
"""


# With the right to it, the unit's filter of system calls alone forbids it; without, LimitRTPRIO= has to allow it, too.
CAPABLE = "CapabilityBoundingSet=CAP_SYS_NICE\nAmbientCapabilities=CAP_SYS_NICE\n"


@pytest.mark.parametrize("rights", ["", CAPABLE], ids=["none", "CAP_SYS_NICE"])
def test_real_time_is_refused_by_the_unit_and_allowed_by_strobe_conf(fleet: Fleet, rights: str) -> None:
    host, folder = fleet.hosts["left"], "/etc/systemd/system"

    def write(place: str, text: str) -> None:
        host.run(f"mkdir -p {folder}/probe@1.service.d && cat > {folder}/{place} <<'END'\n{text}\nEND")

    write("probe@.service", UNIT.read_text())
    write("probe@1.service.d/probe.conf", PROBE + rights)
    start = "systemctl daemon-reload && systemctl start probe@1.service"
    try:
        assert host.try_run(start).returncode != 0
        log = host.run("journalctl -u probe@1.service -o cat --no-pager")
        assert "PermissionError: [Errno 1] Operation not permitted" in log
        write("probe@1.service.d/strobe.conf", (UNIT.parent / "strobe.conf").read_text())
        if not rights and host.try_run("prlimit --rtprio=10 true").returncode != 0:
            pytest.skip("the second half: RLIMIT_RTPRIO cannot be raised here, no CAP_SYS_RESOURCE")
        host.run(start)
    finally:
        host.run(f"rm -r {folder}/probe@* && systemctl daemon-reload")


def test_a_service_like_it_is_exposed_little(host: Host, measured: Measured) -> None:
    output = host.run(f"systemd-analyze security {host.unit} --no-pager | tail -1")
    exposure = float(output.split(":")[1].split()[0])
    measured("exposure of the running unit, systemd-analyze security", exposure, unit="")
    assert exposure <= 2.5


def test_a_capture_shows_nothing_that_can_be_read(host: Host, rig: Rig, measured: Measured) -> None:
    streams(rig)
    file = rig.folder / "capture.pcap"
    watch = ["tcpdump", "-i", rig.fleet.bridge, "-w", str(file), "-U", "--immediate-mode", "-s", "0"]
    dump = subprocess.Popen(
        [*watch, f"net {rig.fleet.network}.0/24 and not port 22"], stderr=subprocess.DEVNULL
    )
    try:
        time.sleep(1.0)
        host.run(f"systemctl restart --no-block {host.unit}")  # its handshakes, too
        time.sleep(CAPTURE_S)
        streams(rig)
    finally:
        dump.terminate()
        dump.wait()
    content = file.read_bytes()
    assert {word for word in READABLE if word in content} == set()
    packets = captured(file)
    datagrams = [one.payload for one in packets if one.protocol == UDP and one.ports[1] == MASTER_PORT]
    bus = [one.payload for one in packets if one.protocol == TCP and BUS_PORT in one.ports and one.payload]
    measured("captured datagrams of the slaves", len(datagrams), unit="")
    assert len(datagrams) > 30 * CAPTURE_S / strain()
    assert {one[:4] for one in datagrams} == {MAGIC}
    sealed = b"".join(one[28:] for one in datagrams)  # behind the header of docs/wire.md
    assert len(zlib.compress(sealed, 9)) > 0.99 * len(sealed), "it has a pattern, so it is not encrypted"
    # RFC 8446, 5.1: the first byte of a TLS record is its kind; 22: handshake, 23: encrypted.
    kinds = {one[:3] for one in bus}
    assert b"\x16\x03\x01" in kinds, "nobody began a TLS session on the bus"
    assert b"\x17\x03\x03" in kinds, "nothing is encrypted on the bus"
