"""Install, update or remove the service on this machine.

`phalanx-slave install`, and what the PC runs by ssh: keys and calibration come from folders of this machine, or from
the archive that the PC sent with the installer. Whatever goes wrong is an `InstallError`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import stat
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from slave.install import steps
from slave.install.arguments import READY_S, SETTLE_S, InstallError, add_install, plan_of
from slave.install.probe import judge, probe
from slave.install.release import Source
from slave.install.steps import packages, uninstall
from slave.install.systemd import Systemd
from slave.install.wanted import ETC

KEYS, CALIBRATION = "payload/keys/", "payload/calib_json/"
_SHARED = stat.S_IRWXG | stat.S_IRWXO


def from_archive(archive: Path) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """Keys and calibration of an archive: path -> content each."""
    try:
        with zipfile.ZipFile(archive) as opened:
            names = [name for name in opened.namelist() if not name.endswith("/")]
            keys, calibration = (
                {n.removeprefix(place): opened.read(n) for n in names if n.startswith(place)}
                for place in (KEYS, CALIBRATION)
            )
    except (OSError, zipfile.BadZipFile) as error:
        raise InstallError(f"{archive}: not what the PC sends ({error})") from error
    return keys, calibration


def calibration_of(folder: Path) -> dict[str, bytes]:
    """All JSON files of a calib_json tree."""
    if not (folder / "rigs").is_dir():
        raise InstallError(f"{folder}: no calib_json tree (no rigs/ in it); give --calibration DIR")
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.glob("*/*.json"))
    }


def keys_of(folder: Path | None) -> dict[str, bytes]:
    """The files of a keys folder that a device may have; empty without a folder."""
    if folder is None:
        return {}
    if not folder.is_dir():
        raise InstallError(
            f"{folder}: no such folder of keys; make one on the PC: phalanx fleet keys {folder} --make"
        )
    found: dict[str, bytes] = {}
    for path in sorted([*folder.glob("*"), *folder.glob("devices/*")]):
        name = path.relative_to(folder).as_posix()
        ours = name in ("rig.key", "ca.pem") or name.startswith(("devices/", "device-", "device."))
        if ours and path.is_file():
            if path.suffix in (".key", ".secret") and stat.S_IMODE(path.stat().st_mode) & _SHARED:
                raise InstallError(f"{path}: others can read this key; run: chmod 600 {path}")
            found[name] = path.read_bytes()
    return found


Notify = Callable[[str], None]


def run_here(options: argparse.Namespace) -> int:
    """`phalanx-slave install`: install, take back, or remove; the exit code."""

    def notify(line: str) -> None:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    return run(options, notify)


def run(options: argparse.Namespace, notify: Notify, systemd: Systemd | None = None) -> int:
    """Install, roll back, or remove; the exit code: 1 something the user can mend."""
    machine = steps.Machine(options.root, systemd or Systemd(), notify, options.ready_s, options.settle_s)
    os.umask(0o022)  # the slave, who is not root, runs what is installed
    try:
        if os.geteuid() != 0 and options.root == Path("/") and not options.dry_run:
            raise InstallError("only root can install a service: sudo phalanx-slave install ...")
        done = _act(options, machine)
    except InstallError as error:
        why = str(error)
    except OSError as error:
        why = f"{error.filename or options.root}: {error.strerror or error}"
    else:
        notify(json.dumps({"result": done}) if options.json else str(done["text"]))
        return 0
    notify(json.dumps({"result": {"error": why}}) if options.json else f"phalanx-slave: {why}")
    return 1


def _act(options: argparse.Namespace, machine: steps.Machine) -> dict[str, object]:
    if options.uninstall:
        gone = uninstall(machine, options.dry_run)
        would = "would remove" if options.dry_run else "removed"
        text = f"{would} {', '.join('/' + path for path in gone)}; packages of apt stay"
        return {"removed": gone, "text": text if gone else "nothing of ours is there"}
    if options.rollback:
        return {"text": steps.roll_back(machine, options.dry_run)}
    if options.bundle is not None:
        keys, calibration = from_archive(options.bundle)
    else:
        keys, calibration = keys_of(options.keys), calibration_of(options.calibration)
    plan = plan_of(options, calibration, keys)
    source = Source.here() if options.wheelhouse is None else Source(options.wheelhouse)
    if options.bundle is None:
        _prepare(options, plan.picamera2, machine)
    name = options.release or source.name()
    try:
        outcome = steps.install(plan, source, name, machine, options.dry_run)
    finally:
        if options.bundle is not None and options.wheelhouse is not None and not options.dry_run:
            _clear(options.wheelhouse)
    return {**asdict(outcome), "text": report_line(outcome, options.dry_run)}


def _clear(stage: Path) -> None:
    """Remove what the PC sent for this installation, or others cut off long ago."""
    for one in stage.parent.glob("*"):
        if one == stage or time.time() - one.stat().st_mtime > 3600.0:  # no installation takes an hour
            shutil.rmtree(one, ignore_errors=True)
    with contextlib.suppress(OSError):  # somebody else's are there
        stage.parent.rmdir()


def report_line(outcome: steps.Outcome, dry_run: bool) -> str:
    """What was done, or would be, in one line."""
    if not outcome.changed and not outcome.restarted:
        return f"unchanged: release {outcome.release}"
    units = ", ".join(outcome.restarted) or "nothing"
    if dry_run:
        return f"would have release {outcome.release}, and restart {units}"
    text = f"has release {outcome.release}, restarted {units}"
    return f"{text}; config.txt has changed: restart the machine" if outcome.reboot else text


def _prepare(options: argparse.Namespace, picamera2: bool, machine: steps.Machine) -> None:
    """Look at this machine, and bring what it lacks by apt."""
    if options.root != Path("/"):
        return
    camera = "picamera2" if picamera2 else ""
    facts = probe(options.root, camera)
    if (why := judge(facts, camera, not options.no_apt)) is not None:
        raise InstallError(why)
    wanted = ["chrony", *(["python3-picamera2"] if picamera2 else [])]
    missing = [name for name in wanted if name not in facts["packages"]]
    if options.no_apt or options.dry_run:
        for name in missing:
            machine.notify(f"not installed: {name}")
        return
    packages(missing, machine)


def _start_s(systemd: Systemd) -> float | None:
    """How long the slowest slave here took to start [s]; None: not known."""
    units = [f"phalanx-slave@{path.stem}.service" for path in (Path("/") / ETC).glob("*.env")]
    try:
        took = [systemd.state(unit).start_s for unit in units]
    except InstallError:
        return None
    return max((one for one in took if one is not None), default=None)


def main(arguments: list[str], notify: Notify, systemd: Systemd | None = None) -> int:
    """Run `python3 -m slave.install ACTION ...`, as the PC does.

    `install` is `phalanx-slave install`; `probe [CAMERA [--no-apt]]` reports the machine's state; `packages NAME...`
    calls apt.
    """
    action, rest = (arguments[0], arguments[1:]) if arguments else ("", [])
    if action == "probe":
        camera = rest[0] if rest else ""
        facts = probe(camera=camera)
        why_not = judge(facts, camera, "--no-apt" not in rest[1:])
        found = {"why_not": why_not, "start_s": _start_s(systemd or Systemd())}
        notify(json.dumps({"result": facts | found}))
        return 0
    if action == "packages":
        try:
            packages(rest, steps.Machine(Path("/"), Systemd(), notify, READY_S, SETTLE_S))
        except InstallError as error:
            notify(json.dumps({"result": {"error": str(error)}}))
            return 1
        notify(json.dumps({"result": {}}))
        return 0
    if action != "install":
        sys.stderr.write("python3 -m slave.install install|probe|packages ...; `install --help` says more\n")
        return 0 if action in ("-h", "--help") else 2
    parser = argparse.ArgumentParser("slave.install", description="Install slaves as services.")
    add_install(parser)
    return run(parser.parse_args(rest), notify, systemd)
