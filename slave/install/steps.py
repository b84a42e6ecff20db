"""Install and remove Phalanx, step by step.

Release, files, switch, restart, wait; it is rolled back if the service does not run then. Removed is everything that
belongs to Phalanx: services, releases, keys, calibration, groups, lines of config.txt. apt's packages stay. Whatever
fails raises `InstallError`, and the machine is as before.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from slave.install import release
from slave.install.arguments import InstallError, NotReadyError, Plan, Sender, wanted_keys
from slave.install.release import Source
from slave.install.systemd import Systemd, run_command
from slave.install.transaction import CURRENT, Transaction, alone, changed, point, remove, write
from slave.install.wanted import (
    BOOT,
    CHRONY,
    DROP_IN,
    ETC,
    KEYS,
    LINK,
    OPT,
    RECORD,
    SYSUSERS,
    UNIT,
    File,
    Record,
    has_link,
    missing_groups,
    wanted_files,
    without_block,
)

_UNITS = "phalanx-slave@{}.service"


@dataclass(frozen=True, slots=True)
class Machine:
    """The machine that is installed on."""

    root: Path  # where its files are
    systemd: Systemd
    notify: Callable[[str], None]  # called with one line a step
    ready_s: float  # how long its slaves may take until they are ready, at most
    settle_s: float  # how long they then have to stay so

    def limit_s(self, unit: str) -> float:
        """Time limit [s] for the next start of a slave with the same options.

        While it is waited for, its camera sees nothing: so it is judged by its own last start on this machine.
        """
        took_s = self.systemd.state(unit).start_s
        # 10 s even for one that starts in one second, on a machine that is busy with its new release
        return self.ready_s if took_s is None else min(self.ready_s, max(10.0, 4.0 * took_s))

    def alone(self, dry_run: bool) -> contextlib.AbstractContextManager[None]:
        """Hold the machine while nobody else installs on it, unless nothing is written."""
        return contextlib.nullcontext() if dry_run else alone(self.root, self.notify, self.systemd.sleep)


@dataclass(slots=True)
class Outcome:
    """What an installation did."""

    release: str  # which one is current now
    # paths that were written or removed, and `current` if another release is
    changed: list[str] = field(default_factory=list[str])
    restarted: list[str] = field(default_factory=list[str])  # services
    reboot: bool = False  # whether config.txt has changed, which the next start reads


def install(plan: Plan, source: Source, name: str, machine: Machine, dry_run: bool = False) -> Outcome:
    """Bring the machine to the plan with release `name`, unless it is there already."""
    with machine.alone(dry_run):
        notes = Transaction(machine.root)
        if notes.is_open and not dry_run:
            machine.notify("an installation before was cut off: taking it back")
            _take_back(machine)
        record = Record.read(machine.root)
        files = wanted_files(plan, machine.root, record)
        groups = (*record.groups, *missing_groups(machine.root))
        files[RECORD] = Record.of(plan, tuple(dict.fromkeys(groups))).file()
        outcome = _difference(plan, files, name, machine)
        if dry_run:
            for path in outcome.changed:
                machine.notify(f"would {'remove' if files.get(path, path) is None else 'write'} /{path}")
            return outcome
        if not outcome.changed and not outcome.restarted:
            _enable(plan.senders, machine)
            return outcome
        made = release.make(machine.root, name, source, machine.notify)
        before = _current(machine.root)
        notes.begin([path for path in outcome.changed if path != CURRENT], outcome.restarted)
        try:
            _apply(plan, files, name, outcome, machine)
        except (InstallError, OSError) as error:
            machine.notify("taking it back")
            _undo(machine, plan.senders, name if made else None)
            raise InstallError(f"{error}; everything is as before") from error
        notes.end()
        for gone in release.prune(machine.root, name, before):
            machine.notify(f"removed release {gone}")
        return outcome


def roll_back(machine: Machine, dry_run: bool = False) -> str:
    """Go back to the state before the last installation; what is there, in a line."""
    with machine.alone(dry_run):
        left, before = _current(machine.root), Transaction(machine.root).release_before
        text = f"release {before}" if before else "no release, as before the first installation"
        if dry_run:
            return f"would go back to {text}"
        _take_back(machine, _senders(machine.root))
        if left is not None and left != before:
            release.remove(machine.root, left)
        return f"back at {text}"


def _difference(plan: Plan, files: dict[str, File | None], name: str, machine: Machine) -> Outcome:
    """What is not as it is to be, and which services have to be restarted for it."""
    outcome = Outcome(name, changed(machine.root, files))
    if _current(machine.root) != name:
        outcome.changed.append(CURRENT)
    everybodys = {UNIT, SYSUSERS, CURRENT, f"{KEYS}/rig.key", f"{KEYS}/ca.pem"}
    for sender in plan.senders:
        own = {f"{ETC}/{sender.name}.env", DROP_IN.format(sender.unit)}
        own |= {f"{KEYS}/{file}" for file in wanted_keys([sender.name])}
        if (everybodys | own) & set(outcome.changed) or not machine.systemd.state(sender.unit).active:
            outcome.restarted.append(sender.unit)
    outcome.reboot = BOOT in outcome.changed
    return outcome


def _apply(plan: Plan, files: dict[str, File | None], name: str, outcome: Outcome, machine: Machine) -> None:
    run, root = machine.systemd.run, machine.root
    limits = {  # before anything is stopped
        s.unit: machine.ready_s if f"{ETC}/{s.name}.env" in outcome.changed else machine.limit_s(s.unit)
        for s in plan.senders
    }
    for path in outcome.changed:
        if path == CURRENT:
            continue
        machine.notify(f"{'writing' if files[path] is not None else 'removing'} /{path}")
        file = files[path]
        if file is None:
            if path.endswith(".env"):
                run(["systemctl", "disable", "--now", _UNITS.format(Path(path).stem)])
            remove(root, path)
        else:
            write(root, path, file)
    if SYSUSERS in outcome.changed:
        run(["systemd-sysusers", str(root / SYSUSERS)])
    if CURRENT in outcome.changed:
        point(root / CURRENT, f"releases/{name}")
    if any(path.endswith((".env", ".service", "strobe.conf")) for path in outcome.changed):
        run(["systemctl", "daemon-reload"])
    if CHRONY in outcome.changed:
        _follow_clock(machine)
    _enable(plan.senders, machine)
    if outcome.restarted:
        machine.notify(f"starting {', '.join(outcome.restarted)}")
        run(["systemctl", "restart", "--no-block", *outcome.restarted])
    try:
        machine.systemd.wait_ready(limits, machine.settle_s)
    except NotReadyError as error:
        if not outcome.reboot:
            raise
        machine.notify(f"not ready before the machine is restarted, for config.txt has changed: {error}")


def _undo(machine: Machine, senders: tuple[Sender, ...], fresh: str | None) -> None:
    """Undo an installation; only report errors, for the first cause matters more."""
    try:
        _take_back(machine, {sender.name for sender in senders})
    except (InstallError, OSError) as error:
        machine.notify(f"what was before does not run either: {error}")
    if fresh is not None and _current(machine.root) != fresh:
        release.remove(machine.root, fresh)


def _take_back(machine: Machine, started: set[str] | None = None) -> None:
    run = machine.systemd.run
    units = Transaction(machine.root).take_back()
    there = _senders(machine.root)
    for name in sorted((started or set()) - there):
        with contextlib.suppress(InstallError):  # it may never have been there
            run(["systemctl", "disable", "--now", _UNITS.format(name)])
    run(["systemctl", "daemon-reload"])
    again = sorted({unit for unit in units if unit in {_UNITS.format(n) for n in there}})
    for name in sorted(there):
        run(["systemctl", "enable", "--quiet", _UNITS.format(name)])
    if again and _current(machine.root) is not None:
        run(["systemctl", "restart", "--no-block", *again])
        machine.systemd.wait_ready(dict.fromkeys(again, machine.ready_s), machine.settle_s)


def _enable(senders: tuple[Sender, ...], machine: Machine) -> None:
    for sender in senders:
        if not machine.systemd.state(sender.unit).enabled:
            machine.systemd.run(["systemctl", "enable", "--quiet", sender.unit])


def _follow_clock(machine: Machine) -> None:
    try:
        machine.systemd.run(["systemctl", "try-reload-or-restart", "chrony.service"])
    except InstallError as error:
        machine.notify(f"the clock does not follow the master yet: {error}")


def _current(root: Path) -> str | None:
    link = root / CURRENT
    return link.readlink().name if link.is_symlink() else None


def _senders(root: Path) -> set[str]:
    return {path.stem for path in (root / ETC).glob("*.env")}


_STATE = ("var/lib/phalanx", "var/cache/phalanx", "var/log/phalanx")
_PRIVATE = ("var/lib/private/phalanx", "var/cache/private/phalanx", "var/log/private/phalanx")


def uninstall(machine: Machine, dry_run: bool = False) -> list[str]:
    """Remove it; what was there, as paths below the root."""
    with machine.alone(dry_run):
        there = _there(machine.root)
        if there and not dry_run:
            _remove(there, machine)
        return there


def _there(root: Path) -> list[str]:
    """What is ours, as paths below the root."""
    own = [UNIT, SYSUSERS, CHRONY, *([LINK] if has_link(root) else []), ETC, OPT, *_STATE, *_PRIVATE]
    drop_ins = (root / "etc/systemd/system").glob("phalanx-slave@*.service.d")
    own += [str(path.relative_to(root)) for path in drop_ins]
    there = [path for path in own if (root / path).exists() or (root / path).is_symlink()]
    text = _boot_text(root)
    return there if without_block(text) == text else [*there, BOOT]


def _boot_text(root: Path) -> str:
    return (root / BOOT).read_text(errors="surrogateescape") if (root / BOOT).is_file() else ""


def _remove(there: list[str], machine: Machine) -> None:
    root, run = machine.root, machine.systemd.run
    try:
        groups = Record.read(root).groups
    except InstallError:  # then they stay; all else goes
        groups = ()
    units = [_UNITS.format(name) for name in sorted(_senders(root))]
    if units:
        machine.notify(f"stopping {', '.join(units)}")
        run(["systemctl", "disable", "--now", "--quiet", *units])
    for path in there:
        machine.notify(f"removing {'our lines of ' if path == BOOT else ''}/{path}")
        target = root / path
        if path == BOOT:
            write(root, BOOT, File(without_block(_boot_text(root)).encode(errors="surrogateescape"), 0o755))
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
            run(["groupdel", group])


def packages(names: list[str], machine: Machine) -> None:
    """Install packages of the system by apt, and report which."""
    if not names:
        return
    command = ["apt-get", "install", "-y", "-q", "--no-install-recommends", *names]
    machine.notify(" ".join(command))
    try:
        run_command(["env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "update", "-q"], 300.0)
        run_command(["env", "DEBIAN_FRONTEND=noninteractive", *command], 1200.0)
    except InstallError as error:
        raise InstallError(f"{error}; --no-apt leaves this step out") from error
