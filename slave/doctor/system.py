"""The computer as the doctor sees it.

Files below a root, and programs that answer. A test supplies its own.
"""

import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from common.machine import ROOT
from slave.install.program import finished


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
