"""Other programs, run to their end: how installer and doctor ask the system. Standard library only."""

import subprocess
from collections.abc import Sequence


def finished(command: Sequence[str], timeout_s: float) -> "subprocess.CompletedProcess[str]":
    """A program that is asked for nothing, with what it said, when it has ended.

    Raises:
        OSError: It cannot be run; `FileNotFoundError`: it is not there.
        subprocess.TimeoutExpired: It did not end in `timeout_s` and was killed.
    """
    return subprocess.run(
        list(command),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout_s,
        check=False,
    )
