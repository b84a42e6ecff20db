"""The table of commands: each help teaches its own command, and each command reads what is declared for it."""

import ast
import inspect
from argparse import ArgumentParser
from importlib import import_module

import pytest

from common.command_line import Command, Family, Program, help_of
from master.cli.table import TABLE, program
from slave.cli.table import PROGRAM
from tests.cli import invoke

COMMANDS = [entry for entry in (*TABLE, *PROGRAM.table) if isinstance(entry, Command)]
PROGRAMS = [program(), PROGRAM]
MOST = 41  # commands, all programs and families together


def examples_of(command: Command) -> str:
    module, _, name = command.options.partition(":")
    return help_of(getattr(import_module(module), name))[1]


def program_of(command: Command) -> Program:
    return PROGRAM if command in PROGRAM.table else program()


def read_in(text: str) -> set[str]:
    """The options that a module reads."""
    return {
        node.attr
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "options"
    }


def reached_from(name: str, text: str) -> str:
    """The function `name` of a module and what it uses of the module, as text."""
    parts: dict[str, ast.AST] = {
        node.name: node
        for node in ast.parse(text).body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
    }
    reached: dict[str, str] = {}
    waiting = [name]
    while waiting:
        if (one := waiting.pop()) in parts and one not in reached:
            reached[one] = ast.unparse(parts[one])
            waiting += [node.id for node in ast.walk(parts[one]) if isinstance(node, ast.Name)]
    return "\n".join(reached.values())


def declared_by(command: Command) -> set[str]:
    parser = ArgumentParser(add_help=False)
    command.declare(parser)
    return {action.dest for action in parser._actions}


def test_names_are_once_and_few() -> None:
    for one in PROGRAMS:
        names = [entry.name for entry in one.table]
        assert len(set(names)) == len(names)
    assert len(COMMANDS) <= MOST


@pytest.mark.parametrize("command", COMMANDS, ids=lambda one: one.name)
def test_a_help_shows_examples_of_its_command(command: Command) -> None:
    own = f"{program_of(command).name} {command.name}"
    assert any(own in line for line in examples_of(command).splitlines())
    shown = invoke(*command.name.split(), "--help", of=program_of(command))
    assert shown.exit_code == 0
    assert shown.output.startswith(f"usage: {own} ")
    assert "examples:\n" in shown.output
    assert command.purpose[0].islower()


@pytest.mark.parametrize("one", PROGRAMS, ids=lambda one: one.name)
def test_the_helps_of_programs_and_families_list_all(one: Program) -> None:
    families = [entry.name for entry in one.table if isinstance(entry, Family)]
    shown = {family: invoke(*family.split(), "--help", of=one).output for family in ("", *families)}
    for entry in one.table:
        family, _, name = entry.name.rpartition(" ")
        assert any(line.split()[:1] == [name] for line in shown[family].splitlines()), entry.name


@pytest.mark.parametrize("command", COMMANDS, ids=lambda one: one.name)
def test_a_command_reads_only_what_is_declared(command: Command) -> None:
    module, _, name = command.work.partition(":")
    work = import_module(module)
    assert callable(getattr(work, name))
    assert read_in(reached_from(name, inspect.getsource(work))) - declared_by(command) == set()


def test_the_check_sees_an_option_that_nobody_declared() -> None:
    assert read_in("def run(options):\n    return options.rig, options.rigg") == {"rig", "rigg"}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("nonsense",), "there are demo, replay"),
        (("fleet", "stat"), "did you mean status?"),
        (("calibrate", "cameras", "stereos"), "did you mean stereo?"),
        ((), "usage: phalanx COMMAND"),
        (("run", "--nope"), "unrecognized arguments: --nope"),
        (("export", "x.npz", "--rate", "fast"), "fast: must be a number"),
        (
            ("calibrate", "depth", "--verify", "--angles", "-90:90:10", "--sigma-px", "-x"),
            "--sigma-px: expected one",
        ),
        (("view", "--web-port", "0"), "0: must be at least 1"),
        (("fleet", "keys", "DIR", "--revoke"), "--revoke: name the lost device"),
        (("run", "--dry-run"), "--dry-run is for --install"),
        (("fleet", "relay", "--site", "a"), "--router ENDPOINT"),
    ],
)
def test_wrong_usage_is_said_and_ends_with_2(words: tuple[str, ...], expected: str) -> None:
    ended = invoke(*words)
    assert (ended.exit_code, expected in ended.output) == (2, True), ended.output
