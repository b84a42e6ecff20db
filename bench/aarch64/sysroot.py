"""What the count needs, made once under out/aarch64: Debian's aarch64 Python, the pinned wheels, the QEMU plugin.

Nothing is installed and nothing needs root: the Debian packages are unpacked, not set up.
"""

import gzip
import hashlib
import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
CACHE = ROOT / "out" / "aarch64"
SUITE, MIRROR, PYTHON = "bookworm", "http://deb.debian.org/debian", "3.11"  # Raspberry Pi OS 12
PACKAGES = ("python3", "libgomp1", "libstdc++6")
WHEELS = ("numpy", "opencv-python-headless", "msgspec", "cryptography")
KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
TOOLS = {"qemu-aarch64": "qemu-user", "mmdebstrap": "mmdebstrap", "gcc": "gcc libc6-dev", "tar": "tar"}


class NotPossibleError(Exception):
    """The count cannot be made here; the message says what is missing and how to get it."""


class Sysroot(NamedTuple):
    """Folders and files of the emulated machine, and the versions that the count depends on."""

    root: Path
    wheels: Path
    plugin: Path
    versions: dict[str, str]


def missing() -> list[str]:
    """Debian packages of the tools that are not here."""
    absent = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if not KEYRING.exists():
        absent.append("debian-archive-keyring")
    return absent


def prepare(say: Callable[[str], None]) -> Sysroot:
    """Make what is not there yet.

    Raises:
        NotPossibleError: A tool is missing, or fails.
    """
    if absent := missing():
        raise NotPossibleError(
            f"missing here: {', '.join(absent)}; on Debian: apt install {' '.join(absent)}"
        )
    constraints = (ROOT / "constraints.txt").read_text()
    root = _made(f"root-{SUITE}", f"{SUITE} {PACKAGES}", _unpack_debian, say)
    pins = "\n".join(_pins(constraints))
    wheels = _made("wheels", f"{PYTHON} {WHEELS} {pins}", _download_wheels, say)
    version = qemu_version(_output(["qemu-aarch64", "--version"]))
    source = Path(__file__).with_name("count.c")
    plugin = _made("plugin", f"{plugin_interface(version)} {source.read_text()}", _compile_plugin, say)
    versions = {"qemu": ".".join(map(str, version)), **_debian_versions(root), **_wheel_versions(wheels)}
    return Sysroot(root, wheels, plugin / "count.so", versions)


def qemu_version(text: str) -> tuple[int, int]:
    """(Major, minor) from what `qemu-aarch64 --version` prints.

    Raises:
        NotPossibleError: That is not QEMU's answer.
    """
    found = re.search(r"version (\d+)\.(\d+)", text)
    if found is None:
        raise NotPossibleError(f"qemu-aarch64 --version says {text.strip()!r}, and no version in it")
    return int(found[1]), int(found[2])


def plugin_interface(version: tuple[int, int]) -> int:
    """Number of the plugin interface to declare: QEMU 9 refuses 1, QEMU 8 and before know nothing else."""
    return 1 if version[0] < 9 else 2


def _made(name: str, inputs: str, make: Callable[[Path], None], say: Callable[[str], None]) -> Path:
    """The folder `name` of the cache, made afresh if its inputs are others than those it was made of."""
    key = hashlib.sha256(inputs.encode()).hexdigest()[:12]
    place = CACHE / f"{name}-{key}"
    if place.is_dir():
        return place
    say(f"making {place.relative_to(ROOT)} ...")
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE, prefix=f"{name}-unfinished-") as unfinished:
        folder = Path(unfinished) / "made"
        folder.mkdir()
        make(folder)
        try:
            folder.rename(place)
        except OSError:
            if not place.is_dir():  # else another run was faster, and made the same
                raise
    return place


def _unpack_debian(folder: Path) -> None:
    archive = folder.with_name("root.tar")
    command = ["mmdebstrap", "--quiet", "--variant=extract", "--arch=arm64", "--skip=check/qemu"]
    _run([*command, f"--include={','.join(PACKAGES)}", SUITE, str(archive), MIRROR])
    # A /tmp in here would hide the real one, a /dev the real devices.
    leave_out = [f"--exclude=./{name}" for name in ("dev", "tmp", "proc", "sys", "run")]
    _run(["tar", "-x", "--no-same-owner", *leave_out, "-f", str(archive), "-C", str(folder)])
    if not (folder / "lib").exists():
        (folder / "lib").symlink_to("usr/lib")  # Debian 13 makes it only when the package is set up


def _pins(constraints: str) -> list[str]:
    names = "|".join([*WHEELS, "cffi", "pycparser"])
    return re.findall(rf"^(?:{names})==.*$", constraints, re.MULTILINE)


def _download_wheels(folder: Path) -> None:
    pins = ["-c", str(ROOT / "constraints.txt"), "--target", str(folder), "--only-binary=:all:", *WHEELS]
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
    interface = plugin_interface(qemu_version(_output(["qemu-aarch64", "--version"])))
    source = str(Path(__file__).with_name("count.c"))
    options = ["-O2", "-Wall", "-shared", "-fPIC", f"-DPLUGIN_VERSION={interface}"]
    _run(["gcc", *options, "-o", str(folder / "count.so"), source])


def _debian_versions(root: Path) -> dict[str, str]:
    """Versions of the unpacked packages that matter, of which dpkg knows nothing."""
    versions: dict[str, str] = {}
    for package in ("libc6", f"python{PYTHON}-minimal"):
        with gzip.open(
            root / f"usr/share/doc/{package}/changelog.Debian.gz", "rt", encoding="utf-8"
        ) as changes:
            versions[package] = changes.readline().split("(")[1].split(")")[0]
    return versions


def _wheel_versions(wheels: Path) -> dict[str, str]:
    return dict(
        folder.name.removesuffix(".dist-info").split("-", 1) for folder in sorted(wheels.glob("*.dist-info"))
    )


def _output(command: Sequence[str]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def _run(command: Sequence[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        tail = "\n".join((result.stderr or result.stdout).strip().splitlines()[-8:])
        raise NotPossibleError(f"{' '.join(command)} failed:\n{tail}")
