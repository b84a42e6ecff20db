"""A person at a terminal who types answers, and one who looks for what was typed in all that processes show."""

import contextlib
import fcntl
import os
import pty
import re
import subprocess
import termios
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from tests.hosts.rig import Ran


def at_terminal(
    command: Sequence[str],
    answers: Sequence[tuple[str, str]],
    cwd: Path,
    environment: Mapping[str, str],
    timeout_s: float = 240.0,
) -> Ran:
    """Run a command on a terminal of its own; type each answer when its question, a pattern, is seen after the last.

    Returns:
        With what the terminal showed as `out`.
    """
    began = time.monotonic()
    terminal, end = pty.openpty()
    child = subprocess.Popen(
        command,
        stdin=end,
        stdout=end,
        stderr=end,
        cwd=cwd,
        env=environment,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(end)
    timer = threading.Timer(timeout_s, child.kill)
    timer.start()
    shown, seen, left = "", 0, list(answers)
    with contextlib.suppress(OSError):  # it has ended
        while read := os.read(terminal, 65536):
            shown += read.decode(errors="replace")
            while left and (question := re.search(left[0][0], shown[seen:])):
                seen += question.end()
                # when nothing is echoed any more: a person is not as fast as this, and getpass drops what came before
                until = time.monotonic() + 1.0
                while termios.tcgetattr(terminal)[3] & termios.ECHO and time.monotonic() < until:
                    time.sleep(0.01)
                os.write(terminal, f"{left.pop(0)[1]}\n".encode())
    code = child.wait()
    timer.cancel()
    os.close(terminal)
    assert not left, f"never asked: {left}\n{shown}"
    return Ran(code, shown.replace("\r\n", "\n"), "", began, time.monotonic() - began)


class Reader:
    """Reads command line and environment of every process again and again; holds where it found one of `secrets`.

    Processes of hosts that are containers of this machine are among them.
    """

    def __init__(self, *secrets: str) -> None:
        """Begin on entering."""
        self._secrets = [one.encode() for one in secrets]
        self.found: set[str] = set()
        self.rounds = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> "Reader":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def _read(self) -> None:
        own = str(os.getpid())  # which knows them
        while not self._over.wait(0.005):
            self.rounds += 1
            for process in Path("/proc").glob("[0-9]*"):
                for name in ("cmdline", "environ"):
                    with contextlib.suppress(OSError):  # it is gone
                        content = (process / name).read_bytes() if process.name != own else b""
                        if any(one in content for one in self._secrets):
                            self.found.add(f"{process.name} {name}: {content[:200]!r}")
