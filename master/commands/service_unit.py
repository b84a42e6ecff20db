"""The unit that runs the master as a service of the user who installs it.

Its text, and why each line of it is there. Pure.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from common.errors import PhalanxError

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
    """Return the unit.

    Args:
        command: Program and its words; paths are absolute.
        folder: Where it runs.
        environment: Variables that it needs; never a key itself, for every program of the user can read a unit.

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
