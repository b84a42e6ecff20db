"""How soon a command answers: the help of each loads nothing heavy, and costs next to no processor time."""

import resource
import subprocess
import sys
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
ENTRIES: list[tuple[str, Command | Family | None]] = [
    ("master", None),
    ("slave", None),
    *(("master", entry) for entry in TABLE),
    *(("slave", entry) for entry in PROGRAM.table),
]


def words_of(entry: Command | Family | None) -> list[str]:
    return [] if entry is None else entry.name.split()


def heavy_of(module: str, words: list[str], before: str = "") -> frozenset[str]:
    """What of the heavy packages a help loads, in a process of its own."""
    code = f"import sys\n{before}\nfrom {module}.__main__ import main\nsys.argv[1:] = {[*words, '--help']}\n"
    code += "try:\n    main()\nexcept SystemExit:\n    pass\nprint('loaded:', *sys.modules)"
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout
    assert "usage:" in shown
    return HEAVY & set(shown.rpartition("loaded:")[2].split())


def spent_s(*words: str) -> float:
    """The least processor time of three runs of a command."""
    found: list[float] = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-m", *words], capture_output=True, check=False, cwd=ROOT)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(found)


@pytest.mark.parametrize(("module", "entry"), ENTRIES, ids=lambda one: getattr(one, "name", one) or "all")
def test_no_help_loads_anything_heavy(module: str, entry: Command | Family | None) -> None:
    assert heavy_of(module, words_of(entry)) == set()


def test_the_check_sees_a_planted_package() -> None:
    assert heavy_of("master", ["check"], "import numpy") >= {"numpy"}


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
    assert spent_s(*words, "--help") <= HELP_S


def test_the_clock_sees_what_is_heavy() -> None:
    assert spent_s("timeit", "-n1", "-r1", "while __import__('time').process_time() < 0.6: pass") > HELP_S


def test_check_and_info_answer_soon(tmp_path: Path) -> None:
    assert spent_s("master", "check", "--bus", "tcp/127.0.0.1:1") <= ANSWER_S
    assert spent_s("master", "info", str(tmp_path / "none.mcap")) <= ANSWER_S
