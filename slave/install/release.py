"""Make and remove releases below /opt/phalanx.

Each is a virtual environment, made under another name and renamed when it is whole. It sees the system's packages
(picamera2 and libcamera come by apt); what it has itself goes before them. That comes from a folder of wheels,
without a network, or from the environment that the installer runs in. No room, and wheels that are missing or of
another machine, raise `InstallError`; nothing of that release stays.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path

from slave.install.arguments import InstallError
from slave.install.systemd import finished, run_command
from slave.install.wanted import OPT

RELEASES = f"{OPT}/releases"
OURS = "phalanx-hand"
_PACKAGES = ("slave", "common", "master", "deploy")
# What a slave loads; its service may not write, so what is not compiled now is compiled at each start.
_LOADS = "import slave.__main__, slave.live, slave.sender, slave.commands.devices, slave.commands.simulated"
_SCRIPT = """\
#!{python}
import sys

from slave.__main__ import main

sys.exit(main())
"""


@dataclass(frozen=True, slots=True)
class Source:
    """Packages of a release: a folder of wheels, or site-packages."""

    folder: Path
    wheels: bool = True

    @staticmethod
    def here() -> Source:
        """The environment that this runs in."""
        return Source(Path(sysconfig.get_path("purelib")), wheels=False)

    def name(self) -> str:
        """Version and a hash of all that is in it: other content is another release.

        Where the installer runs from a release only files change, so that is the name.
        """
        digest, folder = hashlib.sha256(), self.folder
        if self.wheels:
            wheels = sorted(folder.glob("*.whl"))
            for wheel in wheels:
                digest.update(wheel.name.encode() + hashlib.sha256(wheel.read_bytes()).digest())
            versions = [w.name.split("-")[1] for w in wheels if w.name.startswith("phalanx_hand-")]
        else:
            parts = folder.resolve().parts
            if parts[:4] == ("/", *RELEASES.split("/")) and len(parts) > 4:
                return parts[4]
            packages = list(distributions(path=[str(folder)]))
            for package in packages:
                digest.update((package.read_text("RECORD") or package.name).encode())
            own = _own_packages(folder)
            for file in sorted(own.rglob("*.py")):
                if file.relative_to(own).parts[0] in _PACKAGES:
                    digest.update(file.read_bytes())
            versions = [one.version for one in packages if one.name == OURS]
        if not versions:
            raise InstallError(f"{folder}: no {OURS} in it")
        return f"{versions[-1]}-{digest.hexdigest()[:8]}"


def make(root: Path, name: str, source: Source, notify: Callable[[str], None]) -> bool:
    """Make the release `name` if it is not there whole; whether it had to be made."""
    releases = root / RELEASES
    if (releases / name).is_dir():
        return False
    releases.mkdir(parents=True, exist_ok=True)
    for left in releases.glob(".new-*"):
        shutil.rmtree(left, ignore_errors=True)
    _check_space(releases, source)
    fresh = releases / f".new-{name}"
    notify(f"making release {name}")
    try:
        venv.EnvBuilder(system_site_packages=True, symlinks=True, with_pip=False).create(fresh)
        (_install_wheels if source.wheels else _copy_site)(fresh, source.folder)
        _settle(fresh, releases / name, root)
        os.sync()
        fresh.rename(releases / name)
    except OSError as error:
        raise InstallError(f"release {name}: {error.strerror or error}: {error.filename or fresh}") from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return True


def prune(root: Path, current: str, before: str | None) -> list[str]:
    """Remove all but the current release and that before, else the newest other."""
    folders = sorted((root / RELEASES).glob("[!.]*"), key=lambda path: path.stat().st_mtime)
    others = [path.name for path in folders if path.name != current]
    kept = before if before in others else others[-1] if others else None
    gone = [name for name in others if name != kept]
    for name in gone:
        remove(root, name)
    return gone


def remove(root: Path, name: str) -> None:
    """Remove a release, its name first: half of one is never taken for a whole one."""
    left = root / RELEASES / f".new-{name}"
    shutil.rmtree(left, ignore_errors=True)
    with contextlib.suppress(FileNotFoundError):
        (root / RELEASES / name).rename(left)
    shutil.rmtree(left, ignore_errors=True)


def _check_space(releases: Path, source: Source) -> None:
    if source.wheels:
        contents = [zipfile.ZipFile(wheel).infolist() for wheel in source.folder.glob("*.whl")]
        size = sum(item.file_size for items in contents for item in items)
    else:
        size = sum(file.stat().st_size for file in source.folder.rglob("*") if file.is_file())
    # 0.4 of it for what is compiled and what a disk rounds up, and something to spare
    needed_mb = size * 1e-6 * 1.4 + 50.0
    free_mb = shutil.disk_usage(releases).free * 1e-6
    if free_mb < needed_mb:
        raise InstallError(
            f"{releases}: {free_mb:.0f} MB free, a release needs {needed_mb:.0f} MB; make room there"
        )


def _install_wheels(fresh: Path, wheels: Path) -> None:
    """Install one of each package of the folder; pip itself comes out of it, too."""
    found = sorted(wheels.glob("*.whl"))
    if not found:
        raise InstallError(f"{wheels}: no wheels there (another installation removed its own?); deploy again")
    names = sorted({wheel.name.split("-")[0] for wheel in found} - {"pip"})
    pips = [wheel for wheel in found if wheel.name.startswith("pip-")]
    if not pips and importlib.util.find_spec("pip") is None:
        raise InstallError(
            f"{wheels}: no wheel of pip in it, and this system has no pip; on a PC `phalanx fleet wheels DIR` has all"
        )
    command = [sys.executable, str(pips[-1] / "pip")] if pips else [sys.executable, "-m", "pip"]
    command += ["--python", str(fresh / "bin/python"), "install", "--no-index", "--find-links", str(wheels)]
    command += ["--only-binary=:all:"]  # nothing is built here
    command += ["--ignore-installed", "--no-compile", "--disable-pip-version-check", "--no-input", "--quiet"]
    command += ["--root-user-action=ignore", *names]
    pip_s = 1500.0  # under emulation, too
    try:
        done = finished(command, pip_s)
    except subprocess.TimeoutExpired as error:
        raise InstallError(f"pip: no end after {pip_s:.0f} s") from error
    if done.returncode != 0:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR:")]
        why = errors[-1].removeprefix("ERROR: ") if errors else done.stderr[-300:]
        raise InstallError(f"{wheels}: {why.strip()}")


def _copy_site(fresh: Path, site: Path) -> None:
    """Copy the packages beside the installer, and our own from where they are."""
    there = next((fresh / "lib").glob("python3*/site-packages"))
    shutil.copytree(site, there, dirs_exist_ok=True, symlinks=True, ignore=shutil.ignore_patterns("*.pth"))
    own = _own_packages(site)
    for package in _PACKAGES if own != site else ():
        if (own / package).is_dir():
            shutil.copytree(own / package, there / package, ignore=shutil.ignore_patterns("__pycache__"))
    script = fresh / "bin/phalanx-slave"
    script.write_text(_SCRIPT.format(python=fresh / "bin/python"))
    script.chmod(0o755)


def _own_packages(site: Path) -> Path:
    """The folder that has our packages: `site`, or where they are developed."""
    return site if (site / "slave").is_dir() else Path(__file__).resolve().parents[2]


def _settle(fresh: Path, final: Path, root: Path) -> None:
    """Set the final path in a release's scripts and check that the slave starts."""
    old, new = str(fresh).encode(), str(Path("/") / final.relative_to(root)).encode()
    if not (fresh / "bin/phalanx-slave").is_file():
        raise InstallError(f"release {final.name}: has no phalanx-slave; is its wheel whole?")
    try:
        run_command([str(fresh / "bin/python"), "-I", "-c", _LOADS], 300.0)
    except InstallError as error:
        raise InstallError(f"release {final.name} does not load: {str(error).partition(': ')[2]}") from error
    for script in (fresh / "bin").iterdir():
        if script.is_file() and not script.is_symlink():
            content = script.read_bytes()
            if content.startswith(b"#!") and old in content:
                script.write_bytes(content.replace(old, new))
    for script in (fresh / "bin").glob("[aA]ctivate*"):
        script.unlink()
