"""Supervised child processes: started, logged, restarted on a crash, stopped."""

import os
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO

_STOP_S = 20.0  # a master writes what it has; whoever cannot wait presses Ctrl-C again


class Process:
    """One row of the process table: a command that is kept running until `stop`.

    Holds the child, its last lines, and how often it was restarted. Its output goes to a log file and, line
    by line, to `on_line`, which runs on a thread of its own.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        log: Path,
        on_line: Callable[[str, str], None],
        nice: int = 0,
    ) -> None:
        """Start the command.

        `environment` is added to this process's own. `log` is begun anew, and a restarted child goes on in
        it; `on_line` takes name and line; `nice` is by how many steps of the scheduler's it gives way, 0..19.

        Raises:
            OSError: The program or the log file cannot be opened.
        """
        self.name = name
        self.restarts = 0
        self.tail: deque[str] = deque(maxlen=12)
        self._command, self._environment = list(command), {**os.environ, **environment}
        self._on_line, self._nice = on_line, nice
        self._log: IO[str] = log.open("w", buffering=1)
        self._stopping = False
        self._child = self._start()

    @property
    def pid(self) -> int:
        """Process id of the running child."""
        return self._child.pid

    def check(self) -> int | None:
        """Restart the process if it ended unexpectedly; its exit code, None: it runs."""
        code = self._child.poll()
        if code is None or self._stopping:
            return None
        self.restarts += 1
        self._child = self._start()
        return code

    def ended(self) -> int | None:
        """Exit code, or None while it runs; nothing is restarted."""
        return self._child.poll()

    def stop(self) -> int:
        """Ask it to end (SIGINT), insist after 20 s (SIGKILL); return the exit code."""
        self._stopping = True
        if self._child.poll() is None:
            self._child.send_signal(signal.SIGINT)
        try:
            code = self._child.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            code = self._child.wait()
        self._reader.join(1.0)
        self._log.close()
        return code

    def kill(self) -> None:
        """End it at once (SIGKILL), without a last word."""
        self._stopping = True
        self._child.kill()
        self._child.wait()

    def _start(self) -> subprocess.Popen[str]:
        # A session of its own: Ctrl-C reaches the launcher alone, which then stops the children in order.
        child = subprocess.Popen(
            self._command,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        if self._nice:
            _give_way(child.pid, self._nice)
        assert child.stdout is not None
        self._reader = threading.Thread(target=self._read, args=(child.stdout,), daemon=True)
        self._reader.start()
        return child

    def _read(self, output: IO[str]) -> None:
        for line in output:
            text = line.rstrip("\n")
            self.tail.append(text)
            if not self._log.closed:
                self._log.write(f"{time.monotonic():.3f} {text}\n")
            self._on_line(self.name, text)


def _give_way(pid: int, nice: int) -> None:
    """Lower the priority of a process that was just started and of all it starts."""
    try:
        os.setpriority(os.PRIO_PROCESS, pid, min(os.getpriority(os.PRIO_PROCESS, 0) + nice, 19))
        # Linux may share its time among sessions first, and each child has one of its own (sched(7), autogroup).
        session = Path(f"/proc/{pid}/autogroup")
        # who is not root may change one session in a tenth of a second
        session_tries, session_again_s = 3, 0.11
        for _ in range(session_tries if session.exists() else 0):
            try:
                session.write_text(str(nice))
                return
            except BlockingIOError:
                time.sleep(session_again_s)
    except OSError:
        return  # it has ended, or it may not be changed here: it runs as the others do
