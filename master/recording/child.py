"""Recorder process that `phalanx run --record FILE` starts.

A process of its own, with an end of its own.

It is there before the first message is taken, so that a replay is what was published live from the first pose on. Its
standard input is a pipe from this process: when that closes, because we end it or because we died, it ends its file. It
is in a group of its own, so that Ctrl-C stops the tracking first and the recorder then.
"""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from common.bus.bus import Bus
from common.errors import RecordingError
from master.rig.files import RigFiles


class RecorderProcess:
    """A running recorder.

    Holds the process and the thread that forwards its output.
    """

    def __init__(
        self,
        path: Path,
        files: RigFiles,
        endpoint: str,
        notify: Callable[[str], None],
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Start it.

        Args:
            path: The file.
            files: Files of calibration of the rigs.
            endpoint: Of our bus, which is open already.
            say: Called with each line that it prints.
            ended: Called, on another thread, once it is gone.
        """
        self._notify, self._ended, self._path = notify, ended, path
        self._name = f"recorder-{os.getpid()}"
        self._process = subprocess.Popen(
            _command(path, files, endpoint, self._name),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._last = ""
        self._thread = threading.Thread(target=self._listen, name="recorder lines", daemon=True)
        self._thread.start()

    # Python, numpy and the bus on a busy machine
    def wait_ready(self, bus: Bus, timeout_s: float = 60.0) -> None:
        """Wait until the recorder receives all that is published from here on.

        Raises:
            RecordingError: It ended, or does not come in time.
        """
        deadline = time.monotonic() + timeout_s
        while self._name not in bus.alive():
            if self._process.poll() is not None:
                self._thread.join(1.0)
                raise RecordingError(
                    f"{self._path}: the recorder ended at once: {self._last or 'it printed nothing'}"
                )
            if time.monotonic() > deadline:
                self.close()
                raise RecordingError(f"{self._path}: the recorder was not ready within {timeout_s:g} s")
            step_s = 0.05
            time.sleep(step_s)

    def close(self) -> None:
        """Let the recorder write pending messages and end its file.

        The bus must be open still. Safe to call twice.
        """
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            end_s = 20.0
            code = self._process.wait(end_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self._thread.join(1.0)
        if code:
            self._notify(f"the recording is not whole: {self._last}")

    def _listen(self) -> None:
        assert self._process.stdout is not None  # it is a pipe
        with self._process.stdout:
            for line in self._process.stdout:
                self._last = line.strip()
                self._notify(self._last)
        self._ended()


def _command(path: Path, files: RigFiles, endpoint: str, name: str) -> list[str]:
    """The command line of the recorder."""
    command = [sys.executable, "-m", "master", "record", str(path), "--bus", endpoint, "--owned", name]
    command += ["--calibration", str(files.calibration)]
    for rig in files.rigs:
        command += ["--rig", rig]
    return command if files.hand is None else [*command, "--hand", str(files.hand)]
