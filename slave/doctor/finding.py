"""State what a check gets, the system, and what it gives, findings.

Findings of the doctor.

One line per check, how bad it is, and what mends it. A check that was not made is reported as such.

The computer as the doctor sees it.

Files below a root, and programs that answer. A test supplies its own.
"""

import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path

import msgspec

from common.machine import ROOT, Program
from slave.install.systemd import finished


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


@dataclass(frozen=True, slots=True)
class Ran:
    """Output of a program.

    Attributes:
        code: Its exit code, negative for a signal; None: it is not there, or did not end in time.
        out: Its output.
        error: Its standard error, or why there is no code.
    """

    code: int | None
    out: str
    error: str


Run = Callable[[Sequence[str], float], Ran]


def run(command: Sequence[str], timeout_s: float) -> Ran:
    """Run a program that asks for nothing."""
    try:
        done = finished(command, timeout_s)
    except FileNotFoundError:
        return Ran(None, "", f"there is no {command[0]}")
    except subprocess.TimeoutExpired as error:
        so_far = error.stdout.decode(errors="replace") if isinstance(error.stdout, bytes) else ""
        return Ran(None, so_far, f"{command[0]}: no end after {timeout_s:.0f} s")
    except OSError as error:
        return Ran(None, "", f"{command[0]}: {error.strerror}")
    return Ran(done.returncode, done.stdout, done.stderr)


@dataclass(frozen=True, slots=True)
class System:
    """A computer.

    Attributes:
        root: Below which its files are.
        environment: Of the doctor's process.
        run: Runs a program, for so many seconds at most.
    """

    root: Path
    environment: Mapping[str, str]
    run: Run = run

    @classmethod
    def here(cls, environment: Mapping[str, str] = os.environ) -> "System":
        """This computer, or the files that `PHALANX_SYSTEM_ROOT` names."""
        return cls(Path(environment.get(ROOT, "/")), environment)

    def path(self, place: str | Path) -> Path:
        """Where `/place` of the computer is."""
        return self.root / str(place).lstrip("/")

    def text(self, place: str) -> str | None:
        """Return the content of a file without its end of line and its NUL.

        The NUL is that of the device tree; None: it cannot be read.
        """
        try:
            return self.path(place).read_text(errors="replace").strip("\0\n ")
        except OSError:
            return None


def pairs(text: str, between: str = "=") -> dict[str, str]:
    """Lines of NAME=VALUE, or with another sign between the two."""
    return {name: value for name, _, value in (line.partition(between) for line in text.splitlines())}
