"""Terminal output of the master's commands: text lines and progress."""

import sys

from common.terminal import echo


def print_line(line: str) -> None:
    """A line to whoever started the master."""
    echo(f"master: {line}")


def progress(what: str, done: int, total: int) -> None:
    """How much is done, in place; nothing where no terminal shows it."""
    if sys.stderr.isatty():
        echo(f"\r{what}: {100 * done // max(total, 1)} %   ", end="", error=True)
