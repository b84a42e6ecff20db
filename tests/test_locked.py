"""What is locked is what is needed: each line of constraints.txt one version, and nothing that is needed left free."""

import re
import tomllib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

_EXACT = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]*)==([0-9][A-Za-z0-9.+!_-]*)")
_MACHINES = tuple(
    {"python_version": version, "python_full_version": f"{version}.0", "platform_machine": machine}
    | {"sys_platform": "linux", "platform_system": "Linux", "os_name": "posix"}
    for version in ("3.11", "3.12", "3.13")
    for machine in ("x86_64", "aarch64")
)


def locked(text: str) -> set[str]:
    """The packages of all lines; AssertionError: not exactly one version, or a package twice."""
    names: list[str] = []
    for line in text.splitlines():
        if words := line.partition("#")[0].strip():
            match = _EXACT.fullmatch(words)
            assert match, f"{words!r}: expected NAME==VERSION"
            names.append(canonicalize_name(match[1]))
    assert len(set(names)) == len(names), "a package is locked twice"
    return set(names)


def closure(of: Iterable[Requirement]) -> set[str]:
    """Names of all that these need in turn; of what is not installed here only its name."""
    found: dict[str, set[str]] = {}
    left = [(canonicalize_name(one.name), frozenset(one.extras)) for one in of]
    while left:
        name, extras = left.pop()
        new = ({""} | extras) - found.setdefault(name, set())
        found[name] |= new
        try:
            texts = requires(name) or [] if new else []
        except PackageNotFoundError:
            continue
        for one in map(Requirement, texts):
            if needed(one, new):
                left.append((canonicalize_name(one.name), frozenset(one.extras)))
    return set(found)


def needed(one: Requirement, extras: Iterable[str]) -> bool:
    """Whether a requirement belongs to one of the extras, on any machine that the locked versions are for."""
    marker = one.marker
    if marker is None:
        return "" in extras
    return any(marker.evaluate({**machine, "extra": extra}) for machine in _MACHINES for extra in extras)


def test_every_line_is_exact_and_needed_and_nothing_that_is_needed_is_free(root: Path) -> None:
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    texts = [
        *project["dependencies"],
        *(t for extra in project["optional-dependencies"].values() for t in extra),
    ]
    wanted, names = closure(map(Requirement, texts)), locked((root / "constraints.txt").read_text())
    assert names <= wanted, "locked, but nobody needs it"
    assert wanted - names <= {"pip"}, "needed, but not locked"  # pip is the environment's own


@pytest.mark.parametrize(
    "line", ["numpy>=2", "numpy", "numpy==2.*", "git+https://x/y", "-r other.txt", "a==1\nA==2"]
)
def test_a_line_that_is_not_one_version_is_refused(line: str) -> None:
    with pytest.raises(AssertionError, match=r"NAME==VERSION|twice"):
        locked(f"# text\n{line}\n")
