"""Supervisor ends the console's processes once the console is gone.

Run as `python -m master.console.process_supervisor`. It reads "+PID" and "-PID" lines from a pipe whose other
end only the console holds. When that closes, each process group still listed is asked to end, and killed if
it does not.
"""

import os
import signal
import sys
import time
from collections.abc import Iterable

ENDS_S = 4.0


def watch(lines: Iterable[str]) -> set[int]:
    """Follow the list until its end; return the process groups that are left."""
    left: set[int] = set()
    for line in lines:
        word = line.strip()
        if word[:1] == "+" and word[1:].isdigit():
            left.add(int(word[1:]))
        elif word[:1] == "-" and word[1:].isdigit():
            left.discard(int(word[1:]))
    return left


def end_groups(groups: set[int], ends_s: float = ENDS_S) -> None:
    """Ask process groups to end, and kill those still there after `ends_s` [s]."""
    left = {group for group in groups if _send(group, signal.SIGTERM)}
    deadline = time.monotonic() + ends_s
    while left and time.monotonic() < deadline:
        time.sleep(0.05)
        left = {group for group in left if _send(group, 0)}
    for group in left:
        _send(group, signal.SIGKILL)


def _send(group: int, number: int) -> bool:
    try:
        os.killpg(group, number)
    except (ProcessLookupError, PermissionError):
        return False
    return True


def main() -> None:
    """Outlive the console by as long as it takes to end its processes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # A terminal that closes reaches the console, which notifies by the pipe.
        signal.signal(number, signal.SIG_IGN)
    end_groups(watch(sys.stdin))


if __name__ == "__main__":
    main()
