"""The disk of an emulated arm64 board: Debian 13 unpacked, not installed, with what a first start leaves settled here.

To install it would mean to run every package's set-up under emulation, for minutes. Unpacked, with the accounts and
files that those would have made, it starts as well: systemd, sshd, chrony and Python are the real ones.
"""

import hashlib
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tests.cached import key_of, made_once
from tests.hosts.debian import cache

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
    "sysinit.target.wants": (
        "systemd-network-generator.service",
    ),  # the address comes with the kernel's command line
}
# Of a first start, or for a screen and a keyboard: minutes under emulation, and nothing that is tested.
MASKED = (
    *(
        "systemd-hwdb-update",
        "ldconfig",
        "systemd-journal-catalog-update",
        "systemd-update-done",
        "systemd-firstboot",
    ),
    *(
        "serial-getty@ttyAMA0",
        "getty@tty1",
        "systemd-logind",
        "systemd-networkd-wait-online",
        "systemd-pstore",
    ),
    *(
        "e2scrub_reap",
        "systemd-binfmt",
        "systemd-boot-random-seed",
        "systemd-machine-id-commit",
        "modprobe@drm",
    ),
)
PC_PACKAGES = (
    *("linux-image-amd64", "initramfs-tools", "systemd-sysv", "udev", "kmod", "dbus", "iproute2", "procps"),
    *("openssh-server", "rsync", "chrony", "python3", "python3-venv", "libgomp1", "i2c-tools"),
)
# A processor twenty times slower starts twenty times slower.
SLOWER = "[Service]\nTimeoutStartSec=10min\nWatchdogSec=2min\n"
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
    """Kernel, disk (raw, ext4; never written to), the public key of its sshd, and an initrd if it needs one."""

    kernel: Path
    disk: Path
    host_key: Path
    initrd: Path | None = None


def board_image() -> Image:
    """That of an arm64 board, made if it is not there (a minute, 120 MB to load).

    Raises:
        RuntimeError: A tool failed; its own words.
    """
    place = _made("board", _make_board)
    return Image(place / "kernel", place / "disk", place / "host_key.pub")


def pc_image() -> Image:
    """That of a PC with Debian's full kernel, made if it is not there (two minutes, 170 MB to load).

    Raises:
        RuntimeError: A tool failed; its own words.
    """
    place = _made("pc", _make_pc)
    return Image(place / "kernel", place / "disk", place / "host_key.pub", place / "initrd")


def _made(name: str, make: Callable[[Path, Path], None]) -> Path:
    """The folder of an image, made by `make`, which is given a folder to work in and the one to fill."""
    recipe = key_of(Path(__file__).read_text())
    return made_once(cache() / f"{name}-{SUITE}-{recipe}", lambda made: make(made.parent, made))


def _make_pc(work: Path, made: Path) -> None:
    tree = work / "root"
    small = (
        "mkdir -p $1/etc/initramfs-tools/conf.d && echo MODULES=list > $1/etc/initramfs-tools/conf.d/small"
    )
    modules = "printf 'nvme\\next4\\n' > $1/etc/initramfs-tools/modules"
    hooks = [f"--essential-hook={small}", f"--essential-hook={modules}"]
    what = ["--variant=minbase", "--format=directory", f"--include={','.join(PC_PACKAGES)}", *hooks]
    run("mmdebstrap", "--quiet", *what, SUITE, str(tree), MIRROR)
    _start_quickly(tree)
    (tree / "etc/fstab").write_text("/dev/nvme0n1 / ext4 defaults,noatime 0 0\n")
    _finish(tree, made)
    shutil.copy(next((tree / "boot").glob("initrd.img-*")), made / "initrd")


def _make_board(work: Path, made: Path) -> None:
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
    _finish(tree, made)


def _finish(tree: Path, made: Path) -> None:
    shutil.copy(next((tree / "boot").glob("vmlinuz-*")), made / "kernel")
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
    # chrony's own set-up makes its account by adduser.
    run("systemd-sysusers", f"--root={tree}", "--inline", "u _chrony - chrony /var/lib/chrony")
    chrony = next(
        line.split(":") for line in (etc / "passwd").read_text().splitlines() if line.startswith("_chrony")
    )
    for folder in ("lib", "log"):
        (tree / "var" / folder / "chrony").mkdir(exist_ok=True)
        os.chown(tree / "var" / folder / "chrony", int(chrony[2]), int(chrony[3]))
    for name, target in (("run", "/run"), ("lock", "/run/lock")):
        if not (tree / "var" / name).exists():
            (tree / "var" / name).symlink_to(target)
    _start_quickly(tree)


def _start_quickly(tree: Path) -> None:
    """Which services start, and that the slave's may take the time that emulation takes."""
    etc = tree / "etc"
    (etc / "machine-id").write_text(f"{hashlib.md5(b'phalanx board', usedforsecurity=False).hexdigest()}\n")
    slower = etc / "systemd/system/phalanx-slave@.service.d"
    slower.mkdir(parents=True)
    (slower / "emulated.conf").write_text(SLOWER)
    for wants, units in ENABLED.items():
        folder = etc / "systemd/system" / wants
        folder.mkdir(parents=True, exist_ok=True)
        for unit in units:
            (folder / unit).unlink(missing_ok=True)
            (folder / unit).symlink_to(f"/usr/lib/systemd/system/{unit}")
    for unit in MASKED:
        place = etc / "systemd/system" / f"{unit}.service"
        place.unlink(missing_ok=True)
        place.symlink_to("/dev/null")


def run(*command: str) -> None:
    """Run a command of this machine.

    Raises:
        RuntimeError: It failed; its own words.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command[:3])} ...: {done.stderr.strip()[-2000:]}")
