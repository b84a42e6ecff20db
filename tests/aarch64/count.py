"""Runs the program under the counting QEMU and natively, and makes numbers of the marks."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from tests.aarch64.guest import FIRST, LAST, MACHINE_CODE
from tests.aarch64.sysroot import CACHE, PYTHON, ROOT, NotPossibleError, Sysroot

CPU = "cortex-a53"  # Raspberry Pi 3 and Zero 2 W: the slowest that is meant
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}


class Counted(NamedTuple):
    """Case -> instructions per frame; case -> hash of what was detected."""

    per_frame: dict[str, float]
    hashes: dict[str, str]


class _Run(NamedTuple):
    """One run of the program: labels of its marks, the count at each, hash of what was detected."""

    labels: list[str]
    counts: list[int]
    digest: str


def counted(sysroot: Sysroot, frames: Path, cases: Sequence[str], fast: Path | None = None) -> Counted:
    """Run `cases` under emulation, each in a process of its own: what ran before moves a count by some 1e-3.

    `fast`: folder of the wheels of machine code. One such case runs uncounted first: what was compiled in the same
    process is not the code that every later start loads. NotPossibleError: the emulated program failed.
    """
    compiled = [case for case in cases if case in MACHINE_CODE]
    if compiled:
        _emulated(sysroot, frames, compiled[0], fast)
    at_once = 2  # runs side by side
    with ThreadPoolExecutor(at_once) as pool:
        running = {case: pool.submit(_emulated, sysroot, frames, case, fast) for case in cases}
        answers = {case: run.result() for case, run in running.items()}
    slopes: dict[str, float] = {}
    for case, (labels, counts, _) in answers.items():
        at = dict(zip(labels, counts, strict=True))
        slopes[case] = slope(at[f"{case} {FIRST}"], at[f"{case} {LAST}"])
    return Counted(slopes, {case: one.digest for case, one in answers.items()})


def native(frames: Path, cases: Sequence[str]) -> dict[str, str]:
    """Run `cases` on this machine; case -> hash of what was detected."""
    return {case: _ask([sys.executable], frames, case, os.environ)[1] for case in cases}


def _emulated(sysroot: Sysroot, frames: Path, case: str, fast: Path | None) -> _Run:
    with tempfile.TemporaryDirectory() as folder:
        marks = Path(folder) / "marks"
        qemu = [*sysroot.qemu, "-cpu", CPU, "-L", str(sysroot.root)]
        plugin = ["-plugin", f"file={sysroot.plugin},to={marks}"]
        python = [str(sysroot.root / f"usr/bin/python{PYTHON}"), "-s", "-S"]
        # Compiled modules go to a place of their own: the emulated Python's own path may be the machine's as well.
        environment = {
            "PATH": os.defpath,
            "PYTHONPATH": f"{sysroot.wheels}:{ROOT}",
            "PYTHONPYCACHEPREFIX": str(CACHE / "pyc"),
        }
        if case in MACHINE_CODE:
            environment["PYTHONPATH"] += f":{fast}"
            environment["NUMBA_CACHE_DIR"] = str(CACHE / "numba")
        # Nothing else of this machine's environment: its size alone moves the count.
        labels, digest = _ask([*qemu, *plugin, *python], frames, case, environment)
        counts = [int(line) for line in marks.read_text().split()]
    if len(counts) != len(labels):
        raise NotPossibleError(f"{case}: the plugin saw {len(counts)} marks, the program made {len(labels)}")
    return _Run(labels, counts, digest)


def slope(first: int, last: int) -> float:
    """Instructions per frame between two counts; what happens before the first does not enter."""
    return (last - first) / (LAST - FIRST)


def _ask(
    command: Sequence[str], frames: Path, case: str, environment: Mapping[str, str]
) -> tuple[list[str], str]:
    """Labels of the marks that the program made, and the hash of what it detected."""
    line = [*command, "-m", "tests.aarch64.guest", str(frames), case]
    result = subprocess.run(line, capture_output=True, text=True, env={**environment, **ONE_THREAD}, cwd=ROOT)
    if result.returncode != 0:
        raise NotPossibleError(f"{' '.join(line)} failed:\n{result.stderr.strip()}")
    answer = json.loads(result.stdout)
    return answer["labels"], answer["hash"]
