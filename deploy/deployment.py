"""Deployment to all machines of a rig at once.

Each is deployed to by itself, then their first datagrams are waited for.
"""

import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from deploy.one_host import Host, Wish
from deploy.remote import Deadline, Remote, printable, run_bounded
from deploy.sender_check import Before, Ears, Received, received_of
from deploy.targets import DeployError, Target

Notify = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Reached:
    """How machines are reached.

    Attributes:
        options: Of ssh.
        deadline_s: By when all of one machine is done.
    """

    options: tuple[str, ...]
    deadline_s: float


def make_keys(folder: Path, names: Sequence[str], notify: Notify) -> None:
    """Make the missing keys of a keys folder for these senders.

    By `phalanx fleet keys --make`.

    Raises:
        DeployError: They cannot be made.
    """
    wanted = [folder / one for one in ("rig.key", "devices.key", "ca.pem")]
    wanted += [folder / f"devices/{name}.{kind}" for name in names for kind in ("pem", "secret")]
    if all(path.is_file() for path in wanted):
        return
    notify(f"making keys in {folder}")
    devices = [word for name in names for word in ("--device", name)]
    words = [sys.executable, "-m", "master", "fleet", "keys", str(folder), "--make", *devices]
    lines: list[str] = []
    keys_s = 60.0
    code, errors = run_bounded(words, b"", lines.append, keys_s)
    if code != 0:
        raise DeployError(f"keys: {([*lines, *errors] or ['phalanx fleet keys --make has no end'])[-1]}")


def deploy(
    targets: Sequence[Target], wish: Wish, reached: Reached, ears: Ears | None, notify: Notify
) -> dict[str, str | None]:
    """Deploy to all of them at once; host -> None, or one line why it failed there.

    Args:
        targets: The machines.
        wish: What is wanted on them.
        reached: How they are reached.
        ears: How their first datagrams are received; None: nobody listens.
        notify: Called with one line a step, each with its host.
    """
    hosts = _hosts(targets, reached, notify)
    if ears is None or wish.dry_run:
        return _each(hosts, lambda host: host.deploy(wish))
    before = Before([name for target in targets for name in target.names], ears)

    def one(host: Host) -> None:
        host.deploy(wish)
        if not host.reboot and before.at_master:  # at once: others may take longer, and it may be silent
            _wait_received(host, before.ears(host.start_s))

    try:
        failed = _each(hosts, one)
    finally:
        before.end()
    there = [host for host in hosts if failed[host.target.host] is None and not host.reboot]
    if there and not before.at_master:  # then all are listened for together: one port, one start
        failed |= _wait_for_senders(there, ears)
    return failed


def uninstall(
    targets: Sequence[Target], reached: Reached, dry_run: bool, notify: Notify
) -> dict[str, str | None]:
    """Remove everything of this project from all machines.

    Returns host -> None, or one line why it failed there.
    """
    return _each(_hosts(targets, reached, notify), lambda host: host.uninstall(dry_run))


def roll_back(
    targets: Sequence[Target], reached: Reached, dry_run: bool, notify: Notify
) -> dict[str, str | None]:
    """Roll all machines back to what was before.

    Returns host -> None, or one line why it failed there.
    """

    def one(host: Host) -> None:
        host.look()
        host.notify(host.roll_back(dry_run))

    return _each(_hosts(targets, reached, notify), one)


def _hosts(targets: Sequence[Target], reached: Reached, notify: Notify) -> list[Host]:
    known: dict[str, str] = {}

    def host(target: Target) -> Host:
        remote = Remote(target.host, reached.options, Deadline(reached.deadline_s))
        return Host(target, remote, lambda line: notify(f"{target.host}: {line}"), known=known)

    return [host(target) for target in targets]


def _each(hosts: Sequence[Host], act: Callable[[Host], None]) -> dict[str, str | None]:
    def one(host: Host) -> str | None:
        try:
            act(host)
        except DeployError as error:
            if len(hosts) > 1:  # the others go on, which takes a while
                host.notify(f"failed: {error}")
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


def _wait_for_senders(hosts: Sequence[Host], ears: Ears) -> dict[str, str | None]:
    """Wait until each sender was received, and roll back machines that are silent."""
    for host in hosts:
        host.notify("waiting for its first datagram")
    received = received_of([name for host in hosts for name in host.target.names], ears)
    return _each(hosts, lambda host: _judge(host, received, ears))


def _wait_received(host: Host, ears: Ears) -> None:
    """The same for one machine.

    Raises:
        DeployError: It is silent, and went back.
    """
    host.notify("waiting for its first datagram")
    _judge(host, received_of(host.target.names, ears, host.remote.deadline.ended), ears)


def _judge(host: Host, received: Received, ears: Ears) -> None:
    """Roll back a machine if one of its senders is not received.

    Raises:
        DeployError: It is so.
    """
    missing = [name for name in host.target.names if name not in received.rates]
    if not missing:
        host.notify(f"streams: {', '.join(f'{n} {received.rates[n]:.0f}/s' for n in host.target.names)}")
        return
    why = received.cause or f"no datagram of {', '.join(missing)} in {ears.seconds:.0f} s at the master"
    if received.cause is not None or not host.changed:
        raise DeployError(why)
    try:
        back = host.roll_back()
    except DeployError as error:
        raise DeployError(f"{why}; going back failed, too: {error}") from error
    raise DeployError(f"{why}; {back}")


class Lines:
    """Lines of several threads, one after the other. Holds the lock."""

    def __init__(self, write: Notify) -> None:
        """To `write`."""
        self._write, self._lock = write, threading.Lock()

    def __call__(self, line: str) -> None:
        """Write one."""
        with self._lock:
            self._write(printable(line))


def reach_of(
    user: str | None, port: int | None, identity: Path | None, more: Sequence[str]
) -> tuple[str, ...]:
    """Options of ssh."""
    words: list[str] = []
    words += ["-l", user] if user else []
    words += ["-p", str(port)] if port else []
    words += ["-i", str(identity)] if identity else []
    return (*words, *(word for option in more for word in ("-o", option)))
