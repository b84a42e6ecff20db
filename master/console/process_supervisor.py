"""Supervisor ends the console's processes once the console is gone.

Run as `python -m master.console.process_supervisor`. It reads "+PID" and "-PID" lines from a pipe whose other
end only the console holds. When that closes, each process group still listed is asked to end, and killed if
it does not.
"""

import os
import signal
import sys
import time
from collections.abc import Callable, Iterable

ENDS_S = 4.0
KILL: int = getattr(signal, "SIGKILL", signal.SIGTERM)


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
    left = {group for group in groups if send(group, signal.SIGTERM)}
    deadline = time.monotonic() + ends_s
    while left and time.monotonic() < deadline:
        time.sleep(0.05)
        left = {group for group in left if send(group, 0)}
    for group in left:
        send(group, KILL)


def send(group: int, number: int) -> bool:
    """Send a signal to a process group, or on Windows end its leader at once.

    Returns:
        Whether there is still somebody to wait for.
    """
    end_group: Callable[[int, int], None] | None = getattr(os, "killpg", None)
    try:
        (end_group or os.kill)(group, number)
    except (ProcessLookupError, PermissionError):
        return False
    except OSError:  # of Windows: it has ended
        assert end_group is None
    return end_group is not None


def main() -> None:
    """Outlive the console by as long as it takes to end its processes."""
    for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
        # A terminal that closes reaches the console, which notifies by the pipe.
        signal.signal(number, signal.SIG_IGN)
    end_groups(watch(sys.stdin))


if __name__ == "__main__":
    main()
