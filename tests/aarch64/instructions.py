"""Aarch64 instructions of the slave per frame, against the record (`make instructions`).

    make instructions                                    every case
    make instructions INSTRUCTIONS_ARGS='six windows'    some of: six windows numba numba-windows wrist wrist-numba seed
    make instructions INSTRUCTIONS_ARGS=--record         every case, and what was counted is the new baseline

Exit code: 0 within the gate, 1 outside it or detected otherwise than on this machine, 2 cannot be counted here.
"""

import argparse
import platform
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import msgspec

from tests.aarch64 import scene
from tests.aarch64.count import CPU, Counted, counted, native
from tests.aarch64.guest import MACHINE_CODE
from tests.aarch64.sysroot import CACHE, PYTHON, NotPossibleError, fast_wheels, prepare

FILE = Path(__file__).with_name("baseline.json")
# Counts of one program differ by 1e-3 at most between places and days: what is outside was changed.
GATE = 0.01


class BaselineError(Exception):
    """The baseline's file cannot be read."""


class Baseline(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Instructions per frame of each case, on which processor, and the versions of what was counted."""

    cpu: str
    instructions: dict[str, int]
    versions: dict[str, str]


def read(file: Path = FILE) -> Baseline | None:
    """Read the recorded baseline; None: there is none. BaselineError: the file is not one."""
    if not file.exists():
        return None
    try:
        return msgspec.json.decode(file.read_bytes(), type=Baseline)
    except msgspec.MsgspecError as error:
        raise BaselineError(f"{file}: {error}; write it afresh with --record") from error


def write(baseline: Baseline, file: Path = FILE) -> None:
    """Record it."""
    file.write_bytes(msgspec.json.format(msgspec.json.encode(baseline), indent=2) + b"\n")


def within(value: float, recorded: int | None) -> bool:
    """Whether `value` is at most GATE away from what was recorded, to either side; a case not recorded is not."""
    return recorded is not None and abs(value / recorded - 1.0) <= GATE


def compared(value: float, recorded: int | None) -> str:
    """How far from the record, in words."""
    return "not recorded" if recorded is None else f"{100.0 * (value / recorded - 1.0):+.2f} % of the record"


def other_versions(new: dict[str, str], old: dict[str, str]) -> list[str]:
    """One line for each thing whose version is another than when the baseline was recorded."""
    return [
        f"{name} is {new.get(name, 'absent')}, recorded with {old.get(name, 'absent')}"
        for name in sorted(new.keys() | old.keys())
        if new.get(name) != old.get(name)
    ]


CASES = {
    "six": "detection, six markers",
    "windows": "detection in windows alone, six markers",
    "numba": "detection, six markers, by machine code",
    "numba-windows": "the same in windows alone",
    "wrist": "triple of a wrist device: strobe, seams, laser, tips, message",
    "wrist-numba": "the same, by machine code",
    "seed": "published pipeline rebuilt, six markers",
}
RATIOS = (
    ("seed", "six", "published / ours"),
    ("six", "windows", "whole frame / windows"),
    ("wrist", "wrist-numba", "wrist, numpy / machine code"),
    ("numba", "numba-windows", "whole frame / windows, machine code"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Count, compare, record if wanted; return the exit code."""
    keep = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("make instructions", description=__doc__, formatter_class=keep)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"{' '.join(CASES)} (default: all)")
    parser.add_argument("--record", action="store_true", help="write the baseline")
    options = parser.parse_args(arguments)
    cases = cast(list[str], options.cases) or list(CASES)
    if unknown := sorted(set(cases) - CASES.keys()):
        parser.error(f"no case {unknown[0]!r}; there are {', '.join(CASES)}")
    if options.record and set(cases) != CASES.keys():
        parser.error("the baseline holds every case: --record goes with no CASE")
    try:
        return _count(cases, record=options.record)
    except (NotPossibleError, BaselineError) as error:
        print(f"instructions: {error}", file=sys.stderr)
        return 2


def _count(cases: list[str], *, record: bool) -> int:
    old = None if record else read()
    sysroot = prepare(_print)
    fast = fast_wheels(_print) if set(cases) & set(MACHINE_CODE) else None
    with tempfile.TemporaryDirectory(dir=CACHE, prefix="frames-") as folder:
        scene.write_all(Path(folder))
        equal = [case for case in cases if case not in MACHINE_CODE]  # whose sums may be in any order
        here = native(Path(folder), equal)
        found = counted(sysroot, Path(folder), cases, fast)
    print(f"aarch64 instructions per frame, 640x480, {CPU}, QEMU {sysroot.versions['qemu']}")
    _print_table(cases, found, old)
    new = Baseline(CPU, {case: round(found.per_frame[case]) for case in cases}, sysroot.versions)
    good = _same_everywhere(equal, found.hashes, here)
    if record:
        write(new)
        print(f"  recorded in {FILE}")
    elif old is not None:
        good &= _within_gate(new, old)
    return 0 if good else 1


def _print(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _print_table(cases: list[str], found: Counted, old: Baseline | None) -> None:
    for case in cases:
        value = found.per_frame[case]
        note = "" if old is None else compared(value, old.instructions.get(case))
        print(f"  {case:13s} {value * 1e-6:9.3f} Minstr  {CASES[case]:56s} {note}")
    for top, bottom, text in RATIOS:
        if {top, bottom} <= set(cases):
            print(f"  {'':13s} {found.per_frame[top] / found.per_frame[bottom]:9.2f} x       {text}")


def _same_everywhere(cases: list[str], there: dict[str, str], here: dict[str, str]) -> bool:
    """Print whether both architectures detected the same bits; False if they did not, though they should."""
    other = [case for case in cases if there[case] != here[case]]
    for case in cases:
        verdict = "NOT EQUAL" if case in other else "equal"
        print(
            f"  {case:13s} sha256 {there[case][:16]} on aarch64, {here[case][:16]} on {platform.machine()}: {verdict}"
        )
    if other and not platform.python_version().startswith(f"{PYTHON}."):
        print(
            f"  not judged: Python {platform.python_version()} here, {PYTHON} there; 3.12 adds floats otherwise"
        )
        return True
    return not other


def _within_gate(new: Baseline, old: Baseline) -> bool:
    for line in other_versions(new.versions, old.versions):
        print(f"  note: {line}")
    outside = [
        case for case, value in new.instructions.items() if not within(value, old.instructions.get(case))
    ]
    if outside:
        print(f"  outside the gate of ±{100 * GATE:g} %: {', '.join(outside)}; if that is meant: --record")
    return not outside


if __name__ == "__main__":
    sys.exit(main())
