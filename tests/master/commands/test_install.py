"""`phalanx run --install`: the unit by systemd's own checks, its options, and how the loop shows that it lives."""

import os
import re
import shutil
import socket
import subprocess
import sys
from argparse import Namespace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from common.errors import PhalanxError
from common.supervisor import ServiceManager
from master.cli.table import program
from master.commands.keys import make
from master.commands.run import KEPT, ONE_RUN, UNIT, UserServices, command_of, environment_of, unit_text
from master.monitor.report import MonitoredLoop

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = Path(sys.executable).with_name("phalanx-master")
MOST_EXPOSED = 65  # of 100; a unit of a user has no sandbox of folders: systemd-analyze asks for those
NEEDS_SYSTEMD = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing: apt install systemd"
)


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The keys folder of a rig; nothing of keys in the environment."""
    for name in ("PHALANX_KEYS", "PHALANX_RIG_KEY", "PHALANX_OPEN"):
        monkeypatch.setenv(name, "")  # of what is not there `delenv` alone undoes nothing
        monkeypatch.delenv(name)
    make(tmp_path / "keys", ["left"], datetime.now(UTC))
    monkeypatch.chdir(ROOT)
    return tmp_path / "keys"


def options_of(words: list[str]) -> Namespace:
    return program().parse(["run", *words])[1]


def text_of(folder: Path, *words: str) -> str:
    """A unit whose program is there."""
    program = folder / "phalanx-master"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    return unit_text([str(program), "run", *words], folder, {"PHALANX_KEYS": str(folder / "keys")})


def verified(folder: Path, text: str) -> str:
    """What systemd says about this text as our unit."""
    (folder / UNIT).write_text(text)
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
    command = ["systemd-analyze", "--user", "verify", "--man=no", str(folder / UNIT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=environment)
    lines = (done.stderr + done.stdout).splitlines()
    return "\n".join(line for line in lines if UNIT in line)  # not what it says about units of this machine


@NEEDS_SYSTEMD
def test_systemd_has_nothing_to_say_about_the_unit(tmp_path: Path) -> None:
    assert verified(tmp_path, text_of(tmp_path, "--rig", "desk")) == ""


@NEEDS_SYSTEMD
@pytest.mark.parametrize(
    ("old", "new", "output"),
    [
        ("WatchdogSec", "WatchdogSek", "Unknown key 'WatchdogSek'"),
        ("MemoryMax=1G", "MemoryMax=1X", "Invalid memory limit"),
        ("MemorySwapMax=0", "MemorySwapMax=none", "Invalid memory limit"),
        ("phalanx-master run", "phalanx-mister run", "not executable"),
    ],
)
def test_a_slip_in_the_unit_would_be_said(tmp_path: Path, old: str, new: str, output: str) -> None:
    text = text_of(tmp_path, "--rig", "desk")
    assert old in text
    assert output in verified(tmp_path, text.replace(old, new, 1))


@NEEDS_SYSTEMD
@pytest.mark.parametrize(("drop", "passes"), [(None, True), ("SystemCallFilter", False)])
def test_exposure_of_the_unit(tmp_path: Path, drop: str | None, passes: bool) -> None:
    text = text_of(tmp_path)
    unit = tmp_path / UNIT
    unit.write_text(text if drop is None else re.sub(rf"^{drop}=.*$", "", text, flags=re.MULTILINE))
    command = [
        "systemd-analyze",
        "security",
        "--no-pager",
        "--offline=true",
        f"--threshold={MOST_EXPOSED}",
        str(unit),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode == 0) is passes, done.stdout[-200:] + done.stderr


def test_the_unit_starts_again_and_is_bounded(tmp_path: Path) -> None:
    output = dict(re.findall(r"^(\w+)=(.*)$", text_of(tmp_path), re.MULTILINE))
    assert (output["Type"], output["Restart"], output["RestartSec"]) == ("notify", "on-failure", "100ms")
    assert output["StartLimitIntervalSec"] == "0"
    assert (output["MemoryMax"], output["MemorySwapMax"], output["TasksMax"]) == ("1G", "0", "256")


@pytest.mark.parametrize(
    ("end", "wait_s"),
    [("exited0", 0), ("exited70", 0), ("killedKILL", 0), ("dumpedABRT", 0), ("exited1", 5), ("exited203", 5)],
)
def test_only_an_error_that_the_user_has_to_mend_makes_the_next_try_wait(
    tmp_path: Path, end: str, wait_s: int
) -> None:
    (line,) = re.findall(r"^ExecStopPost=/bin/sh -c '(.*)'$", text_of(tmp_path), re.MULTILINE)
    (tmp_path / "sleep").write_text("#!/bin/sh\necho $1\n")
    (tmp_path / "sleep").chmod(0o755)
    code = re.match("[a-z]+", end)
    assert code is not None
    ended = {"EXIT_CODE": code[0], "EXIT_STATUS": end.removeprefix(code[0]), "PATH": str(tmp_path)}
    done = subprocess.run(
        ["/bin/sh", "-c", line.replace("$$", "$")], env=ended, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == (str(wait_s) if wait_s else "")


def test_each_word_is_one_word_to_systemd(tmp_path: Path) -> None:
    text = unit_text(
        ["/a b/phalanx-master", "run", 'x"y\\z', "50%", "$HOME", "plain"], Path("/a b%"), {"A": "b c%d"}
    )
    assert r'ExecStart="/a b/phalanx-master" run "x\"y\\z" "50%%" "$$HOME" plain' in text
    assert "WorkingDirectory=/a b%%\n" in text
    assert 'Environment="A=b c%%d"\n' in text
    with pytest.raises(PhalanxError, match="cannot be in a unit"):
        unit_text(["/a", "b\nExecStart=/bin/evil"], tmp_path, {})


def test_options_are_those_of_run_with_absolute_paths_and_no_key(keys: Path) -> None:
    words = ["--rig", "desk", "--rig", "wrist", "--keys", os.path.relpath(keys), "--bus", "tls/0.0.0.0:47802"]
    assert command_of(options_of(words)) == [
        *(str(PROGRAM), "run", "--rig", "desk", "--rig", "wrist"),
        *("--calibration", str(ROOT / "calib_json"), "--bus", "tls/0.0.0.0:47802"),
    ]
    assert environment_of() == {"PHALANX_KEYS": str(keys)}
    text = unit_text(command_of(options_of(words)), ROOT, environment_of())
    assert (keys / "rig.key").read_text().strip() not in text


def test_every_option_of_run_is_kept_or_refused() -> None:
    once = {"poses", "summary", "record", "install", "uninstall", "dry_run"}
    assert set(vars(options_of([]))) == {*KEPT, *once}
    assert set(ONE_RUN) < once


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--rig", "nope"], "calib_json/rigs/nope.json"),
        (["--record", "x.mcap"], "--record: a service that starts again would write over it"),
        (["--poses", "x.npz"], "--poses: "),
        (["--summary", "x.json"], "--summary: "),
        (["--rig", "desk"], "no rig key"),
        (["--rig", "desk", "--beacon", "192.168.1.255"], "--beacon '192.168.1.255': expected ADDRESS:PORT"),
        (["--rig", "desk", "--bind", "0.0.0.0:65536"], "--bind '0.0.0.0:65536': expected ADDRESS:PORT"),
        (["--rig", "desk", "--bus", "udp/127.0.0.1:47802"], "must begin with tcp/"),
        (["--rig", "desk", "--bus", "tcp/0.0.0.0:47802"], "neither encrypted nor authenticated"),
        (["--rig", "desk", "--bus", "tls/0.0.0.0"], "--bus 'tls/0.0.0.0': expected a port at its end"),
        (["--rig", "desk", "--bus", "tls/0.0.0.0:47802"], "no keys: give --keys DIR"),
    ],
)
def test_what_could_not_run_is_refused_before_anything_is_written(
    keys: Path, words: list[str], why: str
) -> None:
    assert keys.exists()
    with pytest.raises(PhalanxError, match=why):
        command_of(options_of(words))


def test_a_key_of_the_environment_is_not_written_into_the_unit(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert keys.exists()
    monkeypatch.setenv("PHALANX_RIG_KEY", "ab" * 32)
    with pytest.raises(PhalanxError, match="a key is not written into a unit; give --keys DIR"):
        command_of(options_of(["--rig", "desk"]))


def test_where_no_service_manager_answers_it_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("systemctl") is None:
        pytest.skip("systemctl is missing: apt install systemd")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.delenv("DBUS_SESSION_BUS_ADDRESS", raising=False)
    with pytest.raises(PhalanxError, match="log in as this user itself"):
        UserServices().install("text")
    assert not (tmp_path / "config").exists()


class _Nothing:
    """No message ever comes."""

    def get(self, timeout_s: float) -> None:
        return None


def test_the_loop_is_ready_once_and_gives_a_sign_of_life_four_times_in_a_period(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        now = [0]
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "8000000"}
        loop = MonitoredLoop(_Nothing().get, ServiceManager(environment), lambda: now[0])
        assert manager.recv(100) == b"READY=1\nSTATUS=tracks"
        for now[0] in range(0, 8_000_000_001, 100_000_000):
            assert loop.get(0.1) is None
        assert [manager.recv(100) for _ in range(4)] == [b"WATCHDOG=1"] * 4
        with pytest.raises(BlockingIOError):
            manager.recv(100)


def test_a_dry_run_prints_the_unit_and_writes_nothing(keys: Path) -> None:
    config = keys.parent / "config"
    done = subprocess.run(
        [str(PROGRAM), "run", "--install", "--rig", "desk", "--keys", str(keys), "--dry-run"],
        env=os.environ | {"XDG_CONFIG_HOME": str(config)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"would write {config}/systemd/user/{UNIT}" in done.stdout
    assert "MemoryMax=1G" in done.stdout
    assert not config.exists()
