"""The services of a user, as `phalanx run --install` needs them.

Its unit is written, started, looked at, and removed.
"""

import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from common.errors import PhalanxError
from master.commands.service_unit import ERROR_WAIT_S, UNIT

_LOG = f"journalctl --user -u {UNIT} -n 20"


def systemctl(words: Sequence[str]) -> str:
    """Run a command of this user's service manager and return its output.

    Raises:
        PhalanxError: There is none, it failed, or takes too long.
    """
    command = ["systemctl", "--user", *words]
    command_s = 90.0  # more than the unit gives to a start
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=command_s, check=False
        )
    except FileNotFoundError as error:
        raise PhalanxError("systemctl: missing; a service needs systemd") from error
    except subprocess.TimeoutExpired as error:
        raise PhalanxError(f"{' '.join(command[:3])}: no end after {command_s:.0f} s") from error
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or f"exit {done.returncode}").splitlines()[-1]
        advice = ""
        if "connect to bus" in last:
            advice = (
                "; log in as this user itself, at the machine or by ssh: su and sudo have no service manager"
            )
        raise PhalanxError(f"{' '.join(command[:3])}: {last}{advice}")
    return done.stdout


class UserServices:
    """Of the user who asks. Holds how systemctl is called, which tests replace."""

    def __init__(self, run: Callable[[Sequence[str]], str] = systemctl) -> None:
        """Of the user of this process."""
        self._run = run

    @property
    def file(self) -> Path:
        """Where the unit is."""
        config = os.environ.get("XDG_CONFIG_HOME")
        return (Path(config) if config else Path.home() / ".config") / "systemd/user" / UNIT

    def install(self, text: str) -> str:
        """Write the unit and start it, now and at each login.

        Returns a line that states what was done.

        Raises:
            PhalanxError: It does not run; with its last words. It goes on being tried.
        """
        if self._state().get("ActiveState") == "active" and self._text() == text:
            return f"unchanged: {UNIT} runs"
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self.file.write_text(text)
        except OSError as error:
            raise PhalanxError(f"{self.file}: cannot write it ({error.strerror})") from error
        self._run(["daemon-reload"])
        self._run(["enable", "--quiet", UNIT])
        try:
            self._run(["restart", UNIT])  # until it is ready
        except PhalanxError as error:
            words = self._state().get("StatusText") or str(error)
            raise PhalanxError(
                f"{UNIT} does not run: {words}; {_LOG} has more. It is tried again, every {ERROR_WAIT_S} s; "
                "phalanx run --uninstall removes it"
            ) from error
        return f"{UNIT} runs; `systemctl --user status {UNIT}` shows how it is, `{_LOG}` its log"

    def remove(self, dry_run: bool) -> str:
        """Stop the service, remove its unit and return one line that reports it.

        Raises:
            PhalanxError: It does not stop.
        """
        if not self.file.exists():
            return f"no {self.file}: nothing to remove"
        if dry_run:
            return f"would stop {UNIT} and remove {self.file}"
        self._run(["disable", "--now", "--quiet", UNIT])
        self.file.unlink()
        self._run(["daemon-reload"])
        return f"stopped {UNIT} and removed {self.file}"

    def _state(self) -> dict[str, str]:
        text = self._run(["show", "-p", "ActiveState,StatusText", UNIT])
        return dict(line.split("=", 1) for line in text.splitlines() if "=" in line)

    def _text(self) -> str | None:
        try:
            return self.file.read_text()
        except FileNotFoundError:
            return None
