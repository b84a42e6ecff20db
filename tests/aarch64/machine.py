"""Programs of the project on an emulated aarch64: Debian's Python, the wheels a slave has, this source tree."""

import os
import subprocess
from collections.abc import Sequence
from typing import NamedTuple

import pytest

from tests.aarch64 import sysroot
from tests.aarch64.count import CPU, ONE_THREAD
from tests.aarch64.sysroot import CACHE, PYTHON, ROOT, NoNetworkError, Sysroot


class Guest(NamedTuple):
    """What begins the command line of an emulated Python, and its whole environment."""

    python: tuple[str, ...]
    environment: dict[str, str]

    def start(self, arguments: Sequence[str]) -> "subprocess.Popen[str]":
        """Start Python with these arguments in the project's folder; output and errors are pipes."""
        return subprocess.Popen(
            [*self.python, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=self.environment,
        )


def sysroot_or_skip() -> Sysroot:
    """The emulated machine, made if it is not there yet (15 s); the test is skipped where it cannot be made."""
    if absent := sysroot.missing():
        pytest.skip(f"missing here: {', '.join(absent)} (Debian: apt install {' '.join(absent)})")
    try:
        return sysroot.prepare(lambda line: None)
    except NoNetworkError as error:
        pytest.skip(f"no network for what is emulated: {str(error).splitlines()[-1]}")


def guest_or_skip() -> Guest:
    """An emulated Python with the slave's wheels (not those of the master), on the processor of a Pi 3."""
    made = sysroot_or_skip()
    python = (*made.qemu, "-cpu", CPU, "-L", str(made.root), str(made.root / f"usr/bin/python{PYTHON}"))
    # Nothing of this machine's environment: PYTHONDONTWRITEBYTECODE alone would cost 20 s at each start.
    environment = {
        "PATH": os.defpath,
        "PYTHONPATH": f"{made.wheels}:{ROOT}",
        "PYTHONPYCACHEPREFIX": str(CACHE / "pyc"),
        **ONE_THREAD,
    }
    return Guest((*python, "-s", "-S"), environment)
