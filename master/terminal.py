"""What commands of the master say on the terminal: lines, and how far they are."""

import sys

import typer


def print_line(line: str) -> None:
    """A line to whoever started the master."""
    typer.echo(f"master: {line}")


def progress(what: str, done: int, total: int) -> None:
    """How much is done, in place; nothing where no terminal shows it."""
    if sys.stderr.isatty():
        typer.echo(f"\r{what}: {100 * done // max(total, 1)} %   ", nl=False, err=True)
