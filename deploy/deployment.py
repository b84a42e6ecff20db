"""All machines of a rig at once: each is deployed to by itself, then their first datagrams are waited for."""

import json
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from deploy.one_host import Host, Wish
from deploy.remote import Deadline, Remote, run_bounded
from deploy.targets import DeployError, Target

HEAR_S = (
    12.0  # from READY=1 to the first datagram is a second; each one of waiting is a second without pictures
)
_KEYS_S = 60.0
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Reached:
    """How machines are reached.

    Attributes:
        options: Of ssh.
        deadline_s: By when all of one machine is done.
    """

    options: tuple[str, ...]
    deadline_s: float


@dataclass(frozen=True, slots=True)
class Ears:
    """How the first datagrams are heard.

    Attributes:
        options: Of `phalanx-master hear`.
        keys: Keys folder.
        seconds: How long they are waited for.
    """

    options: tuple[str, ...]
    keys: Path
    seconds: float = HEAR_S


def make_keys(folder: Path, names: Sequence[str], say: Say) -> None:
    """Make what a keys folder lacks for these senders, by `phalanx-master keys make`.

    Raises:
        DeployError: They cannot be made.
    """
    wanted = [folder / "rig.key", folder / "ca.pem", *(folder / f"devices/{name}.pem" for name in names)]
    if all(path.is_file() for path in wanted):
        return
    say(f"making keys in {folder}")
    devices = [word for name in names for word in ("--device", name)]
    words = [sys.executable, "-m", "master.keys_command", "make", str(folder), *devices]
    lines: list[str] = []
    code, errors = run_bounded(words, b"", lines.append, _KEYS_S)
    if code != 0:
        raise DeployError(f"keys: {([*lines, *errors] or ['phalanx-master keys make has no end'])[-1]}")


def deploy(
    targets: Sequence[Target], wish: Wish, reached: Reached, ears: Ears | None, say: Say
) -> dict[str, str | None]:
    """Deploy to all of them at once; host -> None, or one line why it failed there.

    Args:
        targets: The machines.
        wish: What is wanted on them.
        reached: How they are reached.
        ears: How their first datagrams are heard; None: nobody listens.
        say: Told one line a step, each with its host.
    """
    hosts = [_host(target, reached, say) for target in targets]
    failed = _each(hosts, lambda host: host.deploy(wish))
    if ears is None or wish.dry_run:
        return failed
    there = [host for host in hosts if failed[host.target.host] is None and not host.reboot]
    if there:
        failed |= _hear(there, ears)
    return failed


def uninstall(targets: Sequence[Target], reached: Reached, dry_run: bool, say: Say) -> dict[str, str | None]:
    """Take everything of ours away from all of them; host -> None, or one line why it failed there."""
    return _each([_host(target, reached, say) for target in targets], lambda host: host.uninstall(dry_run))


def _host(target: Target, reached: Reached, say: Say) -> Host:
    remote = Remote(target.host, reached.options, Deadline(reached.deadline_s))
    return Host(target, remote, lambda line: say(f"{target.host}: {line}"))


def _each(hosts: Sequence[Host], act: Callable[[Host], None]) -> dict[str, str | None]:
    def one(host: Host) -> str | None:
        try:
            act(host)
        except DeployError as error:
            if len(hosts) > 1:  # the others go on, which takes a while
                host.say(f"failed: {error}")
            return str(error)
        return None

    with ThreadPoolExecutor(len(hosts)) as workers:
        waiting = workers.map(one, hosts)
        try:
            results = list(waiting)
        except KeyboardInterrupt:  # each ends its ssh; what runs on a machine goes on to its end there
            for host in hosts:
                host.remote.deadline.end()
            raise
    return {host.target.host: result for host, result in zip(hosts, results, strict=True)}


def _hear(hosts: Sequence[Host], ears: Ears) -> dict[str, str | None]:
    """Wait until each sender was heard; a machine that is silent goes back to what it was."""
    names = [name for host in hosts for name in host.target.names]
    for host in hosts:
        host.say("waiting for its first datagram")
    heard, cause = heard_of(names, ears)
    failed: dict[str, str | None] = {}
    silent = {host.target.host: [n for n in host.target.names if n not in heard] for host in hosts}

    def answer(host: Host) -> None:
        if not (missing := silent[host.target.host]):
            host.say(f"streams: {', '.join(f'{n} {heard[n]:.0f}/s' for n in host.target.names)}")
            return
        why = cause or f"no datagram of {', '.join(missing)} in {ears.seconds:.0f} s at the master"
        if cause is not None or not host.changed:
            raise DeployError(why)
        try:
            back = host.roll_back()
        except DeployError as error:
            raise DeployError(f"{why}; going back failed, too: {error}") from error
        raise DeployError(f"{why}; {back}")

    failed |= _each(hosts, answer)
    return failed


def heard_of(names: Sequence[str], ears: Ears) -> tuple[dict[str, float], str | None]:
    """Ask `phalanx-master hear` which of the senders are heard.

    Returns:
        Name -> datagrams a second, of those that were heard; and why nobody could listen, if that is so.
    """
    words = [sys.executable, "-m", "master.hear", "--json", "--seconds", str(ears.seconds), *ears.options]
    words += [word for name in names for word in ("--name", name)]
    lines: list[str] = []
    code, errors = run_bounded(
        words, b"", lines.append, ears.seconds + 60.0, {"PHALANX_KEYS": str(ears.keys)}
    )
    results = [line for line in lines if line.startswith('{"heard"')]
    if not results:
        said = [*lines, *errors] or [f"phalanx-master hear ended with {code}"]
        return {}, f"cannot listen for it: {said[-1]}"
    return {
        name: float(rate) for name, rate in cast(dict[str, float], json.loads(results[-1])["heard"]).items()
    }, None


class Lines:
    """Lines of several threads, one after the other. Holds the lock."""

    def __init__(self, write: Say) -> None:
        """To `write`."""
        self._write, self._lock = write, threading.Lock()

    def __call__(self, line: str) -> None:
        """Write one."""
        with self._lock:
            self._write(line)


def reach_of(
    user: str | None, port: int | None, identity: Path | None, more: Sequence[str]
) -> tuple[str, ...]:
    """Options of ssh."""
    words: list[str] = []
    words += ["-l", user] if user else []
    words += ["-p", str(port)] if port else []
    words += ["-i", str(identity)] if identity else []
    return (*words, *(word for option in more for word in ("-o", option)))
