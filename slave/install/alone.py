"""Lock that allows one installation at a time on a machine.

An installation whose PC went away goes on to its end, and the next waits for it.

The lock is on a folder that is always there, so no file of it comes and goes, and it ends with whoever has it. That one
has an end, too: each command that an installer runs has a time limit.
"""

import contextlib
import fcntl
import os
from collections.abc import Callable, Generator
from pathlib import Path

from slave.install.errors import InstallError

LOCKED = "opt"


@contextlib.contextmanager
def alone(root: Path, notify: Callable[[str], None], sleep: Callable[[float], None]) -> Generator[None]:
    """Hold the machine below `root` for oneself.

    Args:
        root: Where the machine's files are.
        notify: Notified that it has to wait.
        sleep: Waits so many seconds.

    Raises:
        InstallError: Another one still has it after ten minutes.
    """
    (root / LOCKED).mkdir(parents=True, exist_ok=True)
    folder = os.open(root / LOCKED, os.O_RDONLY | os.O_DIRECTORY)
    try:
        wait_s = 600
        for look in range(wait_s):
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if look == 0:
                    notify(
                        f"another installation runs on this machine: waiting for its end, at most {wait_s} s"
                    )
                poll_s = 1.0
                sleep(poll_s)
        else:
            raise InstallError(
                f"another installation still runs on this machine after {wait_s} s; to see it there: "
                "pgrep -af 'slave.*install'"
            )
        yield
    finally:
        os.close(folder)
