"""Run systemd and other programs, as installer and doctor need them.

Standard library only. What fails or does not end in time raises `InstallError`; its last line is the reason.
"""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from slave.install.arguments import InstallError, NotReadyError


def finished(command: Sequence[str], timeout_s: float) -> subprocess.CompletedProcess[str]:
    """Run a program without input to its end and return it with its output.

    Raises:
        OSError: It cannot be run; `FileNotFoundError`: it is not there.
        subprocess.TimeoutExpired: It did not end in `timeout_s` and was killed.
    """
    return subprocess.run(
        list(command),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout_s,
        check=False,
    )


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


_ASKS = re.compile(r"may take (\d+) s")  # of a service's status: slave/service.py


@dataclass(frozen=True, slots=True)
class UnitState:
    """State of a service; `start_s` [s] until it was ready, None: it does not run."""

    active: bool
    enabled: bool
    pid: int
    restarts: int
    result: str
    status: int
    start_s: float | None = None
    output: str = ""


Run = Callable[[Sequence[str]], str]


def run_command(command: Sequence[str], deadline_s: float = 60.0) -> str:
    """Run a command and return its output."""
    try:
        done = finished(command, deadline_s)
    except FileNotFoundError as error:
        raise InstallError(f"{command[0]}: not found on this machine") from error
    except subprocess.TimeoutExpired as error:
        raise InstallError(f"{' '.join(command[:3])}: no end after {deadline_s:.0f} s") from error
    if done.returncode != 0:
        lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        raise InstallError(f"{' '.join(command[:3])}: {lines[-1] if lines else f'exit {done.returncode}'}")
    return done.stdout


class Systemd:
    """The system's services; tests replace how commands run and time is measured."""

    def __init__(
        self,
        run: Run = run_command,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.run, self._now, self.sleep = run, now, sleep

    def state(self, unit: str) -> UnitState:
        """State of a service now."""
        wanted = "ActiveState,SubState,UnitFileState,MainPID,NRestarts,Result,ExecMainStatus,StatusText"
        wanted += ",ExecMainStartTimestampMonotonic,ActiveEnterTimestampMonotonic"
        text = self.run(["systemctl", "show", "-p", wanted, unit])
        found = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
        runs = (found.get("ActiveState"), found.get("SubState")) == ("active", "running")
        began, ready = (
            int(found.get(f"{one}TimestampMonotonic") or 0) for one in ("ExecMainStart", "ActiveEnter")
        )
        return UnitState(
            runs,
            found.get("UnitFileState") == "enabled",
            int(found.get("MainPID") or 0),
            int(found.get("NRestarts") or 0),
            found.get("Result", ""),
            int(found.get("ExecMainStatus") or 0),
            (ready - began) * 1e-6 if runs and 0 < began <= ready else None,
            found.get("StatusText", ""),
        )

    def wait_ready(self, limits: Mapping[str, float], settle_s: float) -> None:
        """Wait until all units are ready, and stay so without a restart for `settle_s`.

        `limits` is service -> how long it may take [s], unless its status asks for more while it starts;
        `NotReadyError` has the last words of the one that is not.
        """
        began, since = self._now(), time.time() - 1.0
        ends = {unit: began + limit for unit, limit in limits.items()}
        first = {unit: self.state(unit).restarts for unit in limits}
        steady: dict[str, tuple[int, float]] = {}
        patient: set[tuple[str, int, str]] = set()
        while True:
            for unit in limits:
                state = self.state(unit)
                first[unit] = min(first[unit], state.restarts)  # a start by hand begins to count again
                # after two ends it is not going to run; each second of waiting is one without its camera
                if state.restarts >= first[unit] + 2:
                    raise NotReadyError(f"{unit} ends again and again: {self._why(unit, state, since)}")
                if not state.active:
                    steady.pop(unit, None)
                    asked = (unit, state.pid, state.output)
                    if asked not in patient and (found := _ASKS.search(state.output)):
                        patient.add(asked)  # once: a report of long ago extends nothing any more
                        ends[unit] = max(ends[unit], self._now() + float(found[1]))
                elif unit not in steady or steady[unit][0] != state.pid:
                    steady[unit] = (state.pid, self._now())
            stayed = [self._now() - steady[unit][1] for unit in limits if unit in steady]
            if len(stayed) == len(limits) and (not stayed or min(stayed) >= settle_s):
                return
            if late := [u for u in limits if u not in steady and self._now() > ends[u]]:
                passed_s = self._now() - began
                state = self.state(late[0])
                # the words of the one before are not its own
                why = self._why(late[0], state, since, state.pid)
                raise NotReadyError(f"{late[0]} is not ready after {passed_s:.0f} s: {why}")
            if stayed and self._now() > max(ends.values()) + settle_s:
                raise NotReadyError(f"{next(iter(limits))} does not stay ready for {settle_s:g} s")
            self.sleep(0.25)

    def _why(self, unit: str, state: UnitState, since: float, pid: int = 0) -> str:
        """Last log line of a unit since a time [s since 1970], or how systemd ended it."""
        if state.status in _STATUS:
            return f"status {_STATUS[state.status]}"
        words = ["journalctl", f"_SYSTEMD_UNIT={unit}", f"--since=@{since:.0f}"]
        words += [f"_PID={pid}"] if pid else []
        try:
            text = self.run([*words, "-n", "40", "-o", "cat", "--no-pager", "-q"])
        except InstallError:
            text = ""
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        own = [line for line in lines if line.startswith("phalanx-slave:")]
        errors = [line for line in lines if "Error" in line]
        ended = f"result {state.result}, status {state.status}" if state.status else "it reports nothing"
        return (own or errors or lines or [state.output or ended])[-1][:300]
