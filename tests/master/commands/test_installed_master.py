"""The installed master under a real service manager of a user: killed, hung, stopped, with an error, and gone."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from bench.rigs.local import free_port
from master.commands.keys import make
from master.commands.run import UNIT
from tests.master.user_manager import user_manager, why_not
from tests.network_helpers import until

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = Path(sys.executable).with_name("phalanx-master")
# Loaded by every Python below the manager: a signal makes a thread of the running master fail.
_PLANTED = """
import signal, threading
def fail():
    raise OverflowError("planted")
signal.signal(signal.SIGUSR1, lambda *_: threading.Thread(target=fail, name="planted").start())
"""


# Its period is what the test of a hang waits for.
_DROP_IN = """[Service]
WatchdogSec=5
ExecStopPost=/bin/sh -c 'echo $$EXIT_CODE $$EXIT_STATUS >> %h/ends'
"""


class Installed:
    """The master as a service of a real manager of a user. Holds its environment and its port."""

    def __init__(self, environment: dict[str, str], keys: Path) -> None:
        self.environment, self._keys = environment, keys
        self._port = free_port(socket.SOCK_STREAM)
        self.options = ["--rig", "desk", "--keys", str(keys), "--bus", f"tls/127.0.0.1:{self._port}"]
        drop_in = self.unit.with_name(f"{UNIT}.d") / "test.conf"
        drop_in.parent.mkdir(parents=True)
        drop_in.write_text(_DROP_IN)
        self.options += [
            "--bind",
            "127.0.0.1:0",
            "--beacon",
            f"127.255.255.255:{free_port(socket.SOCK_DGRAM)}",
        ]

    def asked(self, *command: str) -> subprocess.CompletedProcess[str]:
        """Run a program there."""
        return subprocess.run(
            command, env=self.environment, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
        )

    def install(self, *more: str) -> subprocess.CompletedProcess[str]:
        """`phalanx run --install` with the options of the rig."""
        return self.asked(str(PROGRAM), "run", "--install", *self.options, *more)

    def ends(self) -> list[str]:
        """How it ended, each time."""
        return (Path(self.environment["HOME"]) / "ends").read_text().splitlines()

    def pid(self) -> int:
        """Of the master; 0: it does not run."""
        return int(self.asked("systemctl", "--user", "show", "-p", "MainPID", "--value", UNIT).stdout or 0)

    def state(self) -> str:
        """How the service is."""
        return self.asked("systemctl", "--user", "is-active", UNIT).stdout.strip()

    def another_ready(self, than: int) -> bool:
        """Whether another process than that is ready."""
        return self.state() == "active" and self.pid() not in (0, than)

    @property
    def unit(self) -> Path:
        """Its file."""
        return Path(self.environment["HOME"]) / ".config/systemd/user" / UNIT


@pytest.fixture
def installed(tmp_path: Path) -> Generator[Installed, None, None]:
    """A user's service manager without any service of ours."""
    if (why := why_not()) is not None:
        pytest.skip(why)
    make(keys := tmp_path / "keys", ["left"], datetime.now(UTC))
    planted = tmp_path / "planted"
    planted.mkdir()
    (planted / "sitecustomize.py").write_text(_PLANTED)
    with user_manager({"PYTHONPATH": str(planted)}) as environment:
        if isinstance(environment, str):
            pytest.skip(environment)
        yield Installed(environment, keys)


def _fault(installed: Installed) -> None:
    os.kill(installed.pid(), signal.SIGUSR1)


def _kill(installed: Installed) -> None:
    os.kill(installed.pid(), signal.SIGKILL)


def _hang(installed: Installed) -> None:
    os.kill(installed.pid(), signal.SIGSTOP)


def test_an_installed_master_recovers_from_faults_stays_stopped_is_removed_and_recovers_from_an_error(
    installed: Installed,
) -> None:
    _it_is_back_after_a_fault_a_kill_and_a_hang(installed)
    _stopped_it_stays_so_and_uninstalling_leaves_nothing(installed)
    _an_error_is_named_and_it_recovers_by_itself_once_it_is_mended(installed)


def _it_is_back_after_a_fault_a_kill_and_a_hang(installed: Installed) -> None:
    assert (done := installed.install()).returncode == 0, done.stderr
    assert "enable-linger" in done.stdout
    for end in (_fault, _kill, _hang):
        pid = installed.pid()
        end(installed)
        assert until(lambda pid=pid: installed.another_ready(pid))
    *first, hung = installed.ends()
    assert first == ["exited 70", "killed KILL"]
    assert hung in ("killed ABRT", "dumped ABRT", "killed KILL")  # by the watchdog
    before = installed.unit.read_text(), installed.pid()
    assert "unchanged" in installed.install().stdout
    assert (installed.unit.read_text(), installed.pid()) == before


def _stopped_it_stays_so_and_uninstalling_leaves_nothing(installed: Installed) -> None:
    os.kill(installed.pid(), signal.SIGTERM)
    assert until(lambda: installed.state() == "inactive")
    assert installed.asked("systemctl", "--user", "start", UNIT).returncode == 0
    assert "would stop" in installed.asked(str(PROGRAM), "run", "--uninstall", "--dry-run").stdout
    assert installed.state() == "active"
    assert "removed" in installed.asked(str(PROGRAM), "run", "--uninstall").stdout
    assert installed.state() == "inactive"
    config = Path(installed.environment["HOME"]) / ".config"
    assert [path.name for path in config.rglob("*") if not path.is_dir()] == ["test.conf"]
    assert "nothing to remove" in installed.asked(str(PROGRAM), "run", "--uninstall").stdout


def _an_error_is_named_and_it_recovers_by_itself_once_it_is_mended(installed: Installed) -> None:
    ended = len(installed.ends())
    with socket.create_server(("127.0.0.1", int(installed.options[5].rpartition(":")[2]))):
        done = installed.install()
        assert done.returncode == 1
        assert "does not run: failed: cannot open the bus" in done.stderr
        assert "Address already in use" in done.stderr
        assert set(installed.ends()[ended:]) == {"exited 1"}
    assert until(lambda: installed.state() == "active")
