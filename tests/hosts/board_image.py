"""The disk of an emulated arm64 board: Debian 13 unpacked, not installed, with what a first start leaves settled here.

To install it would mean to run every package's set-up under emulation, for minutes. Unpacked, with the accounts and
files that those would have made, it starts as well: systemd, sshd, chrony and Python are the real ones.
"""

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

SUITE, MIRROR = "trixie", "http://deb.debian.org/debian"
DISK_MB = 2500
# The cloud kernel has NVMe and ext4 built in: no initrd, which would have to be made under emulation.
PACKAGES = (
    *(
        "base-files",
        "base-passwd",
        "bash",
        "coreutils",
        "dash",
        "debianutils",
        "diffutils",
        "findutils",
        "grep",
    ),
    *(
        "gzip",
        "hostname",
        "libc-bin",
        "login",
        "mawk",
        "mount",
        "passwd",
        "procps",
        "sed",
        "tar",
        "util-linux",
    ),
    *("systemd", "systemd-sysv", "udev", "kmod", "dbus", "iproute2", "linux-image-cloud-arm64"),
    *("openssh-server", "openssh-sftp-server", "rsync", "chrony"),
    *("python3", "python3-venv", "libgomp1", "libstdc++6", "zstd"),
)
ENABLED = {
    "multi-user.target.wants": ("ssh.service", "systemd-networkd.service", "chrony.service"),
    "sockets.target.wants": ("systemd-networkd.socket",),
}
TOOLS = {
    "mmdebstrap": "mmdebstrap",
    "qemu-system-aarch64": "qemu-system-arm",
    "mke2fs": "e2fsprogs",
    "depmod": "kmod",
    "systemd-sysusers": "systemd",
    "ssh": "openssh-client",
    "ssh-keygen": "openssh-client",
    "rsync": "rsync",
    "ip": "iproute2",
}
NETWORK = """[Match]
Type=ether
[Network]
Address={address}/24
LinkLocalAddressing=no
"""
SSHD = """UsePAM no
PermitRootLogin prohibit-password
Subsystem sftp /usr/lib/openssh/sftp-server
"""


class Image(NamedTuple):
    """Kernel, disk (raw, ext4; never written to) and the public key by which the board's sshd is known."""

    kernel: Path
    disk: Path
    host_key: Path


def why_not() -> str | None:
    """What keeps this machine from running a board, and the way out of it; None: nothing."""
    if os.geteuid() != 0:
        return "needs root: the board is on a network of its own (sudo make test-deploy)"
    if absent := sorted({package for tool, package in TOOLS.items() if shutil.which(tool) is None}):
        return f"missing here: {', '.join(absent)} (Debian: apt install {' '.join(absent)})"
    return None


def cache() -> Path:
    """Folder for what is made once: PHALANX_CACHE, by default phalanx in ~/.cache or XDG_CACHE_HOME."""
    usual = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "phalanx"
    return Path(os.environ.get("PHALANX_CACHE", usual)) / "hosts"


def board_image() -> Image:
    """The image, made if it is not there (a minute, 120 MB to load).

    Raises:
        RuntimeError: A tool failed; its own words.
    """
    recipe = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:12]
    place = cache() / f"board-{SUITE}-arm64-{recipe}"
    if not place.is_dir():
        cache().mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache(), prefix="unfinished-") as unfinished:
            made = Path(unfinished) / "made"
            made.mkdir()
            _make(Path(unfinished), made)
            made.rename(place)
    return Image(place / "kernel", place / "disk", place / "host_key.pub")


def _make(work: Path, made: Path) -> None:
    archive, tree = work / "packages.tar", work / "root"
    modes = ["--mode=chrootless", "--skip=check/chrootless,check/qemu", "--variant=extract", "--arch=arm64"]
    run("mmdebstrap", "--quiet", *modes, f"--include={','.join(PACKAGES)}", SUITE, str(archive), MIRROR)
    tree.mkdir()
    run(
        "tar",
        "-x",
        "-f",
        str(archive),
        "-C",
        str(tree),
        "--exclude=./usr/share/doc",
        "--exclude=./usr/share/locale",
    )
    archive.unlink()
    _settle(tree)
    kernel = next((tree / "boot").glob("vmlinuz-*"))
    run("depmod", "-b", str(tree), kernel.name.removeprefix("vmlinuz-"))
    shutil.copy(kernel, made / "kernel")
    shutil.copy(tree / "etc/ssh/ssh_host_ed25519_key.pub", made / "host_key.pub")
    run("mke2fs", "-q", "-t", "ext4", "-d", str(tree), str(made / "disk"), f"{DISK_MB}M")


def _settle(tree: Path) -> None:
    """What the set-up of the packages would have left behind."""
    etc = tree / "etc"
    for name in ("bin", "sbin", "lib"):
        if not (tree / name).exists():  # unpacked only, trixie lacks some of them
            (tree / name).symlink_to(f"usr/{name}")
    for name, target in (("sh", "dash"), ("awk", "mawk")):
        if not (tree / "usr/bin" / name).exists():
            (tree / "usr/bin" / name).symlink_to(target)
    shared = tree / "usr/share"
    shutil.copy(shared / "base-passwd/passwd.master", etc / "passwd")
    shutil.copy(shared / "base-passwd/group.master", etc / "group")
    (etc / "shadow").write_text("root:*:20000:0:99999:7:::\n")
    (etc / "shadow").chmod(0o600)
    (etc / "nsswitch.conf").write_text("passwd: files systemd\ngroup: files systemd\nhosts: files\n")
    shutil.copy(shared / "chrony/chrony.conf", etc / "chrony/chrony.conf")
    (etc / "fstab").write_text("/dev/nvme0n1 / ext4 defaults,noatime 0 0\n")
    (etc / "machine-id").write_text("")
    (etc / "ssh/sshd_config").write_text(SSHD)
    run(
        "ssh-keygen",
        "-q",
        "-t",
        "ed25519",
        "-N",
        "",
        "-C",
        "board",
        "-f",
        str(etc / "ssh/ssh_host_ed25519_key"),
    )
    run("systemd-sysusers", f"--root={tree}")
    for wants, units in ENABLED.items():
        folder = etc / "systemd/system" / wants
        folder.mkdir(parents=True, exist_ok=True)
        for unit in units:
            (folder / unit).symlink_to(f"/usr/lib/systemd/system/{unit}")


def run(*command: str) -> None:
    """Run a command of this machine.

    Raises:
        RuntimeError: It failed; its own words.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command[:3])} ...: {done.stderr.strip()[-2000:]}")
