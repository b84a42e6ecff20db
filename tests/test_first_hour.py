"""The page of the first hour quotes what the programs print: each quote is a text of the source.

A quote is code in the first column of a table whose head says "prints". Texts are the string literals and
f-strings of the programs, whose `{...}` stand for anything; a quote that ends with an ellipsis behind it may stop
where it likes.
"""

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "guide" / "first-hour.md"
FOLDERS = ("common", "slave", "master", "deploy")

Template = tuple[str | None, ...]  # None: what is filled in


def quotes(page: str) -> list[tuple[str, bool]]:
    """What is quoted, and whether it goes on."""
    found: list[tuple[str, bool]] = []
    in_table = False
    for line in page.splitlines():
        if not line.startswith("|"):
            in_table = False
        elif "prints |" in line:
            in_table = True
        elif in_table and not line.startswith("|-"):
            cell = line.split("|")[1].strip()
            match = re.fullmatch(r"`([^`]+)`( …)?", cell)
            assert match is not None, f"no quote: {cell}"
            found.append((match[1], match[2] is not None))
    return found


def templates_of(source: str) -> list[Template]:
    """The texts of a module."""
    found: list[Template] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            pieces = node.value.split("HOST")  # of a hint of ssh
            found.append(tuple(part for piece in pieces for part in (None, piece))[1:])
        elif isinstance(node, ast.JoinedStr):
            found.append(
                tuple(str(one.value) if isinstance(one, ast.Constant) else None for one in node.values)
            )
    return found


@functools.cache
def templates() -> tuple[Template, ...]:
    """The texts of all programs; of the Makefile those of echo."""
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    made = [one for path in paths for one in templates_of(path.read_text())]
    return (*made, *((text,) for text in re.findall(r'echo "([^$"]+)', (ROOT / "Makefile").read_text())))


def _begins(rest: Template, quote: str) -> bool:
    """Whether it is worth a try."""
    return (first := rest[0]) is None or quote.startswith(first) or first.startswith(quote)


@functools.lru_cache(maxsize=4096)
def own(template: Template, quote: str, goes_on: bool) -> int:
    """Characters of the quote that the template itself has, -1: it cannot be printed by it, or begin so."""
    if not quote:
        return 0 if goes_on or not template else -1
    if not template:
        return -1
    piece, rest = template[0], template[1:]
    if piece is None:
        longest = 40  # of what is filled in
        starts = [
            cut for cut in range(1, min(len(quote), longest) + 1) if not rest or _begins(rest, quote[cut:])
        ]
        return max((own(rest, quote[cut:], goes_on) for cut in starts), default=-1)
    if quote.startswith(piece):
        after = own(rest, quote[len(piece) :], goes_on)
        return -1 if after < 0 else len(piece) + after
    return len(quote) if goes_on and piece.startswith(quote) else -1


def printed(quote: str, goes_on: bool) -> bool:
    """Whether a template says at least half of the quote, and what it fills in may be the rest."""
    return any(own(one, quote, goes_on) * 2 >= len(quote) for one in templates())


QUOTES = quotes(PAGE.read_text())


@pytest.mark.parametrize(("quote", "goes_on"), QUOTES, ids=[quote[:40] for quote, _ in QUOTES])
def test_what_the_page_quotes_is_printed(quote: str, goes_on: bool) -> None:
    assert printed(quote, goes_on)


def test_every_step_has_three_things_that_go_wrong() -> None:
    steps = PAGE.read_text().split("\n## ")[1:]
    numbered = [step for step in steps if step[0].isdigit()]
    assert len(numbered) == 8
    assert [len(quotes(step)) for step in numbered] == [3] * 8
    assert [step for step in numbered if "**You see**" not in step] == []


def test_a_quote_is_what_the_template_says_and_not_what_is_filled_in() -> None:
    lens = ("Camera ", None, ": its lens is not measured.")
    assert own(lens, "Camera left: its lens is not measured.", goes_on=False) == 34
    assert own(lens, "Camera left: its lens", goes_on=True) == 17
    assert own(lens, "Camera left: its lens", goes_on=False) == -1
    assert own(lens, "Camera left is broken", goes_on=True) == 7


def test_what_no_program_prints_is_no_quote() -> None:
    assert printed("Camera left: its lens is not measured.", goes_on=True)
    assert not printed("Camera left: its lens is dirty.", goes_on=False)
    assert not printed("Camera left: its lens is not", goes_on=False)
    assert not printed("the camera is broken", goes_on=True)
