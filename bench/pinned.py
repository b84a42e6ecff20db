"""What constraints.txt locks, and what of it a slave, a master and the tests need, as the installed packages say."""

import re
import tomllib
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from common.errors import PhalanxError

_EXACT = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]*)==([0-9][A-Za-z0-9.+!_-]*)")
_MACHINES = tuple(
    {
        "python_version": version,
        "python_full_version": f"{version}.0",
        "platform_machine": machine,
        "sys_platform": "linux",
        "platform_system": "Linux",
        "os_name": "posix",
    }
    for version in ("3.11", "3.12", "3.13")
    for machine in ("x86_64", "aarch64")
)


def locked(path: Path) -> dict[str, str]:
    """Name -> version of every line.

    Raises:
        PhalanxError: A line does not name exactly one version, or a package twice.
    """
    versions: dict[str, str] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        match = _EXACT.fullmatch(text)
        if match is None:
            raise PhalanxError(f"{path}:{number}: {text!r}: expected NAME==VERSION")
        name = canonicalize_name(match[1])
        if name in versions:
            raise PhalanxError(f"{path}:{number}: {name} is locked twice")
        versions[name] = match[2]
    return versions


def wanted(pyproject: Path) -> dict[str, list[Requirement]]:
    """Requirements of the project: of the slave under "", and of each extra."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    extras = {"": project["dependencies"], **project["optional-dependencies"]}
    return {extra: [Requirement(text) for text in texts] for extra, texts in extras.items()}


def closure(of: Iterable[Requirement]) -> set[str]:
    """Names of all that these need in turn; of what is not installed here only its name."""
    found: dict[str, set[str]] = {}
    left = [(canonicalize_name(one.name), frozenset(one.extras)) for one in of]
    while left:
        name, extras = left.pop()
        done = found.setdefault(name, set())
        new = ({""} | extras) - done
        if not new:
            continue
        done |= new
        try:
            texts = requires(name) or []
        except PackageNotFoundError:
            continue
        for one in map(Requirement, texts):
            if _needed(one, new):
                left.append((canonicalize_name(one.name), frozenset(one.extras)))
    return set(found)


def _needed(one: Requirement, extras: Iterable[str]) -> bool:
    """Whether a requirement belongs to one of the extras, on any machine that the locked versions are for."""
    marker = one.marker
    if marker is None:
        return "" in extras
    return any(marker.evaluate({**machine, "extra": extra}) for machine in _MACHINES for extra in extras)


def scopes(pyproject: Path, names: Mapping[str, str]) -> dict[str, str]:
    """Name -> who needs it: `slave`, `master`, `extra` (one that a user chooses), or `tests`."""
    groups = wanted(pyproject)
    slave, master = closure(groups[""]), closure(groups["master"])
    chosen = closure(
        one for extra, every in groups.items() if extra not in ("", "master", "dev") for one in every
    )
    ranks = (("slave", slave), ("master", master), ("extra", chosen))
    return {name: next((rank for rank, held in ranks if name in held), "tests") for name in names}
