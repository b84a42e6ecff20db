"""Commands run the demo, or deploy, roll back and uninstall slaves."""

import contextlib
import functools
import json
import os
import re
import socket
import sys
import tempfile
from argparse import Namespace
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path

from deploy.demo import DemoSettings, best_rigs, run_demo, stop_on_signals
from deploy.deployment import (
    DeployRequest,
    Host,
    ListenOptions,
    Notify,
    SshOptions,
    deploy,
    end_all,
    make_keys,
)
from deploy.payload import Kind, RigFile, Target, export, read_rig, targets_of
from deploy.remote import DeployError, Terminal, printable

_EVERYWHERE = "255.255.255.255"  # of the network that --master is in
_PREFIXED = re.compile(r"[A-Za-z0-9_.]+=")  # NAME= before a driver or before options


def request_of(options: Namespace, rig: RigFile) -> DeployRequest:
    """What the options request on the machines of `rig`.

    Raises:
        DeployError: Another role, an option for a name that the rig does not have, or a wheelhouse without wheels.
    """
    if options.role is not None and (options.role == "wrist") != (rig.kind == "wrist"):
        raise DeployError(f"--role {options.role}: rig {rig.name!r} is of kind {rig.kind!r}")
    for option in ("camera", "options"):
        for text in getattr(options, option):
            name = text.partition("=")[0]
            if _PREFIXED.match(text) and name not in rig.names:
                raise DeployError(
                    f"--{option} {text!r}: rig {rig.name!r} has no {name!r}; it has {', '.join(rig.names)}"
                )
    if options.wheelhouse is not None and not any(options.wheelhouse.glob("*.whl")):
        raise DeployError(
            f"--wheelhouse {options.wheelhouse}: no wheels in it; phalanx fleet wheels DIR gathers them"
        )
    repeated = {f"--{name}": getattr(options, name) for name in ("camera", "options", "overlay")}
    handed = [f"{name}={one}" for name, values in repeated.items() for one in values]
    single = {f"--{name}": getattr(options, name) for name in ("role", "imu", "lights")}
    handed += [f"{name}={value}" for name, value in single.items() if value is not None]
    return DeployRequest(
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


def listen_options(options: Namespace) -> ListenOptions | None:
    """How first datagrams are received: here, or at another machine's master."""
    if options.no_wait:
        return None
    address = _here(options.master)
    bus_host = "127.0.0.1" if address else options.master
    words = ["--rig", options.rig, "--calibration", str(options.calibration)]
    words += ["--bus", options.bus or f"tls/{bus_host}:47802"]
    words += ["--bind", options.bind or f"{address or '0.0.0.0'}:47801"]
    default = "127.255.255.255" if (address or "").startswith("127.") else _EVERYWHERE
    words += ["--beacon", options.beacon or f"{default}:47800"]
    return ListenOptions(tuple(words), options.keys, options.wait_s)


def ssh_options(options: Namespace) -> SshOptions:
    """How the machines are reached; DeployError: the private key is not there."""
    if options.identity is not None and not options.identity.is_file():
        raise DeployError(f"--identity {options.identity}: no such file; ssh-keygen makes one")
    given = {"-l": options.user, "-p": options.port, "-i": options.identity}
    words = [word for option, value in given.items() if value for word in (option, str(value))]
    words += [word for option in options.ssh_option for word in ("-o", option)]
    return SshOptions(tuple(words), options.deadline)


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
    """Provide a keys folder that has all that these senders need, or DeployError.

    What `folder` lacks is made. In a dry run a private folder takes its place meanwhile, so that the rest of the way
    can be looked at: links to what is there, and what is lacking, made for nobody.
    """
    if not dry_run:
        make_keys(folder, names, notify)
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="phalanx-keys-") as private:
        keys = Path(private) / "keys"
        make_keys(keys, names, lambda _line: None)
        lacking = False
        for file in [path for path in keys.rglob("*") if path.is_file()]:
            there = folder / file.relative_to(keys)
            if there.is_file():
                file.unlink()
                file.symlink_to(there.resolve())
            else:
                lacking = True
        if lacking:
            notify(f"would make keys in {folder}")
        yield keys


def plainly(work: Callable[[Namespace], int]) -> Callable[[Namespace], int]:
    """Make `work` end with one line and exit code 1 on errors the user can fix."""

    @functools.wraps(work)
    def run(options: Namespace) -> int:
        try:
            return work(options)
        except DeployError as error:
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
    rig = read_rig(options.calibration, options.rig)
    targets = targets_of(options.hosts, rig)
    request, listening, ssh = request_of(options, rig), listen_options(options), ssh_options(options)
    names = [name for target in targets for name in target.names]
    with (
        Terminal(_notify, _asks()).listening() as terminal,
        prepared_keys(options.keys, names, options.dry_run, terminal.notify) as keys,
    ):
        return _judge(deploy(targets, replace(request, keys=keys), ssh, listening, terminal))


@plainly
def rollback(options: Namespace) -> int:
    """Bring machines back to what they had; the exit code."""
    return _end_all(options, lambda host: host.roll_back(options.dry_run))


@plainly
def uninstall_slaves(options: Namespace) -> int:
    """Take slaves from their machines; the exit code."""
    return _end_all(options, lambda host: host.uninstall(options.dry_run))


@plainly
def wheels(options: Namespace) -> int:
    """Gather wheels in a folder; the exit code."""
    kind = Kind(options.machine, options.python, tuple(options.more), ("wrist",))
    made = export(kind, options.folder, _notify)
    _notify(f"{options.folder}: {len(made.files)} wheels, {made.size_mb:.0f} MB, release {made.release}")
    return 0


def _end_all(options: Namespace, act: Callable[[Host], str]) -> int:
    targets = [Target(host, ()) for host in dict.fromkeys(options.hosts)]  # whatever they serve
    with Terminal(_notify, _asks()).listening() as terminal:
        return _judge(end_all(targets, ssh_options(options), act, terminal))


def _asks() -> bool:
    """Whether there is a terminal, where a person can be asked."""
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
    except OSError:
        return False
    return True


def _judge(results: dict[str, str | None]) -> int:
    """Notify which machines failed; the exit code."""
    failed = {host: why for host, why in results.items() if why is not None}
    for host, why in failed.items():
        sys.stderr.write(f"{host}: FAILED: {printable(why)}\n")
    return 1 if failed else 0


def _notify(line: str) -> None:
    end = "\n"
    if line.startswith("\r"):  # written over by the next
        end, line = ("", line) if sys.stdout.isatty() else ("\n", line[1:])
    sys.stdout.write(line + end)
    sys.stdout.flush()
