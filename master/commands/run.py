"""`phalanx run` tracks live until Ctrl-C, or installs that as a service.

The service is a systemd unit of the user who installs it, which needs no root and starts again by itself.
"""

import getpass
import os
import re
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import cast

from common.bus.endpoints import check, encrypted, port_of
from common.bus.keys import ENVIRONMENT, FOLDER, MASTER, OPEN, access_of, keys_folder, link_key
from common.command_line import UsageError, defaults_of, echo
from common.errors import BusError, PhalanxError
from common.link.datagram import Address
from master.cli.run import run as declare_run
from master.commands.options import address, rigs_of
from master.commands.summary import print_line
from master.estimator.settings import Settings
from master.rig.setup import RigFiles, load_setups
from master.run.live import LiveSettings, run_live
from master.run.process import stop_on_signals

UNIT = "phalanx-master.service"
_UNQUOTED = re.compile(r"[A-Za-z0-9_@+=:,./-]+")
ERROR_WAIT_S = 5  # between two tries after an error that the user has to mend
_TEXT = """\
# Written by `phalanx run --install`, which writes it again; `phalanx run --uninstall` removes it.
[Unit]
Description=Phalanx master
# It is tried again without an end: a network, a file or a port may be there in a minute.
StartLimitIntervalSec=0

[Service]
Type=notify
WorkingDirectory={folder}
{environment}
# A hang leaves Python's stacks of all threads in the journal.
Environment=PYTHONFAULTHANDLER=1 PYTHONUNBUFFERED=1
ExecStart={command}
# After a fault (a signal, the watchdog, exit code 70) it starts at once. After an error that its user has to mend, and
# that the journal names (exit code 1, a program that is not there), the next try waits: nothing loops hot.
ExecStopPost=/bin/sh -c 'case "$$EXIT_CODE$$EXIT_STATUS" in exited0|exited70) ;; exited*) exec sleep {wait_s} ;; esac'
# A process that was asked to stop stays stopped.
Restart=on-failure
RestartSec=100ms
# The loop itself feeds the watchdog.
WatchdogSec=10
TimeoutStartSec=180
TimeoutStopSec=10
TimeoutAbortSec=2

# 130 MB at its start, 159 MB after an hour with three cameras (docs/soak.md); 14 threads, and one for each processor
# that numpy uses. What asks for more is ended and started again, before the machine is out of memory or of processes;
# without the second line it would be swapped instead, and go on slowly.
MemoryMax=1G
MemorySwapMax=0
TasksMax=256
LimitCORE=0

# What a service of a user can give up without a sandbox of its own, which some systems forbid to users.
NoNewPrivileges=yes
LockPersonality=yes
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
# AF_NETLINK: the list of the network's interfaces.
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM

[Install]
WantedBy=default.target
"""


def unit_text(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> str:
    """Return the unit that runs `command`, of absolute paths, in `folder`.

    `environment` never has a key itself, for every program of the user can read a unit.

    Raises:
        PhalanxError: A word that no unit can carry.
    """
    program, *words = command
    return _TEXT.format(
        folder=_plain(str(folder)),
        environment="\n".join(
            f"Environment={_quoted(f'{key}={value}')}" for key, value in environment.items()
        ),
        command=" ".join([_quoted(program), *(_quoted(word).replace("$", "$$") for word in words)]),
        wait_s=ERROR_WAIT_S,
    )


def _plain(text: str) -> str:
    """Text that systemd takes as it stands, but for its specifiers."""
    if not text.isprintable():
        raise PhalanxError(f"{text!r}: cannot be in a unit of systemd; use a path of printable characters")
    return text.replace("%", "%%")


def _quoted(word: str) -> str:
    """A word as systemd.syntax(7) quotes it, where it has to."""
    if _UNQUOTED.fullmatch(word):
        return word
    return '"' + _plain(word).replace("\\", "\\\\").replace('"', '\\"') + '"'


_LOG = f"journalctl --user -u {UNIT} -n 20"


def systemctl(words: Sequence[str]) -> str:
    """Run a command of this user's service manager and return its output.

    Raises:
        PhalanxError: There is none, it failed, or takes too long.
    """
    command = ["systemctl", "--user", *words]
    command_s = 90.0  # more than the unit gives to a start
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=command_s, check=False
        )
    except FileNotFoundError as error:
        raise PhalanxError("systemctl: missing; a service needs systemd") from error
    except subprocess.TimeoutExpired as error:
        raise PhalanxError(f"{' '.join(command[:3])}: no end after {command_s:.0f} s") from error
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or f"exit {done.returncode}").splitlines()[-1]
        advice = ""
        if "connect to bus" in last:
            advice = (
                "; log in as this user itself, at the machine or by ssh: su and sudo have no service manager"
            )
        raise PhalanxError(f"{' '.join(command[:3])}: {last}{advice}")
    return done.stdout


class UserServices:
    """Services of this process's user; `run` calls systemctl, which tests replace."""

    def __init__(self, run: Callable[[Sequence[str]], str] = systemctl) -> None:
        self._run = run

    @property
    def file(self) -> Path:
        """Where the unit is."""
        config = os.environ.get("XDG_CONFIG_HOME")
        return (Path(config) if config else Path.home() / ".config") / "systemd/user" / UNIT

    def install(self, text: str) -> str:
        """Write the unit and start it, now and at each login; return what was done.

        Raises:
            PhalanxError: It does not run; with its last words. It goes on being tried.
        """
        if self._state().get("ActiveState") == "active" and self._text() == text:
            return f"unchanged: {UNIT} runs"
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self.file.write_text(text)
        except OSError as error:
            raise PhalanxError(f"{self.file}: cannot write it ({error.strerror})") from error
        self._run(["daemon-reload"])
        self._run(["enable", "--quiet", UNIT])
        try:
            self._run(["restart", UNIT])  # until it is ready
        except PhalanxError as error:
            words = self._state().get("StatusText") or str(error)
            raise PhalanxError(
                f"{UNIT} does not run: {words}; {_LOG} has more. It is tried again, every {ERROR_WAIT_S} s; "
                "phalanx run --uninstall removes it"
            ) from error
        return f"{UNIT} runs; `systemctl --user status {UNIT}` shows how it is, `{_LOG}` its log"

    def remove(self, dry_run: bool) -> str:
        """Stop the service, remove its unit and return one line that reports it.

        Raises:
            PhalanxError: It does not stop.
        """
        if not self.file.exists():
            return f"no {self.file}: nothing to remove"
        if dry_run:
            return f"would stop {UNIT} and remove {self.file}"
        self._run(["disable", "--now", "--quiet", UNIT])
        self.file.unlink()
        self._run(["daemon-reload"])
        return f"stopped {UNIT} and removed {self.file}"

    def _state(self) -> dict[str, str]:
        text = self._run(["show", "-p", "ActiveState,StatusText", UNIT])
        return dict(line.split("=", 1) for line in text.splitlines() if "=" in line)

    def _text(self) -> str | None:
        try:
            return self.file.read_text()
        except FileNotFoundError:
            return None


PROGRAM = "phalanx-master"
# The options of `run` that a service keeps: where they are in what was read, and how they are written.
KEPT = {
    "rig": "--rig",
    "calibration": "--calibration",
    "hand": "--hand",
    "beacon": "--beacon",
    "bind": "--bind",
    "key_file": "--key-file",
    "bus": "--bus",
    "start_timeout_s": "--start-timeout-s",
    "changes": "--set",
}
ONE_RUN = ("poses", "summary", "record")  # files of one run: the next start would write over them


def change_service(options: Namespace) -> None:
    """Install the service with these options of `run`, or remove it.

    Raises:
        PhalanxError: An option that a service cannot have, a rig or a key that is not there.
    """
    services = UserServices()
    if options.uninstall:
        if given := sorted(KEPT[name] for name in _given(options)):
            raise PhalanxError(f"--uninstall: takes no other option, found {' '.join(given)}")
        echo(services.remove(options.dry_run))
        return
    text = unit_text(command_of(options), Path.cwd(), environment_of())
    if options.dry_run:
        echo(f"would write {services.file}:\n{text}", end="")
        return
    echo(services.install(text))
    if not Path("/var/lib/systemd/linger", user := getpass.getuser()).exists():
        echo(f"it starts when {user} logs in; to start it with the machine: loginctl enable-linger {user}")


def command_of(options: Namespace) -> list[str]:
    """The program and its words for these options of `run`; each path is absolute.

    Raises:
        PhalanxError: An option that a service cannot have, a rig or a key that is not there.
    """
    if one := next((name for name in ONE_RUN if getattr(options, name) is not None), None):
        raise PhalanxError(
            f"--{one}: a service that starts again would write over it; beside the service use phalanx record"
        )
    checked_ends(options)
    load_setups(options.calibration, rigs_of(options), options.hand)
    if ENVIRONMENT in os.environ and options.key_file is None:
        raise PhalanxError(
            f"{ENVIRONMENT}: a key is not written into a unit; give --keys DIR (phalanx fleet keys DIR --make)"
        )
    link_key(os.environ, options.key_file)
    words: list[str] = []
    for name in KEPT:
        if name in _given(options) or name == "calibration":
            value = getattr(options, name)
            for one in cast("list[object]", value if isinstance(value, list) else [value]):
                words += [KEPT[name], str(one.absolute() if isinstance(one, Path) else one)]
    return [str(_program()), "run", *words]


def environment_of() -> dict[str, str]:
    """The variables that the service needs: where its keys are, never a key."""
    folder = keys_folder(os.environ)
    keys = {} if folder is None else {FOLDER: str(folder.absolute())}
    return keys | ({OPEN: "1"} if os.environ.get(OPEN) == "1" else {})


def _given(options: Namespace) -> set[str]:
    typical = defaults_of(declare_run)
    return {name for name in KEPT if getattr(options, name) != getattr(typical, name)}


def _program() -> Path:
    program = Path(sys.executable).with_name(PROGRAM)
    if not program.exists():
        raise PhalanxError(f"{program}: missing; install the package there: pip install '.[master]'")
    return program


def run(options: Namespace) -> None:
    """Track live until Ctrl-C, or install or remove the service that does."""
    if options.install or options.uninstall:
        change_service(options)
        return
    if options.dry_run:
        raise UsageError("--dry-run is for --install and --uninstall")
    files = RigFiles(options.calibration, tuple(rigs_of(options)), options.hand, Settings.of(options.changes))
    setups = files.load()
    settings = LiveSettings(
        *checked_ends(options),
        options.bus,
        files,
        options.start_timeout_s,
        options.poses,
        options.summary,
        options.record,
    )
    run_live(setups, link_key(os.environ, options.key_file), settings, stop_on_signals(), print_line)


def checked_ends(options: Namespace) -> tuple[Address, Address]:
    """Where the beacon goes and where datagrams come; the bus is checked as well.

    Raises:
        PhalanxError: One of them is malformed; the bus would leave the machine as plain text, or its keys are
            missing.
    """
    addresses = address(options.beacon, "--beacon"), address(options.bind, "--bind")
    access = access_of(os.environ, MASTER)
    check(options.bus, access.open)
    if port_of(options.bus) == 0:
        raise BusError(f"--bus {options.bus!r}: expected a port at its end, for example tls/0.0.0.0:47802")
    if encrypted(options.bus):
        access.identity()
    return addresses
