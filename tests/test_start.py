"""How soon a command answers: the help of each loads nothing heavy, and costs next to no processor time."""

import resource
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from common.command_line import Command, Family
from master.cli.table import TABLE
from slave.cli.table import PROGRAM

ROOT = Path(__file__).resolve().parents[1]
HEAVY = frozenset(
    {
        "cryptography",
        "cv2",
        "matplotlib",
        "mcap",
        "msgspec",
        "nicegui",
        "numba",
        "numpy",
        "rerun",
        "scipy",
        "zenoh",
    }
)
HELP_S, ANSWER_S = 0.5, 1.0  # processor time; on an idle machine a help takes 0.1, an answer 0.35
TABLES: dict[str, Sequence[Command | Family]] = {"master": TABLE, "slave": PROGRAM.table}
# Every help of a program in one process, and after each what it has loaded: the first that is heavy is named.
_HELPS = """
import sys
from {module}.__main__ import main
for number, words in enumerate({commands}):
    {before}
    sys.argv[1:] = [*words, "--help"]
    try:
        main()
    except SystemExit:
        pass
    print("loaded:", *words, "|", *sys.modules)
"""


def heavy_of(
    module: str, commands: Sequence[Sequence[str]], before: str = "pass"
) -> dict[str, frozenset[str]]:
    """What of the heavy packages is loaded after the help of each command, one after another in one process."""
    code = _HELPS.format(module=module, commands=commands, before=before)
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout
    assert shown.count("usage:") >= len(commands)
    lines = [line.removeprefix("loaded:") for line in shown.splitlines() if line.startswith("loaded:")]
    found = {
        words.strip(): HEAVY & set(loaded.split())
        for words, _, loaded in (one.partition("|") for one in lines)
    }
    return {words: heavy for words, heavy in found.items() if heavy}


def costs_at_most(limit_s: float, *words: str) -> bool:
    """Whether one of three runs of a command takes no more processor time."""

    def spent_s() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-m", *words], capture_output=True, check=False, cwd=ROOT)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    return any(spent_s() <= limit_s for _ in range(3))


@pytest.mark.parametrize("module", TABLES)
def test_no_help_loads_anything_heavy(module: str) -> None:
    assert heavy_of(module, [[], *(entry.name.split() for entry in TABLES[module])]) == {}


def test_the_check_sees_a_planted_package() -> None:
    planted = "if number == 1: import numpy"
    assert heavy_of("master", [["run"], ["check"]], planted) == {"check": {"numpy"}}


@pytest.mark.parametrize(
    "words",
    [
        ("master",),
        ("slave",),
        ("master", "run"),
        ("master", "calibrate", "cameras", "stereo"),
        ("master", "fleet", "deploy"),
        ("slave", "run"),
    ],
    ids=" ".join,
)
def test_a_help_costs_little(words: tuple[str, ...]) -> None:
    assert costs_at_most(HELP_S, *words, "--help")


def test_the_clock_sees_what_is_heavy() -> None:
    assert not costs_at_most(
        HELP_S, "timeit", "-n1", "-r1", "while __import__('time').process_time() < 0.6: pass"
    )


def test_check_and_info_answer_soon(tmp_path: Path) -> None:
    assert costs_at_most(ANSWER_S, "master", "check", "--bus", "tcp/127.0.0.1:1")
    assert costs_at_most(ANSWER_S, "master", "info", str(tmp_path / "none.mcap"))
