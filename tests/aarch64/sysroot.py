"""What emulation needs, made once under out/aarch64: Debian's aarch64 Python, wheels, QEMU, its plugin.

Nothing is installed and nothing needs root: Debian's packages are unpacked, not set up. QEMU comes from the same
suite, whatever the machine has: one version counts for all, and since Debian 13 qemu-user loads no plugins.
"""

import fcntl
import gzip
import importlib.util
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from tests.cached import key_of, made_once

ROOT = Path(__file__).resolve().parents[2]
CACHE = ROOT / "out" / "aarch64"
PLUGIN = Path(__file__).with_name("count.c")
SUITE, MIRROR, PYTHON = "bookworm", "http://deb.debian.org/debian", "3.11"  # Raspberry Pi OS 12
PACKAGES = ("python3", "libgomp1", "libstdc++6")
# What the slave needs: `dependencies` of pyproject.toml, and what those need.
WHEELS = ("cryptography", "eclipse-zenoh", "msgspec", "numpy", "opencv-python-headless", "pyserial", "smbus2")
WHEELS_OF_WHEELS = ("cffi", "pycparser")
FAST = ("llvmlite", "numba")  # those of the extra `fast`, beside the others and only where a case needs them
UNREACHABLE = ("resolve", "connect", "unreachable", "NewConnectionError", "timed out")
KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
TOOLS = {"mmdebstrap": "mmdebstrap", "gcc": "gcc libc6-dev", "tar": "tar"}
# Of this machine: Debian's name of the architecture, and the loader of programs.
HOSTS = {"x86_64": ("amd64", "ld-linux-x86-64.so.2"), "aarch64": ("arm64", "ld-linux-aarch64.so.1")}


class NotPossibleError(Exception):
    """Nothing can be emulated here; the message names what is missing and how to get it."""


class NoNetworkError(NotPossibleError):
    """What has to be downloaded cannot be reached."""


class Sysroot(NamedTuple):
    """Folders of the emulated machine, the command that is QEMU, its plugin, the versions that a count depends on."""

    root: Path
    wheels: Path
    qemu: tuple[str, ...]
    plugin: Path
    versions: dict[str, str]


def missing() -> list[str]:
    """Debian packages of the tools that are not here."""
    absent = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if not KEYRING.exists():
        absent.append("debian-archive-keyring")
    return absent


def prepare(notify: Callable[[str], None]) -> Sysroot:
    """Make what is not there yet; of several that call at once, one makes it and the others wait.

    NotPossibleError: a tool is missing or fails; NoNetworkError: a mirror or registry cannot be reached.
    """
    if absent := missing():
        raise NotPossibleError(
            f"missing here: {', '.join(absent)}; on Debian: apt install {' '.join(absent)}"
        )
    if platform.machine() not in HOSTS:
        raise NotPossibleError(f"Debian has QEMU for {', '.join(HOSTS)}, not for {platform.machine()}")
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return _prepared(notify)


def _prepared(notify: Callable[[str], None]) -> Sysroot:
    architecture, loader = HOSTS[platform.machine()]
    root = _debian("arm64", PACKAGES, notify)
    tools = _debian(architecture, ("qemu-user",), notify)
    names = [*WHEELS, *WHEELS_OF_WHEELS]
    inputs = f"{PYTHON} {WHEELS} {_pins(names)}"
    wheels = _made("wheels", inputs, lambda place: _download(place, WHEELS), notify)
    plugin = _made("plugin", PLUGIN.read_text(), _compile_plugin, notify)
    triplet = f"{platform.machine()}-linux-gnu"
    # The loader by its real path: the usual one is a link to / and would be the machine's own, of another libc.
    libraries = f"{tools}/lib/{triplet}:{tools}/usr/lib/{triplet}"
    start = (f"{tools}/lib/{triplet}/{loader}", "--library-path", libraries)
    qemu = (*start, f"{tools}/usr/bin/qemu-aarch64")
    packages = {
        "qemu": _version(tools, "qemu-user"),
        "libc": _version(root, "libc6"),
        "python": _version(root, f"python{PYTHON}-minimal"),
    }
    return Sysroot(root, wheels, qemu, plugin / "count.so", packages | _wheel_versions(wheels))


def _made(name: str, inputs: str, make: Callable[[Path], None], notify: Callable[[str], None]) -> Path:
    """The folder `name` of the cache, made afresh if its inputs are others than those it was made of."""
    place = CACHE / f"{name}-{key_of(inputs)}"
    if not place.is_dir():
        notify(f"making {place.relative_to(ROOT)} ...")
    return made_once(place, make)


def _debian(architecture: str, packages: tuple[str, ...], notify: Callable[[str], None]) -> Path:
    """A folder with `packages` and all that they need, unpacked."""

    def unpack(folder: Path) -> None:
        archive = folder.with_name("packages.tar")
        # Without chroot there is nothing to be root for; the checks are of what would run in it.
        modes = ["--mode=chrootless", "--skip=check/chrootless,check/qemu", "--variant=extract"]
        what = [f"--arch={architecture}", f"--include={','.join(packages)}"]
        _run(["mmdebstrap", "--quiet", *modes, *what, SUITE, str(archive), MIRROR])
        # A /tmp in here would hide the real one from what is emulated, a /dev the real devices.
        reject = [f"--exclude=./{name}" for name in ("dev", "tmp", "proc", "sys", "run")]
        _run(["tar", "-x", "--no-same-owner", *reject, "-f", str(archive), "-C", str(folder)])

    return _made(f"{SUITE}-{architecture}-{packages[0]}", f"{packages} {MIRROR}", unpack, notify)


def fast_wheels(notify: Callable[[str], None]) -> Path:
    """Make the folder of the extra `fast` (200 MB) if it is not there; errors as of `prepare`."""
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        inputs = f"{PYTHON} {_pins(FAST)}"
        return _made("fast", inputs, lambda place: _download(place, FAST, "--no-deps"), notify)


def _pins(names: Sequence[str]) -> list[str]:
    """The lines of constraints.txt of some wheels."""
    return re.findall(rf"^(?:{'|'.join(names)})==.*$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)


def _download(folder: Path, wheels: Sequence[str], *more: str) -> None:
    pins = [
        "-c",
        str(ROOT / "constraints.txt"),
        "--target",
        str(folder),
        "--only-binary=:all:",
        *more,
        *wheels,
    ]
    if importlib.util.find_spec("pip") is not None:
        platforms = [f"--platform=manylinux_2_{glibc}_aarch64" for glibc in (28, 27, 26, 17)]
        abis = [f"--abi=cp{PYTHON.replace('.', '')}", "--abi=abi3", "--abi=none"]
        options = ["--quiet", "--no-compile", "--implementation=cp", f"--python-version={PYTHON}"]
        _run([sys.executable, "-m", "pip", "install", *options, *platforms, *abis, *pins])
    elif shutil.which("uv") is not None:
        options = ["--python-platform=aarch64-manylinux_2_28", f"--python-version={PYTHON}"]
        _run(["uv", "pip", "install", "--quiet", *options, *pins])
    else:
        raise NotPossibleError("neither pip in this environment nor uv: run make install")


def _compile_plugin(folder: Path) -> None:
    _run(["gcc", "-O2", "-Wall", "-shared", "-fPIC", "-o", str(folder / "count.so"), str(PLUGIN)])


def _version(root: Path, package: str) -> str:
    """Version of an unpacked package, by its own change log: dpkg knows nothing of it."""
    log = root / f"usr/share/doc/{package}/changelog.Debian.gz"
    with gzip.open(log, "rt", encoding="utf-8") as changes:
        return changes.readline().split("(")[1].split(")")[0]


def _wheel_versions(wheels: Path) -> dict[str, str]:
    names = sorted(folder.name.removesuffix(".dist-info") for folder in wheels.glob("*.dist-info"))
    return dict(name.split("-", 1) for name in names)


def _run(command: Sequence[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        tail = "\n".join((result.stderr or result.stdout).strip().splitlines()[-8:])
        error = NoNetworkError if any(sign in tail for sign in UNREACHABLE) else NotPossibleError
        raise error(f"{' '.join(command)} failed:\n{tail}")
