"""The first deployment to two clean hosts, with what has to be looked at before and after it."""

import shutil
import time
from dataclasses import dataclass

from tests.hosts.rig import Ran, Rig

FIRST_S = 60.0  # from clean hosts to the first datagrams of both, by one command


@dataclass(frozen=True)
class Deployment:
    """What the first deployment found and did.

    Attributes:
        clean: Files of each host before anything of ours was there.
        dry: `--dry-run`, and the paths of each host that changed by it.
        ran: The deployment itself.
        first_s: From its beginning to the first datagram of each host [s].
    """

    clean: dict[str, dict[str, str]]
    dry: Ran
    dry_changed: dict[str, list[str]]
    ran: Ran
    first_s: dict[str, float]


def first_deployment(rig: Rig) -> Deployment:
    """Deploy to both clean hosts by one command, after a dry run."""
    hosts = rig.fleet.hosts
    clean = {name: host.files() for name, host in hosts.items()}
    dry = rig.deploy("--dry-run")
    shutil.rmtree(
        rig.cache, ignore_errors=True
    )  # what it loaded of wheels: the next one begins with nothing, too
    dry_changed = {name: differences(clean[name], host.files()) for name, host in hosts.items()}
    ran = rig.deploy()
    return Deployment(clean, dry, dry_changed, ran, first_data(rig, ran.began))


def first_data(rig: Rig, since: float) -> dict[str, float]:
    """Time from `since` to the first datagram of each host [s]; of one that sends none infinity."""
    found = {name: rig.fleet.tap.wait(host.address, since, FIRST_S) for name, host in rig.fleet.hosts.items()}
    return {name: float("inf") if first is None else first - since for name, first in found.items()}


def differences(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Paths that are not as they were, each with what it was and is."""
    return [
        f"{path}: {before.get(path, 'not there')} -> {after.get(path, 'not there')}"
        for path in sorted(before.keys() | after.keys())
        if before.get(path) != after.get(path)
    ]


def streams(rig: Rig, *names: str, within_s: float = 10.0) -> None:
    """Fail unless the hosts `names`, by default both, send from now on."""
    begin = time.monotonic()
    for name in names or rig.fleet.hosts:
        host = rig.fleet.hosts[name]
        if rig.fleet.tap.wait(host.address, begin, within_s) is None:
            raise AssertionError(f"{name} sends nothing for {within_s:g} s:\n{host.journal()}")
