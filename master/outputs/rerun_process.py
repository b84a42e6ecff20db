"""Launcher of Rerun's own viewer as a child process.

The viewer listens on 127.0.0.1 only; the launcher also ends it.

The SDK's `spawn` and `serve_*` listen on every interface; the same program started by hand can be bound.
Its usage statistics are switched off in a private settings folder, the user's own settings stay untouched.
"""

import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from urllib.parse import quote

import rerun_cli

from common.clock import now_ns
from common.errors import PhalanxError

LOOPBACK = "127.0.0.1"
VIEWER_MEMORY = "1GB"  # the viewer drops its oldest data beyond it
SERVER_MEMORY = "256MB"
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
_FIX = "without a display use --web or --save FILE.rrd; a busy port needs another one"


class ViewerProcess:
    """A running viewer: a window, or a web page when `web_port` is given.

    Ends with the `with` block.
    """

    def __init__(self, web_port: int | None) -> None:
        """Start it and wait until it listens.

        Raises:
            PhalanxError: It ended at once (no display, port taken) or does not listen; the text has its reason.
        """
        if (
            web_port is None
            and sys.platform == "linux"
            and not any(os.environ.get(name) for name in _DISPLAYS)
        ):
            # The viewer would listen before it finds that out.
            raise PhalanxError(
                f"the viewer cannot open a window: none of {', '.join(_DISPLAYS)} is set; {_FIX}"
            )
        self._port = _free_port()
        self._web_port = web_port
        self._folder = tempfile.TemporaryDirectory(prefix="phalanx-viewer-")
        self._errors = Path(self._folder.name) / "stderr"
        program = _program()
        environment = {**os.environ, "XDG_CONFIG_HOME": self._folder.name}
        try:
            subprocess.run(
                [program, "analytics", "disable"],
                env=environment,
                capture_output=True,
                check=True,
                timeout=30,
            )
            with self._errors.open("wb") as errors:
                self._child = subprocess.Popen(
                    [program, *viewer_arguments(self._port, web_port)],
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=errors,
                    stderr=errors,
                    start_new_session=True,  # Ctrl-C is for us; we end the viewer in good order
                )
        except (OSError, subprocess.SubprocessError) as error:
            self._folder.cleanup()
            raise PhalanxError(f"{program}: cannot start the viewer: {error}") from error
        try:
            for port in (self._port, *(() if web_port is None else (web_port,))):
                self._wait_for(port)
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str:
        """Where the SDK sends its data."""
        return f"rerun+http://{LOOPBACK}:{self._port}/proxy"

    @property
    def address(self) -> str:
        """Return the address to show to the user."""
        if self._web_port is None:
            return "viewer window opened"
        return f"http://{LOOPBACK}:{self._web_port}?url={quote(self.url, safe='')}"

    def alive(self) -> bool:
        """Whether the viewer runs; False once its window was closed."""
        return self._child.poll() is None

    def close(self) -> None:
        """End the viewer. Safe to call twice."""
        if self.alive():
            self._child.terminate()
            try:
                end_timeout_s = 5.0
                self._child.wait(end_timeout_s)
            except subprocess.TimeoutExpired:
                self._child.kill()
                self._child.wait()
        self._folder.cleanup()

    def __enter__(self) -> "ViewerProcess":
        """The viewer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End it."""
        self.close()

    def check(self) -> None:
        """Nothing while it runs, or when its user closed it.

        Raises:
            PhalanxError: It ended by itself; the text has its reason.
        """
        if not self.alive() and self._child.returncode != 0:
            last = self._errors.read_text(errors="replace").strip().splitlines()[-1:] or ["no reason given"]
            raise PhalanxError(f"the viewer ended (exit {self._child.returncode}): {last[0]}; {_FIX}")

    def _wait_for(self, port: int) -> None:
        start_timeout_ns = 15_000_000_000
        end_ns = now_ns() + start_timeout_ns
        while now_ns() < end_ns:
            self.check()
            try:
                socket.create_connection((LOOPBACK, port), timeout=1.0).close()
                return
            except OSError:
                time.sleep(0.05)
        raise PhalanxError(
            f"the viewer does not listen on {LOOPBACK}:{port} after {start_timeout_ns // 10**9} s"
        )


def viewer_arguments(port: int, web_port: int | None) -> list[str]:
    """Command line of the viewer: bound to 127.0.0.1, memory limited."""
    common = ["--bind", LOOPBACK, "--port", str(port), "--server-memory-limit", SERVER_MEMORY]
    if web_port is None:
        return [*common, "--memory-limit", VIEWER_MEMORY, "--hide-welcome-screen", "--expect-data-soon"]
    return [*common, "--serve-web", "--web-viewer-port", str(web_port)]


def _program() -> str:
    folder = Path(next(iter(rerun_cli.__path__)))
    names = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")
    for name in names:
        if (folder / name).is_file():
            return str(folder / name)
    raise PhalanxError(f"{folder}: the viewer is missing; reinstall rerun-sdk")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])
