"""What is locked is what is needed: each line of constraints.txt one version, nothing that is needed left free, and
each has wheels for every Python and machine that is supported."""

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

_EXACT = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]*)==([0-9][A-Za-z0-9.+!_-]*)")
_SYSTEMS = {
    "x86_64": {"sys_platform": "linux", "platform_system": "Linux", "os_name": "posix"},
    "aarch64": {"sys_platform": "linux", "platform_system": "Linux", "os_name": "posix"},
    "arm64": {"sys_platform": "darwin", "platform_system": "Darwin", "os_name": "posix"},
    "AMD64": {"sys_platform": "win32", "platform_system": "Windows", "os_name": "nt"},
}
_PLATFORMS = {
    **{
        machine: [
            f"{old}_{machine}" for old in ("manylinux_2_28", "manylinux_2_17", "manylinux2014", "manylinux1")
        ]
        for machine in ("x86_64", "aarch64")
    },
    "arm64": ["macosx_14_0_arm64", "macosx_14_0_universal2"],
    "AMD64": ["win_amd64"],
}
Machine = dict[str, str]


def machine_of(python: str, machine: str) -> Machine:
    """What markers ask about a machine."""
    about = {"python_version": python, "python_full_version": f"{python}.0", "platform_machine": machine}
    return about | _SYSTEMS[machine]


_MACHINES = [machine_of(f"3.{minor}", kind) for minor in range(11, 15) for kind in ("x86_64", "aarch64")]


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


def closure(of: Iterable[Requirement], machines: Iterable[Machine] = _MACHINES) -> set[str]:
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
            if needed(one, new, machines):
                left.append((canonicalize_name(one.name), frozenset(one.extras)))
    return set(found)


def needed(one: Requirement, extras: Iterable[str], machines: Iterable[Machine]) -> bool:
    """Whether a requirement belongs to one of the extras, on any of the machines."""
    marker = one.marker
    if marker is None:
        return "" in extras
    return any(marker.evaluate({**machine, "extra": extra}) for machine in machines for extra in extras)


def requirements(root: Path, *extras: str) -> list[Requirement]:
    """What the project asks for, with these extras."""
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"]
    texts = [*project["dependencies"], *(text for extra in extras for text in optional[extra])]
    return [Requirement(text) for text in texts]


ALL = ("master", "fast", "wrist", "vive", "lsl", "ximu3", "dev")


def test_every_line_is_exact_and_needed_and_nothing_that_is_needed_is_free(root: Path) -> None:
    wanted, names = closure(requirements(root, *ALL)), locked((root / "constraints.txt").read_text())
    assert wanted - names <= {"pip"}, "needed, but not locked"  # pip is the environment's own
    if sys.version_info < (3, 14):  # there bvhio is missing, and with it the list of what it needs
        assert names <= wanted, "locked, but nobody needs it"


def test_the_extras_are_all_of_them(root: Path) -> None:
    assert set(ALL) == set(
        tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    )


@pytest.mark.parametrize(
    ("python", "machine", "extras"),
    [
        ("3.11", "aarch64", ()),  # Raspberry Pi OS Bookworm
        ("3.13", "aarch64", ()),  # Trixie
        ("3.14", "aarch64", ALL),
        ("3.14", "x86_64", ALL),
        ("3.14", "arm64", ("master", "lsl", "ximu3")),  # macOS
        ("3.14", "AMD64", ("master", "lsl", "ximu3", "vive")),  # Windows
    ],
)
def test_all_that_is_needed_has_wheels(
    root: Path, tmp_path: Path, python: str, machine: str, extras: tuple[str, ...]
) -> None:
    about = machine_of(python, machine)
    asked = [
        one
        for one in requirements(root, *extras)
        if needed(one, [""], [about])
        and not (machine == "aarch64" and one.name == "openvr")  # SteamVR: x86 only
    ]
    names = closure(asked, [about])
    lines = [line for line in (root / "constraints.txt").read_text().splitlines() if _EXACT.fullmatch(line)]
    exact: dict[str, str] = {canonicalize_name(line.partition("==")[0]): line for line in lines}
    assert {canonicalize_name(one.name) for one in asked} <= names & exact.keys()
    found = wheels(python, machine, [exact.get(name, name) for name in sorted(names - {"pip"})], tmp_path)
    assert len(found) == len(names - {"pip"})


def wheels(python: str, machine: str, lines: list[str], folder: Path) -> list[str]:
    """The wheels that pip would install there; nothing is built, and nothing is looked up but these lines."""
    place = [f"--target={folder / 'nothing'}", f"--report={folder / 'report.json'}", "--dry-run", "--no-deps"]
    command = [
        sys.executable,
        "-m",
        "pip",
        "--disable-pip-version-check",
        "install",
        *place,
        "--quiet",
        "--no-input",
    ]
    command += [
        "--ignore-installed",
        "--retries=1",
        "--timeout=5",
        "--only-binary=:all:",
        "--implementation=cp",
    ]
    command += [f"--python-version={python}", *(f"--platform={one}" for one in _PLATFORMS[machine])]
    command += [f"--abi={one}" for one in (f"cp{python.replace('.', '')}", "abi3", "none")]
    done = subprocess.run([*command, *lines], capture_output=True, text=True, timeout=300, check=False)
    if "No module named pip" in done.stderr:
        pytest.skip("no pip in this environment: python -m ensurepip")
    if re.search(r"connection|name resolution|unreachable|ProxyError", done.stderr, re.IGNORECASE):
        pytest.skip("no package registry can be reached")
    if done.returncode != 0:
        raise LookupError(done.stderr)
    installs = json.loads((folder / "report.json").read_text())["install"]
    return [one["download_info"]["url"].rsplit("/", 1)[1] for one in installs]


def test_a_package_without_a_wheel_is_met(tmp_path: Path) -> None:
    with pytest.raises(LookupError, match="vqf"):  # 2.1.2 has none for 3.14
        wheels("3.14", "x86_64", ["vqf==2.1.2"], tmp_path)


@pytest.mark.parametrize(
    "line", ["numpy>=2", "numpy", "numpy==2.*", "git+https://x/y", "-r other.txt", "a==1\nA==2"]
)
def test_a_line_that_is_not_one_version_is_refused(line: str) -> None:
    with pytest.raises(AssertionError, match=r"NAME==VERSION|twice"):
        locked(f"# text\n{line}\n")
