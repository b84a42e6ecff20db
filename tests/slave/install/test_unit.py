"""The unit and what stands beside it, as far as they can be tried without a device: systemd's own checks."""

import re
import subprocess
import sys
import zipfile
from importlib import resources
from pathlib import Path

import pytest

from slave.doctor.devices import GROUPS
from tests.programs import needs

ROOT = Path(__file__).resolve().parents[3]
FILES = resources.files("slave.install") / "files"
UNIT, STROBE = (
    FILES / "phalanx-slave@.service",
    FILES / "strobe.conf",
)  # the second: of a slave that switches lights
MOST_EXPOSED = 25  # of 250; systemd-analyze counts in tenths
# What the unit mentions, so that nothing of this machine's own systemd takes part.
TARGETS = ("sysinit", "basic", "shutdown", "multi-user", "network")
PROGRAMS = ("opt/phalanx/current/bin/phalanx-slave", "bin/sh")


def settings(text: str) -> list[tuple[str, str]]:
    return [(key, value) for key, value in re.findall(r"^(\w+)=(.*)$", text, re.MULTILINE)]


def verified(tmp_path: Path, text: str, strobe: str = "") -> str:
    """What systemd says about this text as our unit, and its drop-in: nothing, or what is wrong."""
    needs("systemd-analyze")
    units = tmp_path / "etc/systemd/system"
    units.mkdir(parents=True)
    for name in TARGETS:
        (units / f"{name}.target").write_text("[Unit]\nDescription=of the test\n")
    (units / "system.slice").write_text("[Slice]\n")
    for program in PROGRAMS:
        path = tmp_path / program
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("#!/bin/sh\n")
        path.chmod(0o755)
    (units / "phalanx-slave@.service").write_text(text)
    if strobe:
        (units / "phalanx-slave@left.service.d").mkdir()
        (units / "phalanx-slave@left.service.d/strobe.conf").write_text(strobe)
    command = ["systemd-analyze", "verify", "--man=no", f"--root={tmp_path}", "phalanx-slave@left.service"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return done.stderr + done.stdout + ("" if done.returncode == 0 else f"exit {done.returncode}")


@pytest.mark.parametrize("strobe", ["", STROBE.read_text()], ids=["plain", "strobe"])
def test_systemd_has_nothing_to_say_about_the_unit(tmp_path: Path, strobe: str) -> None:
    assert verified(tmp_path, UNIT.read_text(), strobe) == ""


def test_a_slip_in_the_drop_in_would_be_said(tmp_path: Path) -> None:
    assert "strobe.conf:5: Failed" in verified(
        tmp_path, UNIT.read_text(), STROBE.read_text().replace("=10", "=ten")
    )


@pytest.mark.parametrize(
    ("old", "new", "output"),
    [
        ("WatchdogSec", "WatchdogSek", "Unknown key 'WatchdogSek'"),
        ("char-i2c", "chor-i2c", "chor-i2c"),
        ("MemorySwapMax=0", "MemorySwapMax=none", "Invalid memory limit"),
        ("current/bin/phalanx-slave run", "current/bin/phalanx", "not executable"),
    ],
)
def test_a_slip_in_the_unit_would_be_said(tmp_path: Path, old: str, new: str, output: str) -> None:
    text = UNIT.read_text()
    assert old in text
    assert output in verified(tmp_path, text.replace(old, new, 1))


@pytest.mark.parametrize(("drop", "passes"), [(None, True), ("SystemCallFilter", False)])
@pytest.mark.parametrize("strobe", [False, True])
def test_exposure_of_the_unit(tmp_path: Path, strobe: bool, drop: str | None, passes: bool) -> None:
    needs("systemd-analyze")
    text = UNIT.read_text()
    if strobe:  # what comes later counts, as in a drop-in
        text = text.replace("[Install]", f"{STROBE.read_text()}\n[Install]")
    unit = tmp_path / "phalanx-slave@.service"
    unit.write_text(text if drop is None else re.sub(rf"^{drop}=.*$", "", text, flags=re.MULTILINE))
    done = subprocess.run(
        [
            "systemd-analyze",
            "security",
            "--no-pager",
            "--offline=true",
            f"--threshold={MOST_EXPOSED}",
            str(unit),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode == 0) is passes, done.stdout[-200:] + done.stderr


def test_the_call_that_asks_for_real_time_passes_the_filter_of_system_calls() -> None:
    needs("systemd-analyze")

    def calls(name: str) -> set[str]:
        command = ["systemd-analyze", "syscall-filter", "--no-pager", name]
        lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
        words = {line.strip() for line in lines[1:] if line.strip() and not line.strip().startswith("#")}
        return {call for word in words for call in (calls(word) if word.startswith("@") else {word})}

    filters = [value for key, value in settings(UNIT.read_text()) if key == "SystemCallFilter"]
    assert filters == ["@system-service", "~@privileged"]
    assert {"sched_setscheduler", "read"} <= calls("@system-service") - calls("@privileged")
    assert "setuid" not in calls("@system-service") - calls("@privileged")


def test_every_group_of_the_unit_is_made_and_known_to_the_doctor() -> None:
    (asked,) = [value for key, value in settings(UNIT.read_text()) if key == "SupplementaryGroups"]
    sysusers = (FILES / "phalanx.sysusers.conf").read_text()
    made = re.findall(r"^g (\w+) - -$", sysusers, re.MULTILINE)
    assert sorted(asked.split()) == sorted(made) == sorted(GROUPS)


def test_the_unit_waits_for_the_slave_and_watches_its_loop() -> None:
    output = dict(settings(UNIT.read_text()))
    assert (output["Type"], output["Restart"], output["StartLimitIntervalSec"]) == ("notify", "always", "0")
    # A hang is found after at most a watchdog's period, ended within the abort's, and then the slave starts again.
    assert int(output["WatchdogSec"]) + int(output["TimeoutAbortSec"]) <= 7
    assert output["RestartSec"] == "500ms"
    assert (output["MemoryMax"], output["MemorySwapMax"], output["TasksMax"]) == ("70%", "0", "256")
    assert "MemoryDenyWriteExecute" not in output  # numba
    credentials = [value.split(":") for key, value in settings(UNIT.read_text()) if key == "LoadCredential"]
    assert [name for name, _ in credentials] == [
        "rig.key",
        "ca.pem",
        "device.pem",
        "device.key",
        "device.secret",
    ]
    assert all(path.startswith("/etc/phalanx/keys/") for _, path in credentials)
    assert credentials[-1][1] == "/etc/phalanx/keys/device-%i.secret"


def test_the_files_of_the_unit_are_in_the_wheel(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    listed = zipfile.ZipFile(wheel).namelist()
    assert "slave/install/files/phalanx-slave@.service" in listed
    assert "slave/install/files/phalanx.sysusers.conf" in listed
    assert "slave/install/files/strobe.conf" in listed
