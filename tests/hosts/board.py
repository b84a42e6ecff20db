"""An emulated machine: kernel, disk and network card by QEMU, reached by ssh; what it writes to its disk is kept
until it is switched off."""

import base64
import os
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.hosts.board_image import NETWORK, Image, board_image, run
from tests.hosts.tap import Tap
from tests.hosts.undo import Undo

MASTER_PORT = 47801
UP_S = 180.0  # an idle machine of two cores takes 20 s
CPU, CORES, MEMORY_MB = "cortex-a72", 2, 1024  # Raspberry Pi 4


@dataclass
class Board:
    """An arm64 board on a network of its own with this machine.

    Attributes:
        name: Its name, and that of the camera on it.
        address: Of the board; `master_address` and `broadcast`: this machine's end.
        folder: What a run writes.
        undo: Takes back links and processes, also when the run is killed.
        boot_s: From power to sshd [s].
    """

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

    def start(self) -> None:
        """Make the network, switch it on, and wait for sshd.

        Raises:
            RuntimeError: It did not come up; the end of its console.
        """
        image = board_image()
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
        told = {
            "ssh.authorized_keys.root": (self.folder / "id.pub").read_text(),
            "network.network.10-board": NETWORK.format(address=self.address),
            "system.hostname": self.name,
        }
        given = " ".join(
            f"systemd.set_credential_binary={name}:{_base64(text)}" for name, text in told.items()
        )
        kernel = f"root=/dev/nvme0n1 rw console=ttyAMA0 quiet systemd.show_status=1 {given}"
        self._process = subprocess.Popen(
            [
                *("qemu-system-aarch64", "-machine", "virt", "-cpu", CPU, "-accel", "tcg,thread=multi"),
                *("-smp", str(CORES), "-m", str(MEMORY_MB), "-display", "none", "-monitor", "none"),
                *("-kernel", str(image.kernel), "-append", kernel),
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
        line = ["ssh", "-F", str(self.folder / "ssh_config"), f"root@{self.address}", command]
        return subprocess.run(line, capture_output=True, text=True, timeout=timeout_s, check=False)

    @property
    def unit(self) -> str:
        """The slave that it runs."""
        return f"phalanx-slave@{self.name}.service"

    def journal(self, lines: int = 40) -> str:
        """What the slave, and systemd of it, said last."""
        return self.try_run(f"journalctl -u {self.unit} -n {lines} -o short-monotonic --no-pager").stdout

    def close(self) -> None:
        """Off, and everything as it was before. Safe to call twice."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
        if hasattr(self, "tap"):
            self.tap.close()
        self.undo.now()


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
