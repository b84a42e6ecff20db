"""Frozen recordings of messages with exact truth, and how two solvers do on them.

    python -m bench oracle freeze                     once: recordings and truth, into out/oracle
    python -m bench oracle run --name base            the hands that this code makes of them
    python -m bench oracle run --name new --sets held,room --solver fabrik
    python -m bench oracle compare base new           errors, coverage, jitter, lag, cost; old, new, ratio; verdicts
    python -m bench oracle compare base new --tree DIR     makes both first: `base` by the code in DIR, `new` by this,
                                                      in turns, so that both meet the same minutes of the machine

The same code gives the same hands; only times differ. `compare` ends with 1 where a verdict fails.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from bench.oracle.score import compare, plain, table
from bench.oracle.truth import FROZEN, Piece, freeze, sets_of
from bench.report import ROOT, datasets
from common.errors import PhalanxError

_OUT = ROOT / "out" / "oracle"

Maker = Callable[[], Iterable[Piece]]


@dataclass(frozen=True, slots=True)
class Runner:
    """Who makes a run: the code of which checkout, under which name, with which solver (None: of the rigs)."""

    tree: Path
    name: str
    solver: str | None = None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run by the command line; return the exit code."""
    options = _parser().parse_args(arguments)
    try:
        if options.command == "freeze":
            return _freeze(options.out, options.sets)
        sets = _chosen(options.out, options.sets)
        here = Runner(ROOT, options.name if options.command == "run" else options.new, options.solver)
        if options.command == "run":
            solve(options.out, [here], sets)
            return 0
        if options.tree is not None:
            solve(options.out, [Runner(options.tree.resolve(), options.old), here], sets)
        compared = compare(options.out, options.old, options.new, sets)
    except PhalanxError as error:
        print(f"oracle: {error}", file=sys.stderr)
        return 2
    print(table(compared))
    if options.json is not None:
        options.json.write_text(json.dumps(plain(compared), indent=1, allow_nan=False))
    return int(any(one.fails for one in compared))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m bench oracle", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    frozen, run, both = (
        commands.add_parser(name, help=text)
        for name, text in (
            ("freeze", "make the recordings and their truth"),
            ("run", "solve them"),
            ("compare", "hold one run against another"),
        )
    )
    run.add_argument("--name", required=True, help="of the run")
    both.add_argument("old", metavar="A", help="name of the run that is the measure")
    both.add_argument("new", metavar="B", help="name of the run that is judged")
    both.add_argument("--tree", type=Path, metavar="DIR", help="make both runs first, A by the code in DIR")
    both.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")
    for one in (frozen, run, both):
        one.add_argument("--sets", metavar="SET,...", help="some alone")
    for one in (run, both):
        one.add_argument("--solver", choices=("estimator", "fabrik"), help="in place of that of the rigs")
    for one in (frozen, run, both):
        one.add_argument("--out", type=Path, default=_OUT, metavar="DIR", help="default: out/oracle")
    return parser


def _chosen(out: Path, wanted: str | None) -> list[str]:
    """The sets to solve; PhalanxError: there is none, or not that one."""
    there = sets_of(out)
    if not there:
        raise PhalanxError(f"{out / FROZEN}: nothing is frozen here: python -m bench oracle freeze")
    chosen = there if wanted is None else wanted.split(",")
    if unknown := sorted(set(chosen) - set(there)):
        raise PhalanxError(f"set {unknown[0]!r}: there are {', '.join(there)}")
    return chosen


def _freeze(out: Path, wanted: str | None) -> int:
    """Make the recordings; PhalanxError: there is no such set, or it cannot be written."""
    data = datasets()
    simulated, of_data = _makers(data)
    there = (data / "stereo").is_dir() and (data / "leapjs").is_dir()
    makers = {**simulated, **of_data} if there else simulated
    chosen = list(makers) if wanted is None else wanted.split(",")
    if unknown := sorted(set(chosen) - makers.keys()):
        raise PhalanxError(
            f"set {unknown[0]!r}: there are {', '.join(makers)}{'' if there else _absent(data)}"
        )
    for name in chosen:
        freeze(out, name, makers[name]())
    if not there:
        print(f"only the simulated sets are frozen{_absent(data)}")
    return 0


def _absent(data: Path) -> str:
    return f": no recordings at {data}: set PHALANX_DATASETS"


def _makers(data: Path) -> tuple[dict[str, Maker], dict[str, Maker]]:
    """What makes each set: those of simulation, and those of the data folder."""
    from bench.oracle import sets  # only to freeze: these draw pictures

    simulated: dict[str, Maker] = {name: partial(sets.scenes, name) for name in sets.SCENES}
    simulated |= {"held": sets.held, "room": sets.in_room}
    simulated |= {name: partial(sets.fused, name) for name in sets.FUSED | sets.RENDERED}
    of_data: dict[str, Maker] = {
        name: partial(sets.stereo, data, names) for name, names in sets.STEREO.items()
    }
    of_data |= {"leap": partial(sets.leap, data), "wrist": partial(sets.worn, data)}
    return simulated, of_data


def solve(out: Path, runners: Sequence[Runner], sets: Sequence[str]) -> None:
    """Make the runs, each by a process of its own, in alternating turns; PhalanxError: one of them failed."""
    children = [_child(out.resolve(), one, sets) for one in runners]
    at, ended = "", False
    order = children
    while not ended:
        answers = [_next(child) for child in order]
        order = order[::-1]
        ended = not any(answers)
        if answers[0] not in ("", at):
            at = answers[0]
            print(f"solving {at} ...", file=sys.stderr, flush=True)
    for child, runner in zip(children, runners, strict=True):
        if child.wait():
            raise PhalanxError(f"run {runner.name!r} by the code in {runner.tree} failed")


def _child(out: Path, runner: Runner, sets: Sequence[str]) -> subprocess.Popen[str]:
    script = str(Path(__file__).with_name("solve.py"))
    command = [sys.executable, "-P", script, str(out), runner.name, "--sets", ",".join(sets)]
    if runner.solver is not None:
        command += ["--solver", runner.solver]
    # One thread each: the other's processor time must not be in it.
    environment = os.environ | {"PYTHONPATH": str(runner.tree), "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def _next(child: subprocess.Popen[str]) -> str:
    """The set that it is at after its next turn, empty at the end."""
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        child.stdin.write("\n")
        child.stdin.flush()
    except BrokenPipeError:
        return ""
    return child.stdout.readline().strip()
