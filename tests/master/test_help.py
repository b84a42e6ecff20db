"""What the help of a command shows is what was written: the markup of the help swallows text in square brackets."""

import contextlib
import io
import os
from typing import Annotated
from unittest.mock import patch

import pytest
import typer

from master.commands import command_line

WIDE = {"COLUMNS": "4000", "TERMINAL_WIDTH": "4000"}


def swallowed(top: typer.Typer) -> tuple[int, list[str]]:
    """How many texts of options and arguments the commands have, and those that are not shown whole."""
    count, lost = 0, list[str]()
    waiting = [("", typer.main.get_command(top))]
    while waiting:
        path, command = waiting.pop()
        with contextlib.redirect_stdout(io.StringIO()) as out, patch.dict(os.environ, WIDE):
            command.main(["--help"], standalone_mode=False)
        shown = " ".join(out.getvalue().split())
        texts = [text for one in command.params if (text := getattr(one, "help", None))]
        count += len(texts)
        lost += [f"{path}: {text}" for text in texts if " ".join(text.split()) not in shown]
        waiting += [(f"{path} {name}", one) for name, one in getattr(command, "commands", {}).items()]
    return count, lost


def test_no_help_loses_its_unit() -> None:
    count, lost = swallowed(command_line())
    assert count > 60, "the commands were not found: the check would pass on nothing"
    assert lost == []


@pytest.mark.parametrize(("text", "whole_text"), [("Side [mm].", False), ("Side, in mm.", True)])
def test_the_check_sees_a_swallowed_unit(text: str, whole_text: bool) -> None:
    top = typer.Typer()

    @top.command()
    def draw(side: Annotated[float, typer.Option(help=text)] = 1.0) -> None:
        del side

    _, lost = swallowed(top)
    assert (lost == []) is whole_text
    del draw
