"""A command line parses options, runs one of several commands and prints.

Results go to standard output, remarks to standard error. Each command has two functions, named as `module:function`,
whose modules are imported only when it is requested. One adds its options to a parser; its docstring is the help, with
the examples behind a line `Examples:`. It is imported for the help and to read the options, so its module imports
nothing heavy. The other does the work: it takes the options, and returns the exit code, or None for 0. The types of
options check bounds; their errors name the value and what is expected.
"""

import difflib
import logging
import math
import os
import re
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from textwrap import dedent
from typing import Any, NoReturn, cast

from common.errors import PhalanxError
from common.supervisor import ServiceManager, one_line, supervised_threads


def echo(text: str = "", *, end: str = "\n", error: bool = False) -> None:
    """Write a line at once, to standard error if asked to."""
    stream = sys.stderr if error else sys.stdout
    stream.write(text + end)
    stream.flush()


def remark(text: str) -> None:
    """Write a line to standard error at once."""
    echo(text, error=True)


# What is written for Linux alone, by `sys.platform`; tests/elsewhere.py lists its files.
_NOT_HERE: dict[str, str] = dict.fromkeys(
    ("darwin", "win32"),
    "cameras of a Pi (on USB: --camera opencv:INDEX), I2C, lights, demo, run --install, fleet",
)
_NOT_HERE["win32"] += (
    ", IMUs on serial ports, libsurvive, private files of keys, an orderly end of what console starts"
)


def check_system(platform: str, utf8_mode: int) -> None:
    """State what does not work on this system, by name.

    Raises:
        PhalanxError: It would read and write files in another encoding than UTF-8.
    """
    if platform == "win32" and not utf8_mode:
        raise PhalanxError(
            "set PYTHONUTF8=1: files of Phalanx are UTF-8, this Python would read them otherwise"
        )
    if missing := _NOT_HERE.get(platform):
        remark(
            f"{platform}: nobody has tried it yet; not here: {missing}, a check of who opens a console without password"
        )


DONE, FAILED, WRONG_USAGE = 0, 1, 2
_EXAMPLES = "Examples:"
_HELP = ("-h", "--help")
_OURS = frozenset({"common", "deploy", "master", "slave"})
_LOG = "%(levelname)s %(name)s: %(message)s"


class Parser(ArgumentParser):
    """Argument parser that takes what begins like a negative number as a value."""

    def __init__(self, program: str, about: str, examples: str) -> None:
        super().__init__(
            prog=program,
            description=about,
            epilog=f"examples:\n{examples}" if examples else None,
            formatter_class=RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        self._negative_number_matcher = re.compile(r"-[.\d]")


class UsageError(Exception):
    """Options are incompatible; the program ends as for an unknown option."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command.

    Attributes:
        name: Its words, as `fleet deploy`.
        group: Heading that it stands under in the help of the program.
        purpose: What it is for, in a line.
        options: `module:function` that adds its options.
        work: `module:function` that does it.
    """

    name: str
    group: str
    purpose: str
    options: str
    work: str

    def parser(self, program: str) -> ArgumentParser:
        """The parser of its options."""
        about, examples = help_of(_function(self.options))
        parser = Parser(f"{program} {self.name}", about, examples)
        self.declare(parser)
        return parser

    def declare(self, parser: ArgumentParser) -> None:
        """Add its options to a parser."""
        _function(self.options)(parser)


@dataclass(frozen=True, slots=True)
class Family:
    """Commands whose names begin with `name`; `group`, `purpose` as of `Command`."""

    name: str
    group: str
    purpose: str


@dataclass(frozen=True, slots=True)
class Program:
    """A program.

    Attributes:
        about: Its help, in front of the table of commands.
        table: Commands and families, in the order of the help.
        missing: What to do where a package is missing that a command needs.
        log: Format of the lines of the log.
    """

    name: str
    about: str
    table: tuple[Command | Family, ...]
    missing: str
    log: str = _LOG

    @property
    def commands(self) -> tuple[Command, ...]:
        """The commands alone."""
        return tuple(entry for entry in self.table if isinstance(entry, Command))

    def main(self, words: Sequence[str] | None = None) -> int:
        """Run one command and return its exit code.

        0 done, 1 something the user can fix, 2 wrong usage, 130 interrupted.

        Raises:
            SystemExit: With code 0 after a help, 2 for wrong usage, 70 if a thread or the command itself failed.
        """
        given = sys.argv[1:] if words is None else list(words)
        logging.basicConfig(level=logging.INFO, format=self.log, stream=sys.stderr)
        with supervised_threads():
            try:
                return self._run(given)
            except PhalanxError as error:
                ServiceManager(os.environ).send(f"STATUS=failed: {one_line(str(error))}")
                echo(f"{self.name}: {error}", error=True)
                return FAILED
            except ModuleNotFoundError as error:
                if (error.name or "").split(".")[0] in _OURS:
                    raise
                fix = "this needs Linux" if error.name in sys.stdlib_module_names else self.missing
                echo(f"{self.name}: {error.name} is missing: {fix}", error=True)
                return FAILED
            except KeyboardInterrupt:
                echo(f"\n{self.name}: interrupted", error=True)
                return 130
            except BrokenPipeError:  # whoever read the output has ended
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                return FAILED

    def parse(self, words: Sequence[str]) -> tuple[Command, Namespace]:
        """Read a command line.

        Raises:
            SystemExit: With code 0 after a help, 2 for wrong usage.
            PhalanxError: The value of an option is refused.
        """
        command, rest = self._find(words)
        return command, command.parser(self.name).parse_args(rest)

    def _run(self, words: Sequence[str]) -> int:
        command, options = self.parse(words)
        check_system(sys.platform, sys.flags.utf8_mode)
        try:
            return int(_function(command.work)(options) or DONE)
        except UsageError as error:
            command.parser(self.name).error(str(error))

    def _find(self, words: Sequence[str]) -> tuple[Command, Sequence[str]]:
        """The command that the first words name, and the other words."""
        known = {entry.name: entry for entry in self.table}
        name = ""
        for place, word in enumerate(words):
            if word in _HELP:
                echo(self.help(name))
                raise SystemExit(DONE)
            entry = known.get(f"{name} {word}".strip())
            if isinstance(entry, Command):
                return entry, words[place + 1 :]
            if entry is None:
                self._refuse(name, word)
            name = entry.name
        echo(self.help(name), error=True)
        raise SystemExit(WRONG_USAGE)

    def _refuse(self, family: str, word: str) -> NoReturn:
        there = [entry.name.rpartition(" ")[2] for entry in self._members(family)]
        near = difflib.get_close_matches(word, there, 1)
        advice = f"did you mean {near[0]}?" if near else f"there are {', '.join(there)}"
        echo(f"{f'{self.name} {family}'.strip()}: no command {word!r}: {advice}", error=True)
        raise SystemExit(WRONG_USAGE)

    def _members(self, family: str) -> list[Command | Family]:
        return [entry for entry in self.table if entry.name.rpartition(" ")[0] == family]

    def help(self, family: str = "") -> str:
        """The help of the program, or of a family of its commands."""
        members = self._members(family)
        title = f"{self.name} {family}".strip()
        wide = max(len(entry.name.rpartition(" ")[2]) for entry in members)
        about = self.about
        if family:
            purpose = next(entry.purpose for entry in self.table if entry.name == family)
            about = f"{purpose[0].upper()}{purpose[1:]}."
        lines = [f"usage: {title} COMMAND ...", "", about]
        group = ""
        for entry in members:
            if entry.group != group:
                group = entry.group
                lines += ["", f"{group}:"]
            lines.append(f"  {entry.name.rpartition(' ')[2]:{wide}}  {entry.purpose}")
        if examples := self._examples(members) if family else "":
            lines += ["", "examples:", examples]
        return "\n".join([*lines, "", f"`{title} COMMAND --help` shows its options and examples."])

    def _examples(self, members: Sequence[Command | Family]) -> str:
        """The first example of each command."""
        found: list[str] = []
        for entry in members:
            first = entry if isinstance(entry, Command) else self._first(entry)
            examples = help_of(_function(first.options))[1].splitlines()
            own = next((line for line in examples if line.startswith(f"  {self.name} {first.name} ")), "")
            found += [own] if own else []
        return "\n".join(found)

    def _first(self, family: Family) -> Command:
        return next(one for one in self.commands if one.name.startswith(f"{family.name} "))


def defaults_of(declare: Callable[[ArgumentParser], None]) -> Namespace:
    """Default values of the options that `declare` adds; none may be required."""
    parser = ArgumentParser()
    declare(parser)
    return parser.parse_args([])


def help_of(declare: Callable[..., object]) -> tuple[str, str]:
    """Description and examples from the docstring of a function of options."""
    first, _, rest = (declare.__doc__ or "").strip().partition("\n")
    about, _, examples = f"{first}\n{dedent(rest)}".partition(f"\n{_EXAMPLES}\n")
    return about.strip(), examples.rstrip()


def _function(place: str) -> Callable[..., Any]:
    module, _, name = place.partition(":")
    return cast("Callable[..., Any]", getattr(import_module(module), name))


@dataclass(frozen=True, slots=True)
class Number:
    """A finite number, or with `whole` an integer, between bounds; None: no bound."""

    low: float | None = None
    high: float | None = None
    whole: bool = False

    def __call__(self, text: str) -> float | int:
        """Read it; raises ArgumentTypeError if it is no such number."""
        try:
            value = int(text) if self.whole else float(text)
        except ValueError as error:  # argparse would print the name of the class
            kind = "a whole number" if self.whole else "a number"
            raise ArgumentTypeError(f"{text}: must be {kind}") from error
        if not math.isfinite(value):
            raise ArgumentTypeError(f"{text}: must be a finite number")
        if self.low is not None and value < self.low:
            raise ArgumentTypeError(f"{text}: must be at least {self.low:g}")
        if self.high is not None and value > self.high:
            raise ArgumentTypeError(f"{text}: must be at most {self.high:g}")
        return value


def number(low: float | None = None, high: float | None = None) -> Number:
    """A finite number between these bounds."""
    return Number(low, high)


def whole(low: int | None = None, high: int | None = None) -> Number:
    """A whole number between these bounds."""
    return Number(low, high, whole=True)


def positive(text: str) -> float:
    """A number above 0, or ArgumentTypeError."""
    value = Number()(text)
    if not value > 0.0:
        raise ArgumentTypeError(f"{text}: must be positive")
    return value


def megabytes(text: str) -> float:
    """A number from 0 on, or ArgumentTypeError."""
    value = Number()(text)
    if value < 0.0:
        raise ArgumentTypeError(f"{text}: must not be negative")
    return value


def count(text: str) -> int:
    """A whole number from 1 on, or ArgumentTypeError."""
    if not text.isdecimal() or int(text) < 1:
        raise ArgumentTypeError(f"{text}: must be a whole number, at least 1")
    return int(text)


def port(text: str) -> int:
    """A port of UDP or TCP, or ArgumentTypeError."""
    if not text.isdecimal() or not 0 < int(text) < 65536:
        raise ArgumentTypeError(f"{text}: must be a port, 1 to 65535")
    return int(text)
