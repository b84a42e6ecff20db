"""One host: a Debian with systemd as its first process in a container, an address on a bridge, and sshd.

Its disk is a layer in memory over the shared tree of `debian.root_tree`, so each host starts clean, in two seconds, and
its size is known: a disk that is full is full as a real one.
"""

import hashlib
import os
import pty
import socket
import stat
import subprocess
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.hosts.debian import TRIXIE, control_groups, root_tree
from tests.hosts.undo import Undo, kill_group

DISK_MB = 1500
# What a running system writes by itself: no program of ours is meant by it.
OF_THE_SYSTEM = ("run", "tmp", "proc", "sys", "dev", "var/log", "var/tmp", "var/cache", "var/lib/systemd")
NETWORK = """[Match]
Name=host0
[Network]
Address={address}/24
LinkLocalAddressing=no
"""


@dataclass(frozen=True)
class Account:
    """Who deploys to a host.

    Attributes:
        password: Empty: its key logs in, sudo asks nothing; else sudo asks for it, as Raspberry Pi OS does.
        sshd: Lines of sshd's for this user; empty: its key logs in.
        suite: Debian of the host.
    """

    user: str
    password: str = ""
    sshd: str = ""
    suite: str = TRIXIE


@dataclass
class Host:
    """A host, on or off.

    Attributes:
        name: Name of the host, and of the camera on it.
        address: IPv4 address on the bridge.
        folder: Where its disk, its console's log and its tree are, on this machine.
        account: Who deploys. Tests look at it as root, who always has a key.
        ssh: Options of ssh before the host's name.
    """

    name: str
    machine: str
    address: str
    account: Account
    folder: Path
    bridge: str
    ssh: tuple[str, ...]
    undo: Undo
    _process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def tree(self) -> Path:
        """Its root folder, as this machine sees it."""
        return self.folder / "root"

    @property
    def link(self) -> str:
        """This machine's end of its cable: `ip link set LINK down` pulls it."""
        return f"vb-{self.machine}"

    @property
    def login(self) -> str:
        """USER@ADDRESS."""
        return f"{self.account.user}@{self.address}"

    @property
    def _group(self) -> Path:
        groups = control_groups()
        assert groups is not None
        return groups / self.machine

    @property
    def base(self) -> Path:
        """The shared tree that its disk is laid over."""
        return root_tree(self.account.suite)

    def make_disk(self, public_key: str) -> None:
        """Lay an empty disk over `base`, and give it name, address and who may log in."""
        disk = self.folder / "disk"
        for place in (disk, self.tree):
            place.mkdir(parents=True)
            self.undo.later("unmount", str(place))
        _run("mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "phalanx-host", str(disk))
        for part in ("upper", "work"):
            (disk / part).mkdir()
        (disk / "upper").chmod(0o755)
        layers = f"lowerdir={self.base},upperdir={disk}/upper,workdir={disk}/work"
        _run("mount", "-t", "overlay", "phalanx-host", "-o", layers, str(self.tree))
        self._settle(public_key)

    def _settle(self, public_key: str) -> None:
        etc = self.tree / "etc"
        (etc / "hostname").write_text(f"{self.name}\n")
        (etc / "hosts").write_text(f"127.0.0.1 localhost\n127.0.1.1 {self.name}\n")
        (etc / "systemd/network/10-host0.network").write_text(NETWORK.format(address=self.address))
        wanted = etc / "systemd/system/multi-user.target.wants"
        (wanted / "systemd-networkd.service").symlink_to("/usr/lib/systemd/system/systemd-networkd.service")
        for timer in (etc / "systemd/system/timers.target.wants").iterdir():
            timer.unlink()  # nothing of the distribution's own begins in the middle of a measurement
        user, password = self.account.user, self.account.password
        if user != "root":
            who = ("--create-home", "--shell", "/bin/bash", "-G", "sudo", user)
            _run("chroot", str(self.tree), "useradd", *who)
        if user != "root" and not password:
            (etc / "sudoers.d/user").write_text(f"{user} ALL=(ALL) NOPASSWD: ALL\n")
        if password:
            _run("chroot", str(self.tree), "chpasswd", given=f"{user}:{password}")
        (etc / "ssh/sshd_config.d/user.conf").write_text(f"Match User {user}\n{self.account.sshd}\n")
        homes = {one: self.tree / ("root" if one == "root" else f"home/{one}") for one in ("root", user)}
        for owner, home in homes.items():
            (home / ".ssh").mkdir(mode=0o700, exist_ok=True)
            (home / ".ssh/authorized_keys").write_text(public_key)
            (home / ".sudo_as_admin_successful").touch()  # sudo's own, of its first use
            _run("chroot", str(self.tree), "chown", "-R", f"{owner}:", f"/{home.relative_to(self.tree)}")

    def boot(self, timeout_s: float = 30.0) -> float:
        """Switch it on and wait for sshd; return how long that took [s].

        Raises:
            RuntimeError: It did not come up; the end of its console.
        """
        self._group.mkdir(exist_ok=True)
        self.undo.later("kill group", str(self._group))
        begin = time.monotonic()
        terminal, end = pty.openpty()  # systemd-nspawn starts a system only before a terminal
        into_group = ["sh", "-c", 'echo $$ > "$0" && exec "$@"', str(self._group / "cgroup.procs")]
        nspawn = [
            "systemd-nspawn",
            "--quiet",
            "--boot",
            "--register=no",
            "--keep-unit",
            f"--machine={self.machine}",
        ]
        self._process = subprocess.Popen(
            [
                *into_group,
                *nspawn,
                f"--hostname={self.name}",
                f"--network-bridge={self.bridge}",
                "-D",
                str(self.tree),
            ],
            stdin=end,
            stdout=end,
            stderr=end,
            start_new_session=True,
            env=os.environ | {"UNIFIED_CGROUP_HIERARCHY": "1"},
        )
        os.close(end)
        threading.Thread(target=self._keep_console, args=(terminal,), daemon=True).start()
        while not self.listens(22):
            if self._process.poll() is not None or time.monotonic() - begin > timeout_s:
                console = (self.folder / "console.log").read_text(errors="replace")
                raise RuntimeError(f"host {self.name} does not come up:\n{console[-2000:]}")
            time.sleep(0.05)
        return time.monotonic() - begin

    def _keep_console(self, terminal: int) -> None:
        with (self.folder / "console.log").open("ab", buffering=0) as log:
            try:
                while read := os.read(terminal, 65536):
                    log.write(read)
            except OSError:  # the host is off
                os.close(terminal)

    def cut_power(self) -> None:
        """Everything on it is gone at once; its disk stays as it was in that moment."""
        if self._process is not None:
            kill_group(str(self._group))
            self._process.wait()
            self._process = None

    def listens(self, port: int) -> bool:
        """Whether it answers on a TCP port."""
        try:
            socket.create_connection((self.address, port), 0.3).close()
        except OSError:
            return False
        return True

    def run(self, command: str, timeout_s: float = 30.0) -> str:
        """Run a shell command on it as root, over ssh; return what it wrote.

        Raises:
            RuntimeError: It failed; with what it wrote.
        """
        asked = self.try_run(command, timeout_s)
        if asked.returncode != 0:
            raise RuntimeError(
                f"{self.name}: {command}: exit {asked.returncode}\n{asked.stdout}{asked.stderr}"
            )
        return asked.stdout.strip()

    def try_run(self, command: str, timeout_s: float = 30.0) -> subprocess.CompletedProcess[str]:
        """The same, whatever its exit code."""
        line = ["ssh", *self.ssh, f"root@{self.address}", command]
        return subprocess.run(line, capture_output=True, text=True, timeout=timeout_s, check=False)

    @property
    def unit(self) -> str:
        """The slave that it runs."""
        return f"phalanx-slave@{self.name}.service"

    def main_pid(self) -> int:
        """Of the slave, as the host numbers it; 0: it does not run."""
        return int(self.run(f"systemctl show -p MainPID --value {self.unit}"))

    def restarts(self) -> int:
        """How often systemd has started the slave again."""
        return int(self.run(f"systemctl show -p NRestarts --value {self.unit}"))

    def journal(self, lines: int = 25) -> str:
        """What the slave, and systemd of it, said last."""
        return self.try_run(f"journalctl -u {self.unit} -n {lines} -o cat --no-pager").stdout

    def files(self) -> dict[str, str]:
        """Each file, folder and link of its disk: owner, mode and content; without what the system itself writes."""
        return {
            name: _text(path)
            for path in sorted(self.tree.rglob("*"))
            if not (name := str(path.relative_to(self.tree))).startswith(
                tuple(f"{one}/" for one in OF_THE_SYSTEM)
            )
        }

    def changes(self) -> dict[str, float]:
        """Each path in the layer above the shared tree with the time of its last change [s since 1970]."""
        upper = self.folder / "disk/upper"
        return {
            name: path.lstat().st_mtime
            for path in upper.rglob("*")
            if not (name := str(path.relative_to(upper))).startswith(
                tuple(f"{one}/" for one in OF_THE_SYSTEM)
            )
        }

    def processes(self, unit: str) -> list[int]:
        """The processes of a unit, as this machine numbers them: for signals that come from outside."""
        group = self._group / "payload/system.slice"
        found = [*group.glob(unit), *group.glob(f"*/{unit}")]
        return [int(pid) for one in found for pid in (one / "cgroup.procs").read_text().split()]


def _text(path: Path) -> str:
    info = path.lstat()
    what = f"{stat.filemode(info.st_mode)} {info.st_uid}:{info.st_gid}"
    if path.is_symlink():
        return f"{what} -> {path.readlink()}"
    if stat.S_ISREG(info.st_mode):
        return f"{what} {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"
    return what


def _run(*command: str, given: str = "") -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False, input=given)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()}")
