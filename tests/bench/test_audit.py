"""The audit of what is locked: an audit that could not ask is no pass; what is locked is what is needed."""

import json
from pathlib import Path
from typing import Any

import pytest
from cyclonedx.model.bom import Bom

from bench.audit import (
    KNOWN,
    NONE_KNOWN,
    NOT_ASKED,
    Package,
    Vulnerability,
    bill_of_materials,
    closure,
    judge,
    locked,
    scopes,
    wanted,
)
from common.errors import PhalanxError

TWO = {"good": "1.0", "bad": "2.0"}
WHO = {"good": "slave", "bad": "tests"}
_BAD = Vulnerability("PYSEC-1", ["2.1"], ["CVE-1"], "an overflow")


@pytest.mark.parametrize(
    ("answered", "code", "word"),
    [
        ([Package("good", "1.0"), Package("bad", "2.0")], NONE_KNOWN, "none known in 2"),
        ([Package("good", "1.0"), Package("bad", "2.0", vulns=[_BAD])], KNOWN, "mended by 2.1"),
        ([Package("bad", "2.0", vulns=[_BAD])], KNOWN, "CVE-1"),
        ([], NOT_ASKED, "2 of 2"),
        ([Package("good", "1.0"), Package("bad", skip_reason="Dependency not found")], NOT_ASKED, "bad"),
        ([Package("good", "1.0"), Package("bad", "1.9")], NOT_ASKED, "bad"),  # of another version
    ],
)
def test_only_answers_about_all_are_a_pass(answered: list[Package], code: int, word: str) -> None:
    verdict = judge(TWO, answered, WHO)
    assert verdict.code == code
    assert word in "\n".join(verdict.lines)


def test_every_line_is_exact_and_needed_and_nothing_that_is_needed_is_free(root: Path) -> None:
    versions = locked(root / "constraints.txt")
    needed = closure(one for every in wanted(root / "pyproject.toml").values() for one in every)
    assert set(versions) <= needed, "locked, but nobody needs it"
    assert needed - set(versions) <= {"pip"}, "needed, but not locked"  # pip is the environment's own
    who = scopes(root / "pyproject.toml", versions)
    assert {name for name, one in who.items() if one == "slave"} >= {"numpy", "cryptography", "eclipse-zenoh"}
    assert who["nicegui"] == "master"
    assert who["pytest"] == "tests"


@pytest.mark.parametrize(
    "line", ["numpy>=2", "numpy", "numpy==2.*", "git+https://x/y", "-r other.txt", "a==1\nA==2"]
)
def test_a_line_that_is_not_one_version_is_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "constraints.txt"
    path.write_text(f"# text\n{line}\n")
    with pytest.raises(PhalanxError, match=r"constraints.txt:\d"):
        locked(path)


def test_the_bill_of_materials_names_each_with_its_version_and_use(root: Path) -> None:
    versions = locked(root / "constraints.txt")
    bill = json.loads(bill_of_materials(versions, scopes(root / "pyproject.toml", versions)))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert {one["name"]: one["version"] for one in bill["components"]} == versions
    (numpy,) = (one for one in bill["components"] if one["name"] == "numpy")
    assert numpy["purl"] == f"pkg:pypi/numpy@{versions['numpy']}"
    read: Any = Bom.from_json(bill)  # type: ignore[attr-defined]  # as a program of others reads it
    assert {(one.name, one.version) for one in read.components} == set(versions.items())
    assert numpy["properties"] == [{"name": "phalanx:for", "value": "slave"}]
