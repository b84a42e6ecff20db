"""An emulated machine: kernel, disk and network card by QEMU, reached by ssh; what it writes to its disk is kept
until it is switched off."""

import base64
import contextlib
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from bench.rigs.local import cpu_s
from tests.hosts.board_image import NETWORK, Image, board_image, pc_image, run
from tests.hosts.fleet import Fleet
from tests.hosts.measured import Measured
from tests.hosts.rig import Rig
from tests.hosts.tap import Tap
from tests.hosts.undo import Undo
from tests.programs import missing

MASTER_PORT = 47801
UP_S = 600.0  # 25 s where nothing else runs; tests are not for the load of the machine
CORES, MEMORY_MB = 2, 512  # as a Raspberry Pi Zero 2 W
FASTER = (
    "mitigations=off nokaslr apparmor=0 audit=0 systemd.show_status=0 loglevel=4"  # of start under emulation
)


TOOLS = (
    *("mmdebstrap", "qemu-system-aarch64", "qemu-system-x86_64", "mke2fs", "depmod", "systemd-sysusers"),
    *("ssh", "ssh-keygen", "rsync", "ip"),
)


def why_not() -> str | None:
    """What keeps this machine from running a board, and the way out of it; None: nothing."""
    if os.geteuid() != 0:
        return "needs root: the board is on a network of its own (sudo make test-deploy)"
    return missing(*TOOLS)


@dataclass(frozen=True)
class Model:
    """A kind of machine.

    Attributes:
        image: Makes its kernel and disk.
        qemu: Begin of the command line.
        console: Its serial line, as the kernel calls it.
    """

    image: Callable[[], Image]
    qemu: tuple[str, ...]
    console: str


ARM64 = Model(
    board_image, ("qemu-system-aarch64", "-machine", "virt", "-cpu", "cortex-a72"), "ttyAMA0"
)  # as a Pi 4
AMD64 = Model(pc_image, ("qemu-system-x86_64", "-machine", "q35", "-cpu", "max"), "ttyS0")


@dataclass
class Board:
    """An emulated machine on a network of its own with this one.

    Attributes:
        model: Which kind.
        name: Its name, and that of the camera on it.
        address: Of the board; `master_address` and `broadcast`: this machine's end.
        folder: What a run writes.
        undo: Takes back links and processes, also when the run is killed.
        boot_s: From power to a command by ssh [s].
    """

    model: Model = ARM64
    name: str = "left"
    folder: Path = field(default_factory=lambda: Path(tempfile.mkdtemp(prefix="phalanx-board-")))
    undo: Undo = field(default_factory=Undo)
    boot_s: float = float("nan")
    _process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self.undo.later("remove folder", str(self.folder))
        number = os.getpid() % 250 + 1  # runs beside one another have networks of their own
        self.address, self.master_address = f"10.174.{number}.11", f"10.174.{number}.1"
        self.broadcast, self.link = f"10.174.{number}.255", f"phxb{number}"
        self.login = f"root@{self.address}"

    def start(self) -> None:
        """Make the network, switch it on, and wait for sshd.

        Raises:
            RuntimeError: It did not come up; the end of its console.
        """
        image = self.model.image()
        try:
            self._connect()
            self._settle_ssh(image)
            self._power(image)
        except BaseException:
            self.close()
            raise

    def _connect(self) -> None:
        self.undo.later("delete link", self.link)
        run("ip", "tuntap", "add", self.link, "mode", "tap")
        run("ip", "addr", "add", f"{self.master_address}/24", "broadcast", self.broadcast, "dev", self.link)
        run("ip", "link", "set", self.link, "up")
        self.tap = Tap(self.link, MASTER_PORT)

    def _settle_ssh(self, image: Image) -> None:
        key = self.folder / "id"
        run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key))
        (self.folder / "known_hosts").write_text(f"{self.address} {image.host_key.read_text()}")
        (self.folder / "ssh_config").write_text(
            f"IdentityFile {key}\nIdentitiesOnly yes\nUserKnownHostsFile {self.folder}/known_hosts\n"
            "StrictHostKeyChecking yes\nBatchMode yes\nConnectTimeout 10\nLogLevel ERROR\n"
        )

    def _power(self, image: Image) -> None:
        credentials = {
            "ssh.authorized_keys.root": (self.folder / "id.pub").read_text(),
            "network.network.10-board": NETWORK.format(address=self.address),
            "system.hostname": self.name,
        }
        given = " ".join(
            f"systemd.set_credential_binary={name}:{_base64(text)}" for name, text in credentials.items()
        )
        kernel = f"root=/dev/nvme0n1 rw console={self.model.console} {FASTER} {given}"
        self._process = subprocess.Popen(
            [
                *(*self.model.qemu, "-accel", "tcg,thread=multi,tb-size=512"),
                *("-smp", str(CORES), "-m", str(MEMORY_MB), "-display", "none", "-monitor", "none"),
                *(
                    "-kernel",
                    str(image.kernel),
                    "-append",
                    kernel,
                    *(("-initrd", str(image.initrd)) if image.initrd else ()),
                ),
                # Writes go to a file that nobody else sees and that ends with the process.
                *("-drive", f"file={image.disk},format=raw,if=none,id=disk,snapshot=on"),
                *("-device", "nvme,drive=disk,serial=board"),
                *("-netdev", f"tap,id=net,ifname={self.link},script=no,downscript=no"),
                *("-device", "virtio-net-pci,netdev=net,romfile="),
                *("-serial", f"file:{self.folder}/console.log"),
            ],
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.undo.later("kill process", str(self._process.pid))
        self.boot_s = self.wait_up()

    def wait_up(self, timeout_s: float = UP_S) -> float:
        """Wait until a command can be run on it; return how long that took [s].

        Raises:
            RuntimeError: It did not come up; the end of its console.
        """
        begin = time.monotonic()
        while self.try_run("true").returncode != 0:
            if (
                time.monotonic() - begin > timeout_s
                or self._process is None
                or self._process.poll() is not None
            ):
                raise RuntimeError(f"the board does not come up:\n{self.console()}")
            time.sleep(0.2)
        return time.monotonic() - begin

    def console(self) -> str:
        """The end of what it wrote to its serial line."""
        log = self.folder / "console.log"
        return log.read_text(errors="replace")[-3000:] if log.exists() else ""

    def run(self, command: str, timeout_s: float = 120.0) -> str:
        """Run a shell command on it as root; return what it wrote.

        Raises:
            RuntimeError: It failed; with what it wrote.
        """
        asked = self.try_run(command, timeout_s)
        if asked.returncode != 0:
            raise RuntimeError(f"board: {command}: exit {asked.returncode}\n{asked.stdout}{asked.stderr}")
        return asked.stdout.strip()

    def try_run(self, command: str, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
        """The same, whatever its exit code."""
        line = ["ssh", "-F", str(self.folder / "ssh_config"), self.login, command]
        return subprocess.run(line, capture_output=True, text=True, timeout=timeout_s, check=False)

    @property
    def unit(self) -> str:
        """The slave that it runs."""
        return f"phalanx-slave@{self.name}.service"

    @property
    def ssh_options(self) -> tuple[str, ...]:
        """With which `phalanx fleet deploy` reaches it."""
        known = f"UserKnownHostsFile={self.folder}/known_hosts"
        options = (known, "IdentitiesOnly=yes")
        return (
            "--identity",
            str(self.folder / "id"),
            *(word for one in options for word in ("--ssh-option", one)),
        )

    def main_pid(self) -> int:
        """Of the slave; 0: it does not run."""
        return int(self.run(f"systemctl show -p MainPID --value {self.unit}"))

    def journal(self, lines: int = 40) -> str:
        """What the slave, and systemd of it, said last."""
        return self.try_run(f"journalctl -u {self.unit} -n {lines} -o short-monotonic --no-pager").stdout

    def processor_s(self) -> float:
        """Processor time [s] of this machine that it has taken since power."""
        assert self._process is not None
        return cpu_s(self._process.pid)

    def close(self) -> None:
        """Off, and everything as it was before. Safe to call twice."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
        if hasattr(self, "tap"):
            self.tap.close()
        self.undo.now()


class BoardRig(Rig):
    """A rig of which one camera is on the board; the other is nowhere."""

    def __init__(self, board: Board) -> None:
        """Write calibration and keys; nothing is started."""
        self.board = board
        hosts = {board.name: board}
        fleet = SimpleNamespace(
            address=board.master_address,
            broadcast=board.broadcast,
            hosts=hosts,
            undo=board.undo,
            tap=board.tap,
            ssh_options=board.ssh_options,
        )
        super().__init__(cast(Fleet, fleet), board.folder)


@contextlib.contextmanager
def switched_on(model: Model, what: str, credentials: Measured) -> Generator[BoardRig]:
    """A machine that is on, with nothing of ours on it, and its rig; skipped where it cannot be.

    Args:
        model: Which kind.
        what: How it is called where its time from power to ssh is kept.
        told: Where that is kept.
    """
    if (reason := why_not()) is not None:
        pytest.skip(reason)
    board = Board(model)
    board.start()
    try:
        credentials(f"{what} up, from power to ssh", board.boot_s)
        rig = BoardRig(board)
        try:
            yield rig
        finally:
            rig.close()
    finally:
        board.close()


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
