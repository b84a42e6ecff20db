"""The same tool on a whole emulated arm64 machine: kernel, systemd, sshd; a slave that streams, dies, and comes back.

A processor under emulation is some twenty times slower than a Pi's: how long things take is written to out/board.json,
and held only to what an emulated board can be held to.
"""

import time
from collections.abc import Iterator

import pytest

from tests.hosts.board import ARM64, BoardRig, switched_on
from tests.hosts.measured import Measured, kept
from tests.hosts.rig import ROOT, Ran

PATIENCE_S = 900.0  # for a deployment on a busy machine
REBOOT_S = 60.0  # from the command to the first datagram, of a board that has the machine for itself


@pytest.fixture(scope="session")
def measured() -> Iterator[Measured]:
    """Where numbers go."""
    yield from kept(ROOT / "out" / "board.json")


@pytest.fixture(scope="module")
def rig(measured: Measured) -> Iterator[BoardRig]:
    """The board, on, with nothing of ours on it, and a master that waits for it."""
    with switched_on(ARM64, "board", measured) as one:
        one.start_master()
        yield one


@pytest.fixture(scope="module")
def deployed(rig: BoardRig, measured: Measured) -> Ran:
    """The deployment; it waits for the first datagram itself, and fails without."""
    ran = rig.deploy("--ready-s", str(PATIENCE_S / 2), "--wait-s", str(PATIENCE_S / 4), timeout_s=PATIENCE_S)
    measured("deploy to the clean board, nothing loaded before", ran.seconds)
    return ran


def first_data(rig: BoardRig, since: float) -> float:
    """Time from `since` to the first datagram [s]; fails without one."""
    first = rig.board.tap.wait(rig.board.address, since, PATIENCE_S / 4)
    assert first is not None, rig.board.journal() + rig.board.console()
    return first - since


def until_silent(rig: BoardRig, silence_s: float = 3.0) -> None:
    """Wait until nothing has come for a while."""
    until = time.monotonic() + 300.0
    while rig.board.tap.times(rig.board.address, time.monotonic() - silence_s):
        assert time.monotonic() < until, "it goes on sending, so it does not reboot"
        time.sleep(0.1)


def test_the_board_is_an_arm64_debian(rig: BoardRig) -> None:
    assert rig.board.run("uname -m") == "aarch64"
    assert rig.board.run("systemctl --failed --no-legend --plain") == ""


def test_one_command_and_it_streams(deployed: Ran, rig: BoardRig, measured: Measured) -> None:
    assert deployed.code == 0, f"{deployed}\n{rig.board.journal()}"
    measured("  ... to its first datagram", first_data(rig, deployed.began))
    measured("datagrams", rig.board.tap.rate_hz(rig.board.address, 5.0), "Hz")
    assert rig.board.tap.wait(rig.board.address, time.monotonic(), 60.0) is not None
    python = "/opt/phalanx/current/bin/python"
    assert rig.board.run(f"{python} -c 'import platform, cv2, zenoh; print(platform.machine())'") == "aarch64"


def test_a_killed_slave_is_back(deployed: Ran, rig: BoardRig, measured: Measured) -> None:
    before = rig.board.main_pid()
    assert before > 0
    rig.board.run(f"kill -9 {before}")
    killed = time.monotonic()
    time.sleep(0.5)  # what was on its way arrives
    measured("gap after kill -9", first_data(rig, killed + 0.5) + 0.5)
    assert rig.board.main_pid() not in (0, before)


def test_after_a_reboot_it_streams_by_itself(deployed: Ran, rig: BoardRig, measured: Measured) -> None:
    boot = rig.board.run("cat /proc/sys/kernel/random/boot_id")
    begin, had = time.monotonic(), rig.board.processor_s()
    rig.board.try_run("systemctl reboot")
    until_silent(rig)
    silent = time.monotonic()
    took = first_data(rig, silent) + silent - begin
    measured("  ... processor time of this machine that the board had of it", rig.board.processor_s() - had)
    assert rig.board.run("cat /proc/sys/kernel/random/boot_id") != boot
    assert measured.at_most(REBOOT_S, "reboot, from the command to the first datagram", took), (
        rig.board.journal()
    )


def test_uninstall_leaves_nothing(deployed: Ran, rig: BoardRig, measured: Measured) -> None:
    ran = rig.uninstall()
    assert ran.code == 0, str(ran)
    measured("uninstall", ran.seconds)
    left = "ls -d /opt/phalanx /etc/phalanx /etc/systemd/system/phalanx-slave@.service 2>/dev/null"
    assert rig.board.try_run(left).stdout == ""
    assert rig.board.run("systemctl list-units --all --no-legend 'phalanx-slave@*'") == ""
