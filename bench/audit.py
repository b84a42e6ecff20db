"""`make audit`: known vulnerabilities of everything that is locked, as the Python registry or osv.dev knows them.

Exit 0: all were asked about, and nothing is known. 1: something is known. 2: they could not be asked, or not about all;
that is no pass. `--sbom FILE` also writes what is locked as a bill of materials (CycloneDX 1.6), which asks nobody.
"""

import argparse
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from urllib.parse import quote
from uuid import uuid4

import msgspec
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from bench.report import ROOT
from common.errors import PhalanxError

SERVICES = ("pypi", "osv")
NONE_KNOWN, KNOWN, NOT_ASKED = 0, 1, 2
_EXACT = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]*)==([0-9][A-Za-z0-9.+!_-]*)")
_MACHINES = tuple(
    {"python_version": version, "python_full_version": f"{version}.0", "platform_machine": machine}
    | {"sys_platform": "linux", "platform_system": "Linux", "os_name": "posix"}
    for version in ("3.11", "3.12", "3.13")
    for machine in ("x86_64", "aarch64")
)


class Vulnerability(msgspec.Struct):
    """One that is known: its name, other names, the versions that mend it, and what it is."""

    id: str
    fix_versions: list[str]
    aliases: list[str] = []
    description: str = ""


class Package(msgspec.Struct):
    """What is known of one package; `skip_reason`: nobody could be asked."""

    name: str
    version: str = ""
    skip_reason: str = ""
    vulns: list[Vulnerability] = []


class _Answer(msgspec.Struct):
    dependencies: list[Package]


@dataclass(frozen=True, slots=True)
class Verdict:
    """What an audit came to: exit code, and lines for a person."""

    code: int
    lines: tuple[str, ...]


def asked(constraints: Path, service: str) -> list[Package]:
    """Ask a service about every line; PhalanxError: it does not answer."""
    command = [
        sys.executable,
        "-m",
        "pip_audit",
        "--requirement",
        str(constraints),
        "--disable-pip",
        "--no-deps",
    ]
    command += ["--progress-spinner", "off", "--format", "json", "--vulnerability-service", service]
    patience_s = 600.0
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=patience_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise PhalanxError(f"{service}: no answer within {patience_s:g} s") from error
    try:
        return msgspec.json.decode(done.stdout, type=_Answer).dependencies
    except msgspec.MsgspecError as error:
        last = (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]
        raise PhalanxError(f"{service}: {last[:300]}") from error


def judge(versions: dict[str, str], answered: Sequence[Package], who: dict[str, str]) -> Verdict:
    """Judge the answers; `versions`: locked, by name; `who`: name -> who needs it."""
    answers = {
        one.name: one for one in answered if not one.skip_reason and one.version == versions.get(one.name)
    }
    lines: list[str] = []
    for name in sorted(answers):
        for one in answers[name].vulns:
            names, fix = " ".join([one.id, *one.aliases]), ", ".join(one.fix_versions) or "no version yet"
            lines.append(f"{name} {versions[name]} (for {who.get(name, '?')}): {names}; mended by {fix}")
    missing = sorted(set(versions) - set(answers))
    if lines:
        what = f"{len(lines)} known; raise the lines of constraints.txt, then `make test`"
        return Verdict(KNOWN, (*lines, what))
    if missing:
        few = ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
        return Verdict(NOT_ASKED, (f"nothing is known of {len(missing)} of {len(versions)} packages: {few}",))
    return Verdict(NONE_KNOWN, (f"none known in {len(versions)} packages",))


def bill_of_materials(versions: dict[str, str], who: dict[str, str]) -> str:
    """CycloneDX JSON of what is locked; the property `phalanx:for` names who needs it."""
    scope = {"slave": "required", "master": "required", "extra": "optional", "tests": "excluded"}
    components = [
        {
            "type": "library",
            "bom-ref": f"{name}=={version}",
            "name": name,
            "version": version,
            "scope": scope[who[name]],
            "purl": f"pkg:pypi/{name}@{quote(version)}",
            "properties": [{"name": "phalanx:for", "value": who[name]}],
        }
        for name, version in sorted(versions.items())
    ]
    head = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid4()}",
        "version": 1,
    }
    return json.dumps({**head, "components": components}, indent=1) + "\n"


def locked(path: Path) -> dict[str, str]:
    """Name -> version of every line; PhalanxError: not exactly one version, or a package twice."""
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
    others = groups.keys() - {"", "master", "dev"}
    chosen = closure(one for extra in others for one in groups[extra])
    ranks = (("slave", slave), ("master", master), ("extra", chosen))
    return {name: next((rank for rank, held in ranks if name in held), "tests") for name in names}


def main(arguments: Sequence[str]) -> int:
    """Ask the services one after the other, until one knows of all; print, and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench audit", description=__doc__)
    parser.add_argument("--sbom", type=Path, metavar="FILE", help="also write the bill of materials")
    given, constraints = parser.parse_args(arguments), ROOT / "constraints.txt"
    versions = locked(constraints)
    who = scopes(ROOT / "pyproject.toml", versions)
    if given.sbom is not None:
        given.sbom.write_text(bill_of_materials(versions, who), encoding="utf-8")
        print(f"wrote {given.sbom}: {len(versions)} packages")
    verdict = Verdict(NOT_ASKED, ())
    for service in SERVICES:
        try:
            verdict = judge(versions, asked(constraints, service), who)
        except PhalanxError as error:
            verdict = Verdict(NOT_ASKED, (str(error),))
        for line in verdict.lines:
            print(f"audit ({service}): {line}")
        if verdict.code != NOT_ASKED:
            return verdict.code
    print(
        "audit: could not be done, which is no pass: it needs a network that reaches pypi.org or api.osv.dev"
    )
    return verdict.code
