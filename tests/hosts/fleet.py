"""Two hosts on one bridge, and the machine that runs the tests as the PC beside them."""

import os
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from tests.hosts.host import Account, Host
from tests.hosts.tap import Tap
from tests.hosts.undo import Undo

# with sudo as on Raspberry Pi OS before April 2026, and without
USERS = {"left": Account("pi"), "right": Account("root")}
MASTER_PORT = 47801


class Fleet:
    """Hosts `left` and `right`, started; holds the bridge between them and takes all of it back on leaving."""

    def __init__(self, users: Mapping[str, Account] = USERS, number: int = os.getpid() % 250 + 1) -> None:
        """Make bridge, keys of ssh and hosts, and boot them.

        Args:
            users: Who deploys to which host.
            number: Of the network, 1..250: runs beside one another have networks of their own.

        Raises:
            RuntimeError: A command failed; its own words.
        """
        self.undo = Undo()
        self.folder = Path(tempfile.mkdtemp(prefix="phalanx-hosts-"))
        self.undo.later("remove folder", str(self.folder))
        self.boot_s: dict[str, float] = {}
        try:
            self._connect(users, number)
        except BaseException:
            self.undo.now()
            raise

    def _connect(self, users: Mapping[str, Account], number: int) -> None:
        self.network, self.bridge = f"10.173.{number}", f"phx{number}"
        self.address, self.broadcast = f"{self.network}.1", f"{self.network}.255"
        self.undo.later("delete link", self.bridge)
        _ip(f"link add {self.bridge} type bridge")
        _ip(f"addr add {self.address}/24 broadcast {self.broadcast} dev {self.bridge}")
        _ip(f"link set {self.bridge} up")
        self.tap = Tap(self.bridge, MASTER_PORT)
        self.hosts = {name: self._host(name, 11 + i, user) for i, (name, user) in enumerate(users.items())}
        public_key = self._ssh_files()
        for host in self.hosts.values():
            host.make_disk(public_key)
        for host in self.hosts.values():
            self.boot_s[host.name] = host.boot()

    def _host(self, name: str, number: int, user: Account) -> Host:
        machine = f"{self.bridge}-{name}"
        ssh = ("-F", str(self.folder / "ssh_config"))
        address = f"{self.network}.{number}"
        return Host(name, machine, address, user, self.folder / name, self.bridge, ssh, self.undo)

    def _ssh_files(self) -> str:
        """Keys for this run, and what the hosts' own are: ssh asks nothing and trusts nobody else."""
        key = self.folder / "id"
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)], check=True)
        keys = {one.address: one.base / "etc/ssh/ssh_host_ed25519_key.pub" for one in self.hosts.values()}
        known = "".join(f"{address} {file.read_text()}" for address, file in keys.items())
        (self.folder / "known_hosts").write_text(known)
        (self.folder / "ssh_config").write_text(
            f"IdentityFile {key}\nIdentitiesOnly yes\nUserKnownHostsFile {self.folder}/known_hosts\n"
            "StrictHostKeyChecking yes\nBatchMode yes\nConnectTimeout 5\nLogLevel ERROR\n"
        )
        return key.with_suffix(".pub").read_text()

    @property
    def ssh_options(self) -> tuple[str, ...]:
        """With which `phalanx fleet deploy` reaches the hosts."""
        known = f"UserKnownHostsFile={self.folder}/known_hosts"
        return ("--identity", str(self.folder / "id"), *_each("--ssh-option", known, "IdentitiesOnly=yes"))

    def set_link(self, host: Host, up: bool) -> None:
        """Pull or plug the cable of a host."""
        _ip(f"link set {host.link} {'up' if up else 'down'}")

    def __enter__(self) -> "Fleet":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Everything as it was before."""
        self.tap.close()
        for host in self.hosts.values():
            host.cut_power()
        self.undo.now()


def _ip(arguments: str) -> None:
    done = subprocess.run(["ip", *arguments.split()], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"ip {arguments}: {done.stderr.strip()}")


def _each(option: str, *values: str) -> tuple[str, ...]:
    return tuple(word for value in values for word in (option, value))
