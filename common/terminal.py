"""Terminal output: results on standard output, remarks on standard error.

The lines are for whoever started the program.
"""

import sys


def echo(text: str = "", *, end: str = "\n", error: bool = False) -> None:
    """Write a line at once, to standard error if asked to."""
    stream = sys.stderr if error else sys.stdout
    stream.write(text + end)
    stream.flush()


def remark(text: str) -> None:
    """Write a line to standard error at once."""
    echo(text, error=True)
