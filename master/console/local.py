"""Local processes that the console starts by command line.

They are cameras, a master and calibrations. Each runs in a process group of its own; a thread reads its
lines. A `process_supervisor` holds the groups and ends them when the console is gone, even killed, so that no
camera stays busy.
"""

import codecs
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import IO

from common.errors import PhalanxError
from common.supervisor import NEW_GROUP
from master.console.process_supervisor import ENDS_S, KILL, send

_KILLED_S = 2.0
_CHUNK = 8192


class LocalProcess:
    """One running command: its last lines, and a `prompt` that does not end its line."""

    def __init__(self, name: str, command: Sequence[str], environment: Mapping[str, str]) -> None:
        """Start `command` with this process's environment and `environment`.

        Raises:
            PhalanxError: The program cannot be started.
        """
        self.name, self.command = name, tuple(command)
        self.lines: deque[str] = deque(maxlen=200)
        self.prompt = ""
        self.stopped = False  # by `stop` or `interrupt`: then an exit code is no failure
        try:
            self._child = subprocess.Popen(
                self.command,
                bufsize=0,  # a line that nobody takes is not kept
                env={**os.environ, "PYTHONUNBUFFERED": "1", **environment},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                creationflags=NEW_GROUP,
            )
        except OSError as error:
            raise PhalanxError(f"{name}: cannot start {self.command[0]}: {error.strerror}") from error
        assert self._child.stdin is not None
        assert self._child.stdout is not None
        self._keyboard = self._child.stdin
        self._reader = threading.Thread(target=self._read, args=(self._child.stdout,), daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its process id, which is that of its group."""
        return self._child.pid

    def ended(self) -> int | None:
        """Its exit code; None while it runs. Negative: the signal that ended it."""
        return self._child.poll()

    def tail(self, count: int = 12) -> list[str]:
        """Its last lines."""
        return list(self.lines)[-count:]

    def send(self, line: str = "") -> None:
        """A line for its keyboard, as Enter; nothing happens once it has ended."""
        with suppress(OSError, ValueError):  # it ended meanwhile, which `ended` reports
            self._keyboard.write(f"{line}\n".encode())

    def interrupt(self) -> None:
        """Ask it to end (SIGINT), as Ctrl-C does; does not wait."""
        self.stopped = True
        send(self._child.pid, signal.SIGINT)

    def stop(self, ends_s: float = ENDS_S) -> int:
        """Stop it, after `ends_s` [s] by killing, and return its exit code."""
        self.stopped = True
        if self._child.poll() is None:
            send(self._child.pid, signal.SIGTERM)
            try:
                self._child.wait(ends_s)
            except subprocess.TimeoutExpired:
                send(self._child.pid, KILL)
                self._child.wait(_KILLED_S)
        self._reader.join(_KILLED_S)
        with suppress(OSError):  # what was not read any more
            self._keyboard.close()
        return self._child.returncode

    def _read(self, output: IO[bytes]) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
        with output:
            # What is there, not whole lines: a command that asks waits on the line of its question.
            while chunk := os.read(output.fileno(), _CHUNK):
                *whole, rest = (self.prompt + decoder.decode(chunk)).replace("\r\n", "\n").split("\n")
                self.lines.extend(line.rpartition("\r")[2] for line in whole)
                self.prompt = rest.rpartition("\r")[2][-_CHUNK:]
        if self.prompt:
            self.lines.append(self.prompt)
            self.prompt = ""


class LocalProcesses:
    """All processes that the console started, one of a name, and their supervisor."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._all: dict[str, LocalProcess] = {}
        try:
            self._supervisor = subprocess.Popen(
                [sys.executable, "-m", "master.console.process_supervisor"],
                stdin=subprocess.PIPE,
                text=True,
                start_new_session=True,
                creationflags=NEW_GROUP,
            )
        except OSError as error:
            raise PhalanxError(f"console: cannot start {sys.executable}: {error.strerror}") from error
        assert self._supervisor.stdin is not None
        self._list = self._supervisor.stdin

    def start(
        self, name: str, command: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> LocalProcess:
        """Start a command under a name; one of that name that still runs is ended first.

        Raises:
            PhalanxError: The program cannot be started.
        """
        self.stop(name)
        process = LocalProcess(name, command, environment or {})
        self._send(f"+{process.pid}")
        with self._lock:
            self._all[name] = process
        return process

    def get(self, name: str) -> LocalProcess | None:
        """The process started last under a name, which may have ended."""
        with self._lock:
            return self._all.get(name)

    def running(self) -> dict[str, LocalProcess]:
        """Those that run."""
        with self._lock:
            return {name: one for name, one in self._all.items() if one.ended() is None}

    def tail(self, name: str, count: int) -> str:
        """The last lines of a process; empty if there is none."""
        process = self.get(name)
        return "" if process is None else "\n".join(process.tail(count))

    def stop(self, *names: str) -> None:
        """End processes, all at once, and wait until they have; none: nothing happens."""
        processes = [process for name in names if (process := self.get(name)) is not None]
        with ThreadPoolExecutor(max(len(processes), 1)) as threads:
            for process, _ in zip(processes, threads.map(LocalProcess.stop, processes), strict=True):
                self._send(f"-{process.pid}")

    def close(self) -> None:
        """End all processes, then the supervisor. Safe to call twice."""
        self.stop(*self.running())
        with suppress(OSError):
            self._list.close()
        try:
            self._supervisor.wait(ENDS_S + _KILLED_S)
        except subprocess.TimeoutExpired:
            self._supervisor.kill()
            self._supervisor.wait(_KILLED_S)

    def _send(self, line: str) -> None:
        # Closed, or the supervisor was killed: the processes still end with `close`.
        with suppress(OSError, ValueError):
            self._list.write(line + "\n")
            self._list.flush()
