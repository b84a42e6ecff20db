"""Commands run the demo, or deploy, roll back and uninstall slaves."""

import argparse
import contextlib
import functools
import json
import socket
import sys
import tempfile
from argparse import Namespace
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path

from deploy.arguments import check_reach, check_wish
from deploy.demo import DemoError, DemoSettings, best_rigs, run_demo, stop_on_signals
from deploy.deployment import (
    Ears,
    Lines,
    Notify,
    Reached,
    Wish,
    deploy,
    make_keys,
    reach_of,
    roll_back,
    uninstall,
)
from deploy.payload import Kind, export
from deploy.remote import DeployError, RigFile, Target, read_rig, targets_of

_EVERYWHERE = "255.255.255.255"  # of the network that --master is in


def rig_of(options: argparse.Namespace) -> RigFile:
    """Return the rig, which must have the requested role.

    Raises:
        DeployError: It is not, or lacks an option.
    """
    rig = read_rig(options.calibration, options.rig)
    if options.role is not None and (options.role == "wrist") != (rig.kind == "wrist"):
        raise DeployError(f"--role {options.role}: rig {rig.name!r} is of kind {rig.kind!r}")
    return rig


def wish_of(options: argparse.Namespace, rig: RigFile) -> Wish:
    """What is wanted on the machines."""
    check_wish(options, rig)
    handed = [
        f"--{name}={one}" for name in ("camera", "options", "overlay") for one in getattr(options, name)
    ]
    handed += [
        f"--{name}={value}"
        for name in ("role", "imu", "lights")
        if (value := getattr(options, name)) is not None
    ]
    return Wish(
        options.master,
        rig,
        options.calibration,
        options.keys,
        tuple(handed),
        tuple(options.camera),
        options.wheelhouse,
        not options.no_apt,
        options.dry_run,
        options.ready_s,
    )


def ears_of(options: argparse.Namespace) -> Ears | None:
    """Return how first datagrams are received: here, or at another machine's master."""
    if options.no_wait:
        return None
    address = _here(options.master)
    bus_host = "127.0.0.1" if address else options.master
    words = ["--rig", options.rig, "--calibration", str(options.calibration)]
    beacon_port, data_port, bus_port = 47800, 47801, 47802
    words += ["--bus", options.bus or f"tls/{bus_host}:{bus_port}"]
    words += ["--bind", options.bind or f"{address or '0.0.0.0'}:{data_port}"]
    default = "127.255.255.255" if (address or "").startswith("127.") else _EVERYWHERE
    words += ["--beacon", options.beacon or f"{default}:{beacon_port}"]
    return Ears(tuple(words), options.keys, options.wait_s)


def reached_of(options: argparse.Namespace) -> Reached:
    """How the machines are reached."""
    check_reach(options)
    return Reached(
        reach_of(options.user, options.port, options.identity, options.ssh_option), options.deadline
    )


def _here(master: str) -> str | None:
    """Address of `--master`, if this machine's; DeployError: the name is not known."""
    try:
        address = str(socket.getaddrinfo(master, None, socket.AF_INET)[0][4][0])
    except OSError as error:
        raise DeployError(f"--master {master}: {error.strerror}; give its address") from error
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, 0))
        except OSError:
            return None
    return address


@contextlib.contextmanager
def prepared_keys(folder: Path, names: Sequence[str], dry_run: bool, notify: Notify) -> Generator[Path]:
    """Provide a keys folder that has all that these senders need.

    Args:
        folder: That of the user; what it lacks is made.
        dry_run: Nothing is made there. A private folder takes its place meanwhile, so that the rest of the
            way can be looked at: links to what is there, and what is lacking, made for nobody.
        notify: Called with what is made.

    Raises:
        DeployError: They cannot be made.
    """
    if not dry_run:
        make_keys(folder, names, notify)
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="phalanx-keys-") as private:
        keys = Path(private) / "keys"
        make_keys(keys, names, lambda _line: None)
        lacking = 0
        for file in [path for path in keys.rglob("*") if path.is_file()]:
            there = folder / file.relative_to(keys)
            if there.is_file():
                file.unlink()
                file.symlink_to(there.resolve())
            else:
                lacking += 1
        if lacking:
            notify(f"would make keys in {folder}")
        yield keys


Work = Callable[[Namespace], int]


def plainly(work: Work) -> Work:
    """Make `work` end with one line and exit code 1 on errors the user can fix."""

    @functools.wraps(work)
    def run(options: Namespace) -> int:
        try:
            return work(options)
        except (DemoError, DeployError) as error:
            sys.stderr.write(f"phalanx: {error}\n")
            return 1

    return run


@plainly
def demo(options: Namespace) -> int:
    """Run the demo; the exit code."""
    rigs = options.rigs or best_rigs(options.scene)
    settings = DemoSettings(
        options.seconds,
        options.headless,
        options.out,
        options.calibration,
        tuple(rigs),
        options.seed,
        options.scene,
        options.web,
        bus=options.bus,
        console=options.console,
    )
    summary = run_demo(settings, stop_on_signals(), _notify)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(summary, indent=1) + "\n")
    _notify(
        f"\npicture {settings.out / 'hand.png'}\nRerun   {settings.out / 'run.rrd'}   (open with: rerun FILE)"
    )
    return 0


@plainly
def deploy_slaves(options: Namespace) -> int:
    """Bring slaves to their machines; the exit code."""
    rig = rig_of(options)
    targets = targets_of(options.hosts, rig)
    wish, ears, reached, notify = wish_of(options, rig), ears_of(options), reached_of(options), Lines(_notify)
    names = [name for target in targets for name in target.names]
    with prepared_keys(options.keys, names, options.dry_run, notify) as keys:
        return _judge(deploy(targets, replace(wish, keys=keys), reached, ears, notify))


@plainly
def rollback(options: Namespace) -> int:
    """Bring machines back to what they had; the exit code."""
    return _judge(roll_back(_all(options.hosts), reached_of(options), options.dry_run, Lines(_notify)))


@plainly
def uninstall_slaves(options: Namespace) -> int:
    """Take slaves from their machines; the exit code."""
    return _judge(uninstall(_all(options.hosts), reached_of(options), options.dry_run, Lines(_notify)))


@plainly
def wheels(options: Namespace) -> int:
    """Gather wheels in a folder; the exit code."""
    kind = Kind(options.machine, options.python, tuple(options.more), ("wrist",))
    made = export(kind, options.folder, _notify)
    _notify(f"{options.folder}: {len(made.files)} wheels, {made.size_mb:.0f} MB, release {made.release}")
    return 0


def _all(hosts: Sequence[str]) -> list[Target]:
    """Machines, whatever they serve."""
    return [Target(host, ()) for host in dict.fromkeys(hosts)]


def _judge(results: dict[str, str | None]) -> int:
    """Notify which machines failed; the exit code."""
    failed = {host: why for host, why in results.items() if why is not None}
    for host, why in failed.items():
        sys.stderr.write(f"{host}: FAILED: {why}\n")
    return 1 if failed else 0


def _notify(line: str) -> None:
    end = "\n"
    if line.startswith("\r"):  # written over by the next
        end, line = ("", line) if sys.stdout.isatty() else ("\n", line[1:])
    sys.stdout.write(line + end)
    sys.stdout.flush()
