"""systemd, as an installer needs it: restart a slave, wait until it is ready and stays so, read its last words."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slave.install.errors import InstallError, NotReadyError
from slave.install.program import finished

_STEP_S = 0.25
_COMMAND_S = 60.0
_TRIES = 2  # ends after which it is not going to run; each second of waiting is one without its camera
# Where systemd ends a service before its program begins (systemd.exec(5)): status -> what is wrong.
_STATUS = {
    200: "200/CHDIR: its folder is missing",
    203: "203/EXEC: its program cannot be run",
    214: "214/SETSCHEDULER: not allowed here",
    216: "216/GROUP: a group of the unit does not exist (systemd-sysusers makes it)",
    217: "217/USER: its user cannot be made",
    226: "226/NAMESPACE: its sandbox cannot be made",
    243: "243/CREDENTIALS: a key of /etc/phalanx/keys is missing",
}


@dataclass(frozen=True, slots=True)
class UnitState:
    """How a service is."""

    active: bool
    enabled: bool
    pid: int
    restarts: int
    result: str
    status: int


Run = Callable[[Sequence[str]], str]


def run_command(command: Sequence[str], deadline_s: float = _COMMAND_S) -> str:
    """What it says.

    Raises:
        InstallError: It failed, or takes too long; its last line is the reason.
    """
    try:
        done = finished(command, deadline_s)
    except FileNotFoundError as error:
        raise InstallError(f"{command[0]}: not found on this machine") from error
    except subprocess.TimeoutExpired as error:
        raise InstallError(f"{' '.join(command[:3])}: no end after {deadline_s:.0f} s") from error
    if done.returncode != 0:
        said = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        raise InstallError(f"{' '.join(command[:3])}: {said[-1] if said else f'exit {done.returncode}'}")
    return done.stdout


class Systemd:
    """The system's services. Holds how commands are run and time is told, which tests replace."""

    def __init__(
        self,
        run: Run = run_command,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Of this machine."""
        self.run, self._now, self.sleep = run, now, sleep

    def state(self, unit: str) -> UnitState:
        """How it is now.

        Raises:
            InstallError: systemd does not answer.
        """
        wanted = "ActiveState,SubState,UnitFileState,MainPID,NRestarts,Result,ExecMainStatus"
        text = self.run(["systemctl", "show", "-p", wanted, unit])
        found = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
        return UnitState(
            (found.get("ActiveState"), found.get("SubState")) == ("active", "running"),
            found.get("UnitFileState") == "enabled",
            int(found.get("MainPID") or 0),
            int(found.get("NRestarts") or 0),
            found.get("Result", ""),
            int(found.get("ExecMainStatus") or 0),
        )

    def wait_ready(self, units: Sequence[str], deadline_s: float, settle_s: float) -> None:
        """Wait until all of them said READY=1, and none has restarted since for `settle_s`.

        Raises:
            NotReadyError: One does not; its last words are in the text.
        """
        end = self._now() + deadline_s
        first = {unit: self.state(unit).restarts for unit in units}
        steady: dict[str, tuple[int, float]] = {}
        while True:
            for unit in units:
                state = self.state(unit)
                first[unit] = min(first[unit], state.restarts)  # a start by hand begins to count again
                if state.restarts >= first[unit] + _TRIES:
                    raise NotReadyError(f"{unit} ends again and again: {self._why(unit, state)}")
                if not state.active:
                    steady.pop(unit, None)
                elif unit not in steady or steady[unit][0] != state.pid:
                    steady[unit] = (state.pid, self._now())
            since = [self._now() - steady[unit][1] for unit in units if unit in steady]
            if len(since) == len(units) and (not since or min(since) >= settle_s):
                return
            if self._now() > end:
                unit = next((unit for unit in units if unit not in steady), units[0])
                raise NotReadyError(
                    f"{unit} is not ready after {deadline_s:.0f} s: {self._why(unit, self.state(unit))}"
                )
            self.sleep(_STEP_S)

    def _why(self, unit: str, state: UnitState) -> str:
        """Its last words, or how systemd ended it."""
        if state.status in _STATUS:
            return f"status {_STATUS[state.status]}"
        try:
            text = self.run(
                ["journalctl", f"_SYSTEMD_UNIT={unit}", "-n", "40", "-o", "cat", "--no-pager", "-q"]
            )
        except InstallError:
            text = ""
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        own = [line for line in lines if line.startswith("phalanx-slave:")]
        errors = [line for line in lines if "Error" in line]
        last = (own or errors or lines or [f"result {state.result or 'unknown'}, status {state.status}"])[-1]
        return last[:300]
