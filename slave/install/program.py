"""Other programs, run to their end.

Installer and doctor query the system by them. Standard library only.
"""

import subprocess
from collections.abc import Sequence


def finished(command: Sequence[str], timeout_s: float) -> "subprocess.CompletedProcess[str]":
    """Run a program without input to its end and return it with its output.

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
