"""Removal of everything that belongs to Phalanx.

Services, releases, keys, calibration, groups, lines of config.txt. apt's packages stay.
"""

from __future__ import annotations

import contextlib
import shutil

from slave.install.boot_config import without_block
from slave.install.errors import InstallError
from slave.install.steps import Machine
from slave.install.systemd import run_command
from slave.install.transaction import write
from slave.install.wanted import BOOT, CHRONY, ETC, OPT, SYSUSERS, UNIT, File, Record

_STATE = ("var/lib/phalanx", "var/cache/phalanx", "var/log/phalanx")
_PRIVATE = ("var/lib/private/phalanx", "var/cache/private/phalanx", "var/log/private/phalanx")


def uninstall(machine: Machine, dry_run: bool = False) -> list[str]:
    """Remove it; what was there, as paths below the root.

    Raises:
        InstallError: A service does not stop, or another installation has no end.
        OSError: A file cannot be removed.
    """
    with contextlib.nullcontext() if dry_run else machine.alone():
        return _remove(machine, dry_run)


def _remove(machine: Machine, dry_run: bool) -> list[str]:
    root, run = machine.root, machine.systemd.run
    try:
        groups = Record.read(root).groups
    except InstallError:  # then they stay; all else goes
        groups = ()
    senders = sorted(path.stem for path in (root / ETC).glob("*.env"))
    units = [f"phalanx-slave@{name}.service" for name in senders]
    own = [UNIT, SYSUSERS, CHRONY, ETC, OPT, *_STATE, *_PRIVATE]
    own += [
        str(path.relative_to(root))
        for path in (root / "etc/systemd/system").glob("phalanx-slave@*.service.d")
    ]
    there = [path for path in own if (root / path).exists() or (root / path).is_symlink()]
    boot = root / BOOT
    text = boot.read_text(errors="surrogateescape") if boot.is_file() else ""
    if without_block(text) != text:
        there.append(BOOT)
    if dry_run or not there:
        return there
    if units:
        machine.notify(f"stopping {', '.join(units)}")
        run(["systemctl", "disable", "--now", "--quiet", *units])
    for path in there:
        machine.notify(f"removing {'our lines of ' if path == BOOT else ''}/{path}")
        target = root / path
        if path == BOOT:
            write(root, BOOT, File(without_block(text).encode(errors="surrogateescape"), 0o755))
        elif target.is_dir() and not target.is_symlink():
            shutil.rmtree(target)
        else:
            target.unlink()
    with contextlib.suppress(OSError):  # Debian has no such folder before; it stays where others use it
        (root / SYSUSERS).parent.rmdir()
    run(["systemctl", "daemon-reload"])
    for unit in units:
        with contextlib.suppress(InstallError):  # it had not failed
            run(["systemctl", "reset-failed", unit])
    if CHRONY in there:
        with contextlib.suppress(InstallError):  # chrony may be gone
            run(["systemctl", "try-reload-or-restart", "chrony.service"])
    for group in groups:
        with contextlib.suppress(InstallError):  # somebody else may have removed it, or may use it
            machine.systemd.run(["groupdel", group])
    return there


def packages(names: list[str], machine: Machine) -> None:
    """Install packages of the system by apt, and report which.

    Raises:
        InstallError: apt failed; without a network `--no-apt` leaves it out.
    """
    if not names:
        return
    command = ["apt-get", "install", "-y", "-q", "--no-install-recommends", *names]
    machine.notify(" ".join(command))
    try:
        run_command(["env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "update", "-q"], 300.0)
        run_command(["env", "DEBIAN_FRONTEND=noninteractive", *command], 1200.0)
    except InstallError as error:
        raise InstallError(f"{error}; --no-apt leaves this step out") from error
