"""Debian as a folder, made once by mmdebstrap: systemd, sshd, Python and rsync as Raspberry Pi OS has them."""

import os
import platform
import subprocess
from pathlib import Path

from tests.cached import key_of, made_once
from tests.programs import missing

TRIXIE, BOOKWORM = "trixie", "bookworm"  # with Python 3.13 and 3.11
MIRROR = "http://deb.debian.org/debian"
PACKAGES = (
    *("systemd", "systemd-sysv", "dbus", "iproute2", "procps", "sudo"),
    *("openssh-server", "rsync", "chrony", "python3", "python3-venv", "libgomp1"),
)
TOOLS = ("mmdebstrap", "systemd-nspawn", "ip", "rsync", "ssh", "ssh-keygen", "tcpdump")
ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64"}


def why_not() -> str | None:
    """What keeps this machine from running hosts, and the way out of it; None: nothing."""
    if os.geteuid() != 0:
        return "needs root: whole machines are started by systemd-nspawn on a bridge (sudo make test-deploy)"
    if (reason := missing(*TOOLS)) is not None:
        return reason
    if control_groups() is None:
        return "needs control groups of version 2 (mount -t cgroup2)"
    return None if platform.machine() in ARCHITECTURES else f"no Debian for {platform.machine()} known here"


def control_groups() -> Path | None:
    """Folder of the control groups of version 2, if there is one."""
    for line in Path("/proc/mounts").read_text().splitlines():
        if (fields := line.split())[2] == "cgroup2":
            return Path(fields[1])
    return None


def root_tree(suite: str = TRIXIE) -> Path:
    """Folder with a Debian that nothing was changed in; made if it is not there (half a minute, 75 MB to load).

    It is below PHALANX_CACHE, by default ~/.cache/phalanx.

    Raises:
        RuntimeError: mmdebstrap failed; its own words.
    """
    architecture = ARCHITECTURES[platform.machine()]
    place = cache() / f"{suite}-{architecture}-{key_of(f'{suite} {PACKAGES} {MIRROR}')}"
    return made_once(place, lambda folder: _make(suite, architecture, folder))


def cache() -> Path:
    """Folder for what is made once: PHALANX_CACHE, by default phalanx in ~/.cache or XDG_CACHE_HOME."""
    typical = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "phalanx"
    return Path(os.environ.get("PHALANX_CACHE", typical)) / "hosts"


def _make(suite: str, architecture: str, folder: Path) -> None:
    command = ["mmdebstrap", "--quiet", "--variant=minbase", f"--arch={architecture}", "--format=directory"]
    what = [f"--include={','.join(PACKAGES)}", "--skip=check/empty", suite, str(folder), MIRROR]
    made = subprocess.run([*command, *what], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        raise RuntimeError(f"mmdebstrap failed:\n{made.stderr[-2000:]}")
