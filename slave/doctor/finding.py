"""Findings of the doctor.

One line per check, how bad it is, and what mends it. A check that was not made is reported as such.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum

import msgspec

from common.machine import Program


class Verdict(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"
    UNSEEN = "not looked at"


@dataclass(frozen=True, slots=True)
class Finding:
    """One check.

    Attributes:
        check: What was looked at, in two or three words.
        verdict: How bad it is.
        text: What was seen; of what was not looked at, why not.
        fix: What mends it; empty where nothing needs to be mended.
    """

    check: str
    verdict: Verdict
    text: str
    fix: str = ""


def ok(check: str, text: str) -> Finding:
    """All is well."""
    return Finding(check, Verdict.OK, text)


def warn(check: str, text: str, fix: str) -> Finding:
    """It works, but not as well as it could."""
    return Finding(check, Verdict.WARN, text, fix)


def fail(check: str, text: str, fix: str) -> Finding:
    """The slave will not work like this."""
    return Finding(check, Verdict.FAIL, text, fix)


def unseen(check: str, why: str) -> Finding:
    """It was not looked at."""
    return Finding(check, Verdict.UNSEEN, why)


def exit_code(findings: Sequence[Finding]) -> int:
    """1 where something fails, else 0."""
    return int(any(one.verdict is Verdict.FAIL for one in findings))


def as_text(findings: Sequence[Finding]) -> str:
    """Format one line per check, with the fix below it.

    Checks that were not made come last, in one block.
    """
    seen = [one for one in findings if one.verdict is not Verdict.UNSEEN]
    width = max((len(one.check) for one in findings), default=0)
    lines: list[str] = []
    for one in seen:
        lines.append(f"{one.verdict:<5}{one.check:<{width}}  {one.text}")
        if one.fix:
            lines.append(f"     {'':<{width}}  -> {one.fix}")
    if skipped := [one for one in findings if one.verdict is Verdict.UNSEEN]:
        lines.append("not looked at:")
        lines += [f"     {one.check:<{width}}  {one.text}" for one in skipped]
    count = {verdict: sum(one.verdict is verdict for one in seen) for verdict in Verdict}
    lines.append(f"{count[Verdict.OK]} ok, {count[Verdict.WARN]} to look at, {count[Verdict.FAIL]} wrong")
    return "\n".join(lines)


def as_json(findings: Sequence[Finding], program: Program) -> str:
    """Format the findings as JSON for programs.

    {"host", "version", "ok", "findings": [{"check", "verdict", "text", "fix"}]}.
    """
    report = {
        "host": program.host,
        "version": program.version,
        "ok": exit_code(findings) == 0,
        "findings": [asdict(one) for one in findings],
    }
    return msgspec.json.format(msgspec.json.encode(report)).decode()
